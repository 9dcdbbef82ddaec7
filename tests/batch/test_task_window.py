"""Tasks on a scheduler that was there before the batch, with workers that join it later."""

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from mocapfix.batch.cluster import BatchProgress, ClusterOptions
from mocapfix.batch.job_files import find_takes
from mocapfix.batch.records import TakeRecord
from mocapfix.batch.run_session import BatchSettings, run_session
from mocapfix.errors import MocapfixError
from mocapfix.lab.batches import hash_outputs
from mocapfix.options import CleanOptions
from mocapfix.synthetic import compose_take, write_synthetic_take


class Messages(BatchProgress):
    """Keeps the messages of a batch."""

    def __init__(self) -> None:
        self.messages: list[str] = []

    def show_message(self, message: str) -> None:
        self.messages.append(message)


@contextmanager
def start_dask(*arguments: str) -> Generator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def find_free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


def test_existing_scheduler_with_workers_that_join_later_and_its_end(tmp_path: Path) -> None:
    takes, output_folder, port = tmp_path / "takes", tmp_path / "out", find_free_port()
    takes.mkdir()
    write_synthetic_take(takes / "walk.c3d", compose_take(seconds=1.0, rate=30.0))
    found = find_takes([str(takes)], output_folder).takes
    address, results, progress = f"tcp://127.0.0.1:{port}", list[list[TakeRecord] | MocapfixError](), Messages()
    settings = BatchSettings(output_folder, CleanOptions(), cluster=ClusterOptions(scheduler=address))

    def run() -> None:
        try:
            results.append(run_session(found, settings, progress))
        except MocapfixError as error:
            results.append(error)

    with start_dask("scheduler", "--host", "127.0.0.1", "--port", str(port)) as scheduler:
        wait_for_port(port)
        thread = threading.Thread(target=run)
        thread.start()
        wait_until(lambda: bool(progress.messages))
        assert "No worker" in progress.messages[0]
        with start_dask("worker", address, "--nworkers", "2", "--nthreads", "1", "--memory-limit", "0"):
            thread.join(120)
        (records,) = results
        assert isinstance(records, list)
        assert [record.status for record in records] == ["done"]
        assert {"walk.c3d", "walk.bvh", "walk.report.json"} <= set(hash_outputs(output_folder / "walk"))

        (output_folder / "walk" / "walk.bvh").unlink()
        progress.messages.clear()
        thread = threading.Thread(target=run)
        thread.start()
        wait_until(lambda: bool(progress.messages))
        scheduler.kill()
        thread.join(60)
    assert isinstance(results[1], MocapfixError)
    assert "scheduler has ended" in str(results[1])


def wait_for_port(port: int) -> None:
    def is_open() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    wait_until(is_open)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)
