"""The stages before the cleaning: people do not depend on the order in which takes are surveyed."""

from pathlib import Path
from typing import Any

import pytest

from mocapfix.batch import session_people
from mocapfix.batch.child_process import JobLimits, JobOutcome
from mocapfix.batch.jobs import CleanRequest
from mocapfix.batch.progress import BatchProgress
from mocapfix.options import CleanOptions

run_stage: Any = session_people._run_stage  # pyright: ignore


def test_results_are_in_the_order_of_the_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_backwards(_client: Any, _function: Any, tasks: Any, *_: Any) -> Any:
        return [(task, {"key": task.name, "files": []}) for task in reversed(list(tasks))]

    monkeypatch.setattr(session_people, "run_tasks", run_backwards)
    requests = {
        name: CleanRequest(name, tmp_path / name, tmp_path / "out", CleanOptions()) for name in ("a.c3d", "b.c3d", "c.c3d")
    }
    found = run_stage(lambda: None, "survey", "", requests, JobLimits(), BatchProgress())
    assert list(found) == list(requests)


def test_survey_that_reached_a_limit_is_repeated_with_other_limits_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    surveyed = list[float]()

    def run_out_of_time(_function: str, _arguments: object, limits: JobLimits) -> JobOutcome:
        surveyed.append(limits.timeout_s)
        return JobOutcome("timeout", None, "It was ended.")

    def run_here(_client: Any, function: Any, tasks: Any, *_: Any) -> Any:
        return [(task, function(*task.arguments)) for task in tasks]

    monkeypatch.setattr(session_people, "run_in_child", run_out_of_time)
    monkeypatch.setattr(session_people, "run_tasks", run_here)
    requests = {"a.c3d": CleanRequest("a.c3d", tmp_path / "a.c3d", tmp_path / "out", CleanOptions())}
    for timeout_s in (1.0, 1.0, 2.0):
        limits = JobLimits(timeout_s)
        run_stage(lambda: None, "survey", session_people.SURVEY_FUNCTION, requests, limits, BatchProgress())
    assert surveyed == [1.0, 2.0]
