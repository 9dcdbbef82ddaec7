"""What is done with one take: its record."""

from pathlib import Path

import pytest

from mocapfix import pipeline
from mocapfix.batch import jobs
from mocapfix.batch.child_process import JobLimits, JobOutcome
from mocapfix.characters.fbx import BLENDER_VARIABLE
from mocapfix.errors import WriteError
from mocapfix.options import CleanOptions, build_clean_options
from mocapfix.result import CleaningResult
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
