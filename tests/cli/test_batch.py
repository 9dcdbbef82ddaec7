"""The command `mocapfix batch`: exit statuses, the page, failures in one sentence, and wrong usage."""

from pathlib import Path

import pytest

from tests.batch.session_records import build_failed
from tests.conftest import BriefTake


def run_without_cluster(takes, settings, progress, write_page):
    """Do what run_session does where every take is unreadable and failed in an earlier batch, except for the first."""
    records = [build_failed(take.id, f"{take.path}: is empty (0 bytes).") for take in takes]
    progress.start_stage("clean", len(takes), len(takes) - 1)
    progress.start_job(takes[0].id)
    progress.finish_job(takes[0].id, records[0].error)
    settings.output_folder.mkdir()
    write_page(settings.output_folder, records)
    return records


def test_failed_takes_are_printed_once_and_on_the_page(mocapfix, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mocapfix.batch.run_session.run_session", run_without_cluster)
    takes, out = tmp_path / "takes", tmp_path / "out"
    takes.mkdir()
    for name in ("a [b].c3d", "c.c3d"):
        (takes / name).touch()
    status, text, errors = mocapfix("batch", takes, "--out", out)
    assert status == 1
    assert f"0 of 2 takes are done, 2 failed. Page: {out}/index.html" in text
    assert f"a [b].c3d failed: {takes}/a [b].c3d: is empty (0 bytes)." in errors
    assert f"c.c3d failed in an earlier batch (--repeat-failed cleans it again): {takes}/c.c3d: is empty (0 bytes)." in errors
    assert errors.count("is empty (0 bytes)") == 2
    assert "2 failed: 2 error" in (out / "index.html").read_text(encoding="utf-8")
    assert {"summary.csv", "summary.parquet"} <= {path.name for path in out.iterdir()}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--workers", "0"], "--workers must be at least 1, not 0."),
        (["--timeout", "0"], "--timeout must be greater than 0 s, not 0."),
        (["--memory", "-1"], "--memory must be greater than 0 MB, not -1."),
        (["--retries", "-1"], "--retries must be at least 0, not -1."),
        (["--loop"], "--loop is for the motion of a character; name a character too."),
        (["--slurm", "--ssh", "a,b"], "Give one of --scheduler, --slurm and --ssh."),
    ],
)
def test_wrong_usage_is_one_sentence(mocapfix, tmp_path: Path, arguments: list[str], sentence: str) -> None:
    status, text, errors = mocapfix("batch", tmp_path, "--out", tmp_path / "out", *arguments)
    assert (status, text) == (2, "")
    assert sentence in errors


def test_folder_without_takes_is_one_sentence(mocapfix, tmp_path: Path) -> None:
    status, _, errors = mocapfix("batch", tmp_path, "--out", tmp_path / "out")
    assert status == 1
    assert "holds no take" in errors


def test_memories_of_people_are_not_made_for_a_named_subject(mocapfix, tmp_path: Path, brief: BriefTake) -> None:
    arguments = ("--people", "memory", "--subject", brief.subject)
    status, _, errors = mocapfix("batch", brief.path.parent, "--out", tmp_path / "out", *arguments)
    assert status == 2
    assert "--people memory cannot be used with --subject" in " ".join(errors.split())


def test_marker_set_that_does_not_exist_is_refused_before_any_take(mocapfix, tmp_path: Path) -> None:
    (tmp_path / "walk.c3d").touch()
    status, _, errors = mocapfix("batch", tmp_path, "--out", tmp_path / "out", "--marker-set", "none.yaml")
    assert status == 1
    assert "none.yaml: no such marker set" in errors
    assert not (tmp_path / "out").exists()
