"""Batches: their speed beside one process, and what is left after workers, scheduler and client were killed.

Every take must be done, once, with the outputs of a quiet run. Cleaning that hangs, grows or crashes for takes of certain names
tests the limits of batches.
"""

import ctypes
import hashlib
import json
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
from pathlib import Path, PurePosixPath

import numpy as np
import psutil

from mocapfix.batch.jobs import CleanRequest, clean_recorded_take
from mocapfix.batch.records import BATCH_LOCK_NAME, RECORD_SUFFIX, TakeRecord, list_record_paths, read_records
from mocapfix.batch.run_session import RECORDS_FOLDER
from mocapfix.review.take_files import JSON_REPORT_SUFFIX
from mocapfix.synthetic import compose_take, write_synthetic_take

RUN_DEPENDENT_SUFFIXES = (RECORD_SUFFIX, ".rrd")
"""outputs with times: records, and recordings, to which rerun adds the time of writing"""


def compose_batch_takes(folder: Path, count: int, seconds: tuple[float, float], rate: float) -> float:
    """Write takes 0.c3d, 1.c3d ... of lengths that rise from the first to the second of `seconds`; return the sum in seconds."""
    folder.mkdir(parents=True, exist_ok=True)
    lengths = [seconds[0] + (seconds[1] - seconds[0]) * index / max(1, count - 1) for index in range(count)]
    for index, length in enumerate(lengths):
        write_synthetic_take(folder / f"{index}.c3d", compose_take(seed=index, seconds=length, rate=rate))
    return sum(lengths)


def copy_takes(originals: Path, folder: Path, count: int) -> None:
    """Copy takes in turn until there are `count`, those of each round into a folder of their own."""
    paths = sorted(originals.glob("*.c3d"))
    for index in range(count):
        target = folder / f"round{index // len(paths)}" / paths[index % len(paths)].name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(paths[index % len(paths)], target)


def hash_outputs(folder: Path) -> dict[str, str]:
    """Return the hashes of the outputs in the folder of one take by name, but of those that depend on the run or its folders."""
    paths = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.endswith(RUN_DEPENDENT_SUFFIXES))
    return {path.name: hashlib.sha256(_read_output(path)).hexdigest() for path in paths}


def _read_output(path: Path) -> bytes:
    """Return the bytes of an output, of a report without the arguments, which name the input by its path."""
    if not path.name.endswith(JSON_REPORT_SUFFIX):
        return path.read_bytes()
    return json.dumps({key: value for key, value in json.loads(path.read_bytes()).items() if key != "arguments"}).encode()


def find_differing_takes(reference: Path, output_folder: Path) -> list[str]:
    """Return the takes in the rounds of `copy_takes` whose outputs differ from those of the originals."""
    expected = {path.name: hash_outputs(path) for path in reference.iterdir() if path.is_dir()}
    folders = sorted(output_folder.glob("round*/*")) or sorted(path for path in output_folder.iterdir() if path.name in expected)
    return [path.relative_to(output_folder).as_posix() for path in folders if hash_outputs(path) != expected[path.name]]


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
    """What a disturbed batch left."""

    take_count: int
    done_count: int
    kills: dict[str, int]
    attempts: dict[int, int]  # number of takes by the number of attempts at them
    differing: list[str]
    leftovers: list[str]  # hidden files in the output folder, but the lock and the records of people
    client_errors: list[str]  # what the clients that ended by themselves with an error wrote last
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

    Args:
        worker_kills: Beside which the scheduler is killed once and the client twice.
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


FAULTY_FUNCTION = "mocapfix.lab.batches:clean_with_faults"
GROWTH_STEP_MB = 20.0
GROWTH_MB = 10_000.0
HANG_S = 3600.0


def clean_with_faults(request: CleanRequest) -> TakeRecord:
    """Clean a take, unless its name begins with "hang", "grow" or "crash"."""
    name = PurePosixPath(request.take).name
    for prefix, fault in FAULTS.items():
        if name.startswith(prefix):
            fault()
    return clean_recorded_take(request)


def hang() -> None:
    """Do nothing for an hour."""
    time.sleep(HANG_S)


def grow() -> None:
    """Use 10 GB of memory."""
    blocks = [np.ones(int(GROWTH_STEP_MB * 1e6 / 8)) for _ in range(int(GROWTH_MB / GROWTH_STEP_MB))]
    time.sleep(len(blocks))


def crash() -> None:
    """End the process by a segmentation fault."""
    ctypes.string_at(0)


def fail() -> None:
    """Raise an error that mocapfix does not explain."""
    raise ValueError("a value")


def give_number() -> int:
    """Return a number."""
    return 42


def use_memory() -> None:
    """Use 350 MB for half a second: memory is sampled twenty times a second."""
    used = np.ones(int(350e6 / 8))
    time.sleep(0.5)
    del used


def hold_memory() -> None:
    """Use 500 MB and never release it."""
    _held.append(np.ones(int(500e6 / 8)))


_held: list[np.ndarray] = []
FAULTS = {"hang": hang, "grow": grow, "crash": crash}


SAMPLE_INTERVAL_S = 0.5
SINGLE_RUN_CODE = """
import sys, time
from pathlib import Path
from mocapfix import pipeline
from mocapfix.model.stage_timer import omit_stage_times
with omit_stage_times():
    for path in sorted(Path(sys.argv[1]).glob("*.c3d")):
        start = time.monotonic(), time.process_time()
        pipeline.clean(path).write(Path(sys.argv[2]) / path.stem)
        print(time.monotonic() - start[0], time.process_time() - start[1], flush=True)
"""


@dataclass(frozen=True)
class BatchSpeed:
    """Times in seconds with the start of the processes, of one process with one thread and of a batch."""

    takes: int
    take_seconds: float  # length of all takes together
    workers: int
    one_seconds: float
    one_cpu: float  # one_cpu, batch_cpu: processor time of all processes
    batch_seconds: float
    batch_cpu: float
    worker_memory_mb: float  # greatest memory of a worker with its child; shared pages count once
    child_peak_mb: float
    differing: int  # takes whose outputs are not those of the one process

    @property
    def rate_share(self) -> float:
        """The rate of the batch as a share of the rate of one process times the workers."""
        return round(self.one_seconds / self.batch_seconds / self.workers, 3)


def measure_batch_speed(
    folder: Path, take_count: int, seconds: tuple[float, float], workers: int, report: Callable[[str], None]
) -> BatchSpeed:
    """Clean composed takes in one process with one thread, then by a batch, and compare."""
    report("compose takes")
    length = compose_batch_takes(folder / "takes", take_count, seconds, 120.0)
    report("one process")
    single = [sys.executable, "-c", SINGLE_RUN_CODE, str(folder / "takes"), str(folder / "one")]
    one_seconds, one_cpu, _ = run_with_usage(["env", "MOCAPFIX_NUM_THREADS=1", "OMP_NUM_THREADS=1", *single])
    report("batch")
    batch = ["-m", "mocapfix", "batch", str(folder / "takes"), "--out", str(folder / "batch"), "--workers", str(workers)]
    batch_seconds, batch_cpu, memory_mb = run_with_usage([sys.executable, *batch])
    records = read_records(folder / "batch")
    return BatchSpeed(
        take_count,
        round(length, 1),
        workers,
        round(one_seconds, 1),
        round(one_cpu, 1),
        round(batch_seconds, 1),
        round(batch_cpu, 1),
        round(memory_mb, 0),
        max((record.peak_memory_mb for record in records), default=0.0),
        len(find_differing_takes(folder / "one", folder / "batch")) + take_count - len(records),
    )


def run_with_usage(command: list[str]) -> tuple[float, float, float]:
    """Run a command; return its seconds, processor time of all its processes, and the greatest memory of a worker in MB.

    The time is that of the last sample of each process: the children of workers end by themselves, and no one waits for them.
    """
    start = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    used_s: dict[int, float] = {}
    peak_mb = 0.0
    while process.poll() is None:
        peak_mb = max(peak_mb, measure_worker_memory_mb(process.pid))
        with suppress(psutil.Error):
            root = psutil.Process(process.pid)
            for each in [root, *root.children(recursive=True)]:
                with suppress(psutil.Error):
                    times = each.cpu_times()
                    used_s[each.pid] = times.user + times.system
        with suppress(subprocess.TimeoutExpired):
            process.wait(SAMPLE_INTERVAL_S)
    if process.returncode:
        raise RuntimeError(f"{command[-3:]} ended with status {process.returncode}")
    return time.monotonic() - start, sum(used_s.values()), peak_mb


def measure_worker_memory_mb(process: int) -> float:
    """Return the memory of the largest child of a process with its descendants, in which shared pages count once."""
    sums = [0.0]
    try:
        for child in psutil.Process(process).children():
            family = [child, *child.children(recursive=True)]
            sums.append(sum(each.memory_full_info().pss for each in family) / 1e6)
    except (psutil.Error, OSError):
        return max(sums)
    return max(sums)
