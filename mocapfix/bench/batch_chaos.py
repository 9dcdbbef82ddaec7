"""A batch whose workers, scheduler and client are killed: every take must be done, once, with the outputs of a quiet run."""

import random
import shutil
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from mocapfix.batch.folder_lock import BATCH_LOCK_NAME
from mocapfix.batch.people_jobs import RECORDS_FOLDER
from mocapfix.batch.records import list_record_paths, read_records
from mocapfix.bench.batch_takes import compose_batch_takes, copy_takes, find_differing_takes

DISTINCT_TAKES = 10
TAKE_DURATION_S = (1.0, 2.0)
TAKE_RATE_HZ = 30.0
START_PAUSE_S = 3.0  # for a scheduler that was started again, before the client is
MIN_DONE_SHARE, MAX_DONE_SHARE = 0.05, 0.95  # of the takes, while processes are killed
KILL_INTERVAL_S = 0.2
WORKER_COMMAND_WORD = "spawn_main"
SCHEDULER, CLIENT, WORKER = "scheduler", "client", "worker"


@dataclass(frozen=True)
class ChaosResult:
    """What a disturbed batch left.

    attempts       number of takes by the number of attempts at them
    client_errors  what the clients that ended by themselves with an error wrote last
    leftovers      hidden files in the output folder, but the lock and the records of people
    """

    take_count: int
    done_count: int
    kills: dict[str, int]
    attempts: dict[int, int]
    differing: list[str]
    leftovers: list[str]
    client_errors: list[str]
    seconds: float

    @property
    def is_sound(self) -> bool:
        """Whether every take is done once, as in a quiet run, and none was begun more than twice."""
        return (
            self.done_count == self.take_count
            and not self.differing
            and not self.leftovers
            and max(self.attempts, default=0) <= 2
        )


class ChaosCluster:
    """A scheduler, two workers that join it, and the client of a batch: each a process that can be killed."""

    def __init__(self, takes: Path, output_folder: Path, workers: int) -> None:
        with socket.socket() as server:
            server.bind(("127.0.0.1", 0))
            self._address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        self._takes, self._output_folder, self._worker_count = takes, output_folder, workers
        self._log = output_folder.with_name("client.log")
        self.start_scheduler()
        self.start_workers()
        self.start_client()

    def start_scheduler(self) -> None:
        """Start the scheduler, at the same address every time."""
        host, _, port = self._address.removeprefix("tcp://").partition(":")
        self.scheduler = start_quietly("dask", "scheduler", "--host", host, "--port", port, "--no-dashboard")

    def start_workers(self) -> None:
        """Start the worker processes with a nanny that starts them again."""
        count = ("--nworkers", str(self._worker_count), "--nthreads", "1", "--memory-limit", "0", "--no-dashboard")
        self.workers = start_quietly("dask", "worker", self._address, *count)

    def start_client(self) -> None:
        """Start the batch."""
        arguments = ["batch", str(self._takes), "--out", str(self._output_folder), "--scheduler", self._address]
        with self._log.open("wb") as log:
            self.client = subprocess.Popen([sys.executable, "-m", "mocapfix", *arguments], stdout=log, stderr=log)

    def read_client_error(self) -> str:
        """Return the last line that the client wrote."""
        return (self._log.read_text(encoding="utf-8").strip().splitlines() or [""])[-1]

    def kill(self, kind: str, generator: random.Random) -> bool:
        """Kill the scheduler, the client or one of the workers by SIGKILL; return whether there was one."""
        if kind == CLIENT:
            self.client.kill()
            self.client.wait()
            self.start_client()
            return True
        if kind == SCHEDULER:
            self.scheduler.kill()
            self.scheduler.wait()
            return True
        processes = list_worker_processes(self.workers.pid)
        if processes:
            with suppress(psutil.NoSuchProcess):
                generator.choice(processes).kill()
                return True
        return False

    def revive(self) -> None:
        """Start the scheduler and the client again."""
        self.start_scheduler()
        time.sleep(START_PAUSE_S)
        self.start_client()

    def close(self) -> None:
        """End all processes."""
        for process in (self.client, self.workers, self.scheduler):
            with suppress(psutil.NoSuchProcess):
                for child in psutil.Process(process.pid).children(recursive=True):
                    with suppress(psutil.NoSuchProcess):
                        child.kill()
            process.kill()
            process.wait()


def measure_chaos(
    folder: Path, take_count: int, worker_kills: int, workers: int, seed: int, report: Callable[[str], None]
) -> ChaosResult:
    """Run a batch of short takes while its processes are killed at random moments, and compare it with a quiet run.

    worker_kills  beside which the scheduler is killed once and the client twice
    """
    generator = random.Random(seed)
    originals, takes, quiet, disturbed = (folder / name for name in ("originals", "takes", "quiet", "disturbed"))
    for old in (takes, disturbed, quiet):
        shutil.rmtree(old, ignore_errors=True)
    report("compose takes")
    compose_batch_takes(originals, DISTINCT_TAKES, TAKE_DURATION_S, TAKE_RATE_HZ)
    copy_takes(originals, takes, take_count)
    report("quiet run")
    command = [sys.executable, "-m", "mocapfix", "batch", str(originals), "--out", str(quiet), "--workers", str(workers)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    start = time.monotonic()
    cluster = ChaosCluster(takes, disturbed, workers)
    try:
        kills, errors = run_disturbed(cluster, disturbed, draw_kills(take_count, worker_kills, generator), generator, report)
    finally:
        cluster.close()
    seconds = time.monotonic() - start
    records = read_records(disturbed)
    return ChaosResult(
        take_count,
        sum(record.status == "done" for record in records),
        dict(kills),
        dict(Counter(record.attempts for record in records)),
        find_differing_takes(quiet, disturbed),
        [str(path) for path in disturbed.rglob(".*") if path.name not in (BATCH_LOCK_NAME, RECORDS_FOLDER)],
        errors,
        round(seconds, 1),
    )


def draw_kills(take_count: int, worker_kills: int, generator: random.Random) -> list[tuple[float, str]]:
    """Return when each process is killed, as the number of takes that are done by then, in order."""
    kinds = [WORKER] * worker_kills + [CLIENT, CLIENT, SCHEDULER]
    low, high = MIN_DONE_SHARE * take_count, MAX_DONE_SHARE * take_count
    return sorted((generator.uniform(low, high), kind) for kind in kinds)


def run_disturbed(
    cluster: ChaosCluster,
    output_folder: Path,
    plan: list[tuple[float, str]],
    generator: random.Random,
    report: Callable[[str], None],
) -> tuple[Counter[str], list[str]]:
    """Kill processes as planned until the client is done; return how many were killed, and the clients' errors."""
    kills: Counter[str] = Counter()
    errors: list[str] = []
    while True:
        if (status := cluster.client.poll()) is not None:
            if status == 0:
                return kills, errors
            errors.append(cluster.read_client_error())
            cluster.revive() if cluster.scheduler.poll() is not None else cluster.start_client()
        if cluster.workers.poll() is not None:  # they end some time after their scheduler
            cluster.start_workers()
        done = len(list_record_paths(output_folder))
        report(f"{done} takes recorded, {sum(kills.values())} processes killed")
        while plan and plan[0][0] <= done and cluster.scheduler.poll() is None:
            if not cluster.kill(plan[0][1], generator):
                break
            kills[plan.pop(0)[1]] += 1
        time.sleep(KILL_INTERVAL_S * (0.5 + generator.random()))


def list_worker_processes(nanny: int) -> list[psutil.Process]:
    """Return the worker processes below a nanny."""
    try:
        children = psutil.Process(nanny).children()
        return [child for child in children if WORKER_COMMAND_WORD in " ".join(child.cmdline())]
    except psutil.Error:
        return []


def start_quietly(*command: str) -> subprocess.Popen[bytes]:
    """Start a Python module as a process without output."""
    return subprocess.Popen(
        [sys.executable, "-m", *command], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
