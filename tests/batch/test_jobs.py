"""What is done with one take: its record."""

from dataclasses import replace
from pathlib import Path

import pytest

from mocapfix import pipeline
from mocapfix.batch import jobs
from mocapfix.batch.child_process import JobLimits, JobOutcome
from mocapfix.batch.records import hash_options
from mocapfix.characters.fbx import BLENDER_VARIABLE
from mocapfix.errors import WriteError
from mocapfix.options import CleanOptions, build_clean_options
from mocapfix.result import CleaningResult
from mocapfix.review.take_files import DecisionStore, parse_edit
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


def test_decisions_are_kept_when_a_take_is_cleaned_with_other_options(tmp_path: Path) -> None:
    take = tmp_path / "walk.c3d"
    truth = compose_take(seconds=3.0, rate=30.0)
    write_synthetic_take(take, truth)
    request = jobs.CleanRequest("walk.c3d", take, tmp_path / "out", build_clean_options(prior="none"))
    record = jobs.clean_recorded_take(request)
    store = DecisionStore(tmp_path / "out" / record.outputs["changes.yaml"])
    change = next(each for each in store.file.changes if each.kind == "gap")
    edit = parse_edit({"type": "decide", "ids": [change.id], "decision": "reject"})
    store.edit(store.revision, edit)
    other = replace(request, options=build_clean_options(prior="none", max_gap_s=3.0))
    assert jobs.find_current_record(other) is None
    again = jobs.clean_recorded_take(other)
    (kept,) = (each for each in DecisionStore(store.path).file.changes if each.id == change.id)
    assert (kept.decision, kept.reviewed) == ("reject", True)
    assert again.options_sha256 == hash_options(other.options)  # the decisions do not count as options
    assert jobs.find_current_record(other) == again
    assert jobs.find_reviewed_files(other, "another input") == []
