"""The command `mocapfix batch`: exit statuses, the page, failures in one sentence, and wrong usage."""

from pathlib import Path

import pytest


def test_failed_takes_are_printed_once_and_on_the_page(mocapfix, tmp_path: Path) -> None:
    takes, out = tmp_path / "takes", tmp_path / "out"
    takes.mkdir()
    (takes / "empty [b].c3d").touch()
    sentence = f"{takes}/empty [b].c3d: is empty (0 bytes); copy or export it again."
    status, text, errors = mocapfix("batch", takes, "--out", out, "--workers", "1")
    assert status == 1
    assert f"0 of 1 takes are done, 1 failed. Page: {out}/index.html" in text
    assert errors.count(sentence) == 1
    assert "1 failed: 1 error" in (out / "index.html").read_text(encoding="utf-8")
    assert {"summary.csv", "summary.parquet"} <= {path.name for path in out.iterdir()}

    status, text, errors = mocapfix("batch", takes, "--out", out, "--workers", "1")
    assert status == 1
    assert f"empty [b].c3d failed in an earlier batch (--repeat-failed cleans it again): {sentence}" in errors


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--workers", "0"], "--workers must be at least 1, not 0."),
        (["--timeout", "0"], "--timeout must be greater than 0 s, not 0."),
        (["--memory", "-1"], "--memory must be greater than 0 MB, not -1."),
        (["--retries", "-1"], "--retries must be at least 0, not -1."),
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
