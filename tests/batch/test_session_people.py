"""The stages before the cleaning: people do not depend on the order in which takes are surveyed."""

from pathlib import Path
from typing import Any

import pytest

from mocapfix.batch import session_people
from mocapfix.batch.child_process import JobLimits
from mocapfix.batch.jobs import CleanRequest
from mocapfix.batch.progress import BatchProgress
from mocapfix.options import CleanOptions


def test_results_are_in_the_order_of_the_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_backwards(_client: Any, _function: Any, tasks: Any, *_: Any) -> Any:
        return [(task, {"key": task.name, "files": []}) for task in reversed(list(tasks))]

    monkeypatch.setattr(session_people, "run_tasks", run_backwards)
    requests = {
        name: CleanRequest(name, tmp_path / name, tmp_path / "out", CleanOptions()) for name in ("a.c3d", "b.c3d", "c.c3d")
    }
    found = session_people._run_stage(lambda: None, "survey", "", requests, JobLimits(), BatchProgress())  # pyright: ignore
    assert list(found) == list(requests)
