"""What is done with one take: its record."""

from dataclasses import replace
from pathlib import Path

import pytest

from mocapfix import pipeline
from mocapfix.batch import jobs
from mocapfix.batch.child_process import JobLimits, JobOutcome
from mocapfix.batch.records import hash_options
from mocapfix.batch.run_session import BatchSettings, find_finished_takes
from mocapfix.characters.fbx import BLENDER_VARIABLE
from mocapfix.errors import WriteError
from mocapfix.options import CleanOptions, build_clean_options
from mocapfix.result import CleaningResult
from mocapfix.review.edits import DecisionStore, parse_edit
from mocapfix.synthetic import compose_take, write_synthetic_take

clean = pipeline.clean


def test_take_that_changes_while_it_is_cleaned_is_cleaned_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = tmp_path / "walk.c3d"
    write_synthetic_take(take, compose_take(seconds=1.0, rate=30.0))

    def clean_and_change(path: Path, options: CleanOptions) -> CleaningResult:
        result = clean(path, options)
        path.write_bytes(path.read_bytes() + bytes(512))
        return result

    monkeypatch.setattr(pipeline, "clean", clean_and_change)
    request = jobs.CleanRequest("walk.c3d", take, tmp_path / "out", CleanOptions())
    assert jobs.clean_recorded_take(request).status == "done"
    assert jobs.find_current_record(request) is None


def test_failure_has_the_time_of_its_last_attempt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ends = iter([JobOutcome("crash", None, "It crashed.", 9.0), JobOutcome("error", None, "It is damaged.", 0.5)])
    monkeypatch.setattr(jobs, "run_in_child", lambda *_: next(ends))
    request = jobs.CleanRequest("walk.c3d", tmp_path / "walk.c3d", tmp_path / "out", CleanOptions())
    record = jobs.clean_take(request, JobLimits(retries=1))
    assert (record.reason, record.seconds) == ("error", 0.5)


def test_an_output_that_cannot_be_written_is_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other outputs are written; the sentence says what is missing."""
    monkeypatch.setenv(BLENDER_VARIABLE, "/nowhere/blender")
    take = tmp_path / "walk.c3d"
    write_synthetic_take(take, compose_take(seconds=1.0, rate=30.0))
    options = build_clean_options(extra_formats=("fbx",), prior="none")
    request = jobs.CleanRequest("walk.c3d", take, tmp_path / "out", options)
    with pytest.raises(WriteError, match=r"walk\.fbx was not written: /nowhere/blender cannot be started"):
        jobs.clean_recorded_take(request)
    assert (tmp_path / "out" / "walk" / "walk.bvh").is_file()


def review_take(folder: Path) -> tuple[jobs.CleanRequest, Path, str]:
    """Clean a take of one subject, reject its first gap, and return its request, its changes file and the id of the gap."""
    take = folder / "walk.c3d"
    write_synthetic_take(take, compose_take(seconds=3.0, rate=30.0))
    request = jobs.CleanRequest("walk.c3d", take, folder / "out", build_clean_options(prior="none"))
    path = folder / "out" / jobs.clean_recorded_take(request).outputs["changes.yaml"]
    store = DecisionStore(path)
    change = next(each for each in store.file.changes if each.kind == "gap")
    store.edit(store.revision, parse_edit({"type": "decide", "ids": [change.id], "decision": "reject"}))
    return request, path, change.id


def read_decision(path: Path, name: str) -> tuple[str, bool]:
    (change,) = (each for each in DecisionStore(path).file.changes if each.id == name)
    return change.decision, change.reviewed


def test_decisions_are_kept_when_a_take_is_cleaned_with_other_options(tmp_path: Path) -> None:
    request, path, name = review_take(tmp_path)
    other = replace(request, options=build_clean_options(prior="none", max_gap_s=3.0))
    assert jobs.find_current_record(other) is None
    again = jobs.clean_recorded_take(other)
    assert read_decision(path, name) == ("reject", True)
    assert again.options_sha256 == hash_options(other.options)  # the decisions do not count as options
    assert jobs.find_current_record(other) == again


def test_decisions_are_kept_after_a_failure_and_without_resuming(tmp_path: Path) -> None:
    request, path, name = review_take(tmp_path)
    other = replace(request, options=build_clean_options(prior="none", max_gap_s=3.0))
    failed = jobs.write_failure(other, JobOutcome("timeout", None, "It took too long.", 9.0), "")
    assert failed.status == "failed"
    settings = BatchSettings(tmp_path / "out", other.options, resume=False)
    assert find_finished_takes([other], settings) == {}
    assert jobs.clean_recorded_take(other).status == "done"
    assert read_decision(path, name) == ("reject", True)


@pytest.mark.parametrize("cause", ["frames", "input"])
def test_decisions_that_do_not_fit_are_set_aside_with_a_note(tmp_path: Path, cause: str) -> None:
    request, path, name = review_take(tmp_path)
    if cause == "input":
        write_synthetic_take(request.path, compose_take(seed=1, seconds=3.0, rate=30.0))
    else:
        path.write_text(path.read_text().replace("frames: [1, 90]", "frames: [1, 91]"))
    record = jobs.clean_recorded_take(replace(request, options=build_clean_options(prior="none", max_gap_s=3.0)))
    note = record.subjects[0].notes[0]
    assert "walk.changes.earlier.yaml, are not used" in note
    assert ("is not known" if cause == "input" else "91") in note
    assert read_decision(path.with_name("walk.changes.earlier.yaml"), name) == ("reject", True)
    assert not any(change.reviewed for change in DecisionStore(path).file.changes)


def test_decisions_that_are_set_aside_again_keep_those_set_aside_before(tmp_path: Path) -> None:
    request, path, _ = review_take(tmp_path)
    names = ["walk.changes.earlier.yaml", "walk.changes.earlier-2.yaml", "walk.changes.earlier-3.yaml"]
    note, kept = "", list[bytes]()
    for n, decision in enumerate(("reject", "keep", "accept")):
        write_synthetic_take(request.path, compose_take(seed=n + 1, seconds=3.0, rate=30.0))
        store = DecisionStore(path)
        decide = {"type": "decide", "ids": [store.file.changes[0].id], "decision": decision}
        store.edit(store.revision, parse_edit(decide))
        kept.append(path.read_bytes())
        note = jobs.clean_recorded_take(replace(request, options=build_clean_options(prior="none"))).subjects[0].notes[0]
        assert f"now in {names[n]}, are not used" in note
        assert [path.with_name(each).read_bytes() for each in names[: n + 1]] == kept
    assert f"Those set aside before stay in {names[0]} and {names[1]}." in note
