"""The speed of a batch against cleaning the same takes in one process, and the memory of its workers."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psutil

from mocapfix.batch.records import read_records
from mocapfix.bench.batch_takes import compose_batch_takes, find_differing_takes

SAMPLE_INTERVAL_S = 2.0
SINGLE_RUN_CODE = """
import sys, time
from pathlib import Path
from mocapfix import pipeline
from mocapfix.report.stage_timer import omit_stage_times
with omit_stage_times():
    for path in sorted(Path(sys.argv[1]).glob("*.c3d")):
        start = time.monotonic(), time.process_time()
        pipeline.clean(path).write(Path(sys.argv[2]) / path.stem)
        print(time.monotonic() - start[0], time.process_time() - start[1], flush=True)
"""


@dataclass(frozen=True)
class BatchSpeed:
    """Times in seconds with the start of the processes, of one process with one thread and of a batch.

    take_seconds           length of all takes together
    one_cpu, batch_cpu     processor time of all processes
    worker_memory_mb       greatest memory of a worker with its fork server and child; shared pages count once
    differing              takes whose outputs are not those of the one process
    """

    takes: int
    take_seconds: float
    workers: int
    one_seconds: float
    one_cpu: float
    batch_seconds: float
    batch_cpu: float
    worker_memory_mb: float
    child_peak_mb: float
    differing: int

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
    """Run a command; return its seconds, processor time with that of its children, and the greatest memory of a worker in MB."""
    before, start = psutil.Process().cpu_times(), time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    peak_mb = 0.0
    finished = threading.Event()

    def sample_memory() -> None:
        nonlocal peak_mb
        while not finished.wait(SAMPLE_INTERVAL_S):
            peak_mb = max(peak_mb, measure_worker_memory_mb(process.pid))

    sampler = threading.Thread(target=sample_memory)
    sampler.start()
    process.wait()
    seconds = time.monotonic() - start
    finished.set()
    sampler.join()
    after = psutil.Process().cpu_times()
    used = (after.children_user - before.children_user) + (after.children_system - before.children_system)
    if process.returncode:
        raise RuntimeError(f"{command[-3:]} ended with status {process.returncode}")
    return seconds, used, peak_mb


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
