"""Whole batches on a local cluster: outputs, failures with their reasons, and what is resumed."""

import shutil
import threading
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from mocapfix.batch import cluster
from mocapfix.batch.child_process import JobLimits
from mocapfix.batch.cluster import BatchProgress, ClusterOptions
from mocapfix.batch.job_files import find_takes
from mocapfix.batch.jobs import CleanRequest, try_to_hash
from mocapfix.batch.records import TakeRecord, write_record
from mocapfix.batch.run_session import BatchSettings, check_same_inputs, run_session
from mocapfix.errors import MocapfixError, WriteError
from mocapfix.lab.batches import FAULTY_FUNCTION
from mocapfix.options import CleanOptions
from mocapfix.synthetic import compose_take, write_synthetic_take

REASONS = {"crash.c3d": "crash", "grow.c3d": "memory", "hang.c3d": "timeout", "unreadable.c3d": "error", "walk.c3d": None}


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("takes")
    write_synthetic_take(folder / "walk.c3d", compose_take(seconds=1.0, rate=30.0))
    data = (folder / "walk.c3d").read_bytes()
    for name in ("crash", "grow", "hang"):
        (folder / f"{name}.c3d").write_bytes(data)
    (folder / "unreadable.c3d").write_bytes(b"no capture")
    return folder


def run(takes: Path, output_folder: Path, repeat_failed: bool = False) -> list[TakeRecord]:
    settings = BatchSettings(
        output_folder,
        CleanOptions(),
        JobLimits(timeout_s=5.0, memory_mb=500.0, retries=0),
        ClusterOptions(workers=1),
        repeat_failed=repeat_failed,
        clean_function=FAULTY_FUNCTION,
    )
    return run_session(find_takes([str(takes)], output_folder).takes, settings, BatchProgress())


def test_failures_have_reasons_and_a_second_batch_repeats_only_what_changed(takes: Path, tmp_path: Path) -> None:
    records = run(takes, tmp_path)
    assert {record.take: record.reason for record in records} == REASONS
    assert all(record.error.startswith(str(takes)) for record in records if record.status == "failed")
    hanging = next(record for record in records if record.reason == "timeout")
    assert hanging.seconds < 5 + 2
    assert not [path for path in tmp_path.rglob(".*") if path.name != ".batch.lock"]

    start = time.monotonic()
    assert run(takes, tmp_path) == records
    assert time.monotonic() - start < 2  # no cluster was started

    (takes / "hang.c3d").unlink()
    (takes / "crash.c3d").unlink()
    (takes / "grow.c3d").unlink()
    (tmp_path / "walk" / "walk.bvh").unlink()
    repeated = {record.take: record for record in run(takes, tmp_path)}
    assert set(repeated) == {"unreadable.c3d", "walk.c3d"}
    assert (tmp_path / "walk" / "walk.bvh").is_file()
    assert repeated["unreadable.c3d"] == next(record for record in records if record.reason == "error")


def test_outputs_of_another_session_are_not_replaced(takes: Path, tmp_path: Path) -> None:
    day1, day2 = (shutil.copytree(takes, tmp_path / name) / "walk.c3d" for name in ("day1", "day2"))
    out = tmp_path / "out"
    write_record(out, TakeRecord(take="walk.c3d", input=str(day1), input_sha256=try_to_hash(day1), status="done"))
    request = CleanRequest("walk.c3d", day2, out, CleanOptions())
    check_same_inputs([request])  # a copy
    day2.write_bytes(b"another take")
    with pytest.raises(WriteError, match=r"out: has the outputs of .*day1/walk\.c3d"):
        check_same_inputs([request])
    day1.unlink()  # the session was moved
    check_same_inputs([request])


def test_take_of_a_killed_worker_is_cleaned_by_the_next(tmp_path: Path) -> None:
    folder = tmp_path / "takes"
    folder.mkdir()
    write_synthetic_take(folder / "walk.c3d", compose_take(seconds=2.0, rate=30.0))
    settings = BatchSettings(tmp_path / "out", CleanOptions(), cluster=ClusterOptions(workers=1))
    results: list[TakeRecord] = []
    takes = find_takes([str(folder)], settings.output_folder).takes
    thread = threading.Thread(target=lambda: results.extend(run_session(takes, settings, BatchProgress())))
    thread.start()
    begun = settings.output_folder / "walk" / ".walk.attempts"
    deadline = time.monotonic() + 100
    while not (begun.is_file() and begun.read_text(encoding="utf-8")):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    (worker,) = [each for each in psutil.Process().children() if "spawn_main" in " ".join(each.cmdline())]
    worker.kill()
    thread.join(100)
    (record,) = results
    assert (record.status, record.attempts) == ("done", 2)
    assert not begun.exists()


def test_unreachable_scheduler_is_one_sentence(takes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT_S", 0.5)
    settings = BatchSettings(tmp_path, CleanOptions(), cluster=ClusterOptions(scheduler="tcp://127.0.0.1:9"))
    with pytest.raises(MocapfixError, match="no scheduler answers"):
        run_session(find_takes([str(takes)], tmp_path).takes, settings, BatchProgress())


def test_page_is_written_while_takes_are_cleaned(takes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that cannot be written then does not end the batch."""
    written: list[tuple[int, int]] = []

    def clean_at_once(_client, _function, tasks, *_):
        return ((task, TakeRecord(take=task.name, input="", status="done")) for task in tasks)

    def write_page(_: Path, records: Sequence[TakeRecord], waiting_count: int) -> None:
        written.append((len(records), waiting_count))
        if waiting_count:
            raise WriteError("index.html: is open in another program.")

    monkeypatch.setattr("mocapfix.batch.run_session.open_client", lambda _: nullcontext(SimpleNamespace(dashboard_link="")))
    monkeypatch.setattr("mocapfix.batch.run_session.run_tasks", clean_at_once)
    found = find_takes([str(takes)], tmp_path).takes
    run_session(found, BatchSettings(tmp_path, CleanOptions()), BatchProgress(), write_page)
    assert written[0] == (1, len(found) - 1)
    assert written[-1] == (len(found), 0)
