"""The stages before the cleaning: people do not depend on the order in which takes are surveyed."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mocapfix.batch import jobs
from mocapfix.batch import run_session as session_people
from mocapfix.batch.child_process import JobLimits, JobOutcome
from mocapfix.batch.cluster import BatchProgress
from mocapfix.batch.jobs import CleanRequest
from mocapfix.batch.records import PersonEntry, read_people_file
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.options import CleanOptions
from mocapfix.solve.person_memory import RememberedTake, digest_capture, read_memory
from tests.conftest import BriefTake

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

    monkeypatch.setattr(jobs, "run_in_child", run_out_of_time)
    monkeypatch.setattr(session_people, "run_tasks", run_here)
    requests = {"a.c3d": CleanRequest("a.c3d", tmp_path / "a.c3d", tmp_path / "out", CleanOptions())}
    for timeout_s in (1.0, 1.0, 2.0):
        limits = JobLimits(timeout_s)
        run_stage(lambda: None, "survey", session_people.COMPARE_FUNCTION, requests, limits, BatchProgress())
    assert surveyed == [1.0, 2.0]


def test_survey_that_crashes_is_retried_and_does_not_count_as_a_failed_take(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    surveyed, failures, messages = list[str](), list[str](), list[str]()

    class Progress(BatchProgress):
        def finish_job(self, name: str, error: str = "") -> None:
            failures.extend([error] if error else [])

        def show_message(self, message: str) -> None:
            messages.append(message)

    def crash(_function: str, arguments: Any, _limits: JobLimits) -> JobOutcome:
        surveyed.append(arguments["request"].take)
        return JobOutcome("crash", None, "Its process crashed by SIGSEGV.")

    def run_here(_client: Any, function: Any, tasks: Any, *_: Any) -> Any:
        return [(task, function(*task.arguments)) for task in tasks]

    monkeypatch.setattr(jobs, "run_in_child", crash)
    monkeypatch.setattr(session_people, "run_tasks", run_here)
    requests = {"a.c3d": CleanRequest("a.c3d", tmp_path / "a.c3d", tmp_path / "out", CleanOptions())}
    arguments = ("survey", session_people.COMPARE_FUNCTION, requests, JobLimits(retries=2), Progress())
    assert run_stage(lambda: None, *arguments) == {}
    assert surveyed == ["a.c3d"] * 3
    assert not failures
    assert messages == [
        "a.c3d: not in the survey (Its process crashed by SIGSEGV.) It is cleaned without the person's other takes."
    ]
    run_stage(lambda: None, *arguments)
    assert len(surveyed) == 3
    session_people.forget_results(tmp_path / "out", failed_only=True)
    run_stage(lambda: None, *arguments)
    assert len(surveyed) == 6


def test_results_are_forgotten_without_resuming(tmp_path: Path) -> None:
    folder = session_people.locate_records(tmp_path)
    folder.mkdir(parents=True)
    for name, text in (("a.json", '{"key": "1", "files": []}'), ("b.json", '{"key": "1", "limits": {}}')):
        (folder / name).write_text(text, encoding="utf-8")
    session_people.forget_results(tmp_path, failed_only=True)
    assert [path.name for path in folder.iterdir()] == ["a.json"]
    session_people.forget_results(tmp_path, failed_only=False)
    assert not list(folder.iterdir())


def test_outputs_of_a_take_named_like_the_folder_of_people_are_kept(tmp_path: Path) -> None:
    output = tmp_path / "people" / "people.report.json"
    output.parent.mkdir()
    output.touch()
    session_people.forget_results(tmp_path, failed_only=False)
    assert output.exists()


def test_people_with_one_take_are_not_surveyed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages = dict[str, list[str]]()
    sizes = {"a.c3d": 1.0, "b.c3d": 1.2, "c.c3d": 1.001}

    def run(_connect: Any, stage: str, _function: str, requests: Any, *_: Any) -> dict[str, Any]:
        stages[stage] = list(requests)
        lengths = {f"A{i} B{i}": 0.2 + 0.01 * i for i in range(10)}
        if stage == session_people.COMPARE_STAGE:
            bodies = {take: {pair: size * length for pair, length in lengths.items()} for take, size in sizes.items()}
            return {
                take: {
                    "bodies": [{"take": take, "subject_name": "", "label_name": "", "marker_set": "cmu41", "distances_m": body}]
                }
                for take, body in bodies.items()
            }
        if stage == session_people.SURVEY_STAGE:  # one fails
            return {"a.c3d": {"key": "k", "subjects": {"": "a.npz"}}}
        return {}

    monkeypatch.setattr(session_people, "_run_stage", run)
    (tmp_path / "out").mkdir()
    requests = [CleanRequest(take, tmp_path / take, tmp_path / "out", CleanOptions()) for take in sizes]
    arguments: Any = (lambda: None, requests, {}, JobLimits(), BatchProgress())
    found = session_people.assign_subjects(*arguments, remembers_people=False)
    assert stages == {"compare": ["a.c3d", "b.c3d", "c.c3d"], "survey": ["a.c3d", "c.c3d"], "calibrate": []}
    assert found == requests
    people = read_people_file(tmp_path / "out")
    assert people is not None
    assert [sorted(person.takes) for person in people.people] == [["a.c3d", "c.c3d"], ["b.c3d"]]


def test_takes_of_a_person_are_cleaned_with_the_memory_of_all(
    brief: BriefTake, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved = list[str]()

    def run(_connect: Any, _stage: str, _function: str, requests: Any, *_: Any) -> dict[str, Any]:
        solved.extend(requests)
        return {take: session_people.remember_recorded_take(request) for take, request in requests.items()}

    monkeypatch.setattr(session_people, "_run_stage", run)
    options = CleanOptions().change(subject=brief.subject)
    requests = [CleanRequest(take, tmp_path / take, tmp_path / "out", options) for take in ("day1/a.c3d", "b.c3d", "c.c3d")]
    for number, request in enumerate(requests):
        request.path.parent.mkdir(exist_ok=True)
        request.path.write_bytes(brief.path.read_bytes() + bytes(number))
    requests[2].path.write_bytes(b"nothing")
    people = (
        PersonEntry(name="Ann", takes={"day1/a.c3d": "", "b.c3d": "", "c.c3d": ""}),
        PersonEntry(name="Jim", takes={"c.c3d": "Jim"}),
    )
    add_memories: Any = session_people._add_memories  # pyright: ignore
    found = add_memories(lambda: None, requests, people, JobLimits(), BatchProgress())
    assert solved == ["day1/a.c3d", "b.c3d", "c.c3d"]
    path = tmp_path / "out" / "people" / "Ann.memory.safetensors"
    assert [request.options.prior.person_memory for request in found] == [path] * 3
    assert not (path.parent / "Jim.memory.safetensors").exists()
    memory = read_memory(path, load_cmu31_body().skeleton)
    assert memory.takes == tuple(
        RememberedTake(name, digest_capture(request.path)) for name, request in zip(("day1/a", "b"), requests, strict=False)
    )
    given = [replace(each, options=each.options.change(person_memory=tmp_path / "x.safetensors")) for each in requests]
    assert add_memories(lambda: None, given, people, JobLimits(), BatchProgress()) == given
    content = path.read_bytes()
    add_memories(lambda: None, requests, people, JobLimits(), BatchProgress())
    assert path.read_bytes() == content
