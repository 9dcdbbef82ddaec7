"""The terminal: unexpected errors, broken pipes, and takes that must not be touched."""

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from mocapfix import pipeline, surveys
from mocapfix.errors import MocapfixError, OptionError, WriteError, describe_error

MAX_MESSAGE_LENGTH = 220
UNEXPECTED = {
    "ValueError": ValueError("zero-size array to reduction operation minimum which has no identity " * 3),
    "without text": StopIteration(),
    "AssertionError": AssertionError(),
    "RecursionError": RecursionError("maximum recursion depth exceeded"),
    "MemoryError": MemoryError(),
    "OSError": OSError(28, "No space left on device", "/tmp/x"),
    "KeyError": KeyError("y"),
    "markup": RuntimeError("[red]a\nb[/red]"),
}


@pytest.fixture
def takes(brief, tmp_path) -> list[Path]:
    """Return three takes; `pipeline` is expected to fail for the second."""
    paths = [tmp_path / f"{name}.c3d" for name in ("one", "two", "three")]
    for path in paths:
        path.write_bytes(brief.path.read_bytes())
    return paths


def break_pipeline(monkeypatch, name: str, error: BaseException, module: ModuleType = pipeline) -> None:
    """Let a function of the pipeline, or of another module, raise an error for the take two.c3d, given by its path or read."""
    original = getattr(module, name)

    def run(take, *arguments, **options):
        if Path(getattr(take, "path", take)).stem == "two":
            raise error
        return original(take, *arguments, **options)

    monkeypatch.setattr(module, name, run)


@pytest.mark.parametrize("kind", UNEXPECTED)
def test_unexpected_error_is_one_sentence_with_the_file(mocapfix, takes, monkeypatch, kind):
    break_pipeline(monkeypatch, "inspect", UNEXPECTED[kind])
    status, out, err = mocapfix("inspect", takes[1])
    assert (status, out) == (1, "")
    assert err.startswith(f"{takes[1]}: ")
    assert len(err.splitlines()) == 1
    assert len(err) <= MAX_MESSAGE_LENGTH + len(str(takes[1].parent))
    assert ("CONTRIBUTING.md" in err) == (kind not in ("MemoryError", "OSError"))
    assert "Traceback" not in err


def test_debug_shows_the_traceback(mocapfix, takes, monkeypatch):
    monkeypatch.setenv("MOCAPFIX_DEBUG", "")
    break_pipeline(monkeypatch, "inspect", UNEXPECTED["KeyError"])
    status, _, err = mocapfix("inspect", takes[1], "--debug")
    assert status == 1
    assert "Traceback" in err
    assert "break_pipeline" in err or "test_console.py" in err
    status, _, err = mocapfix("inspect", takes[1].with_name("gone.c3d"), "--debug")
    assert (status, len(err.splitlines())) == (1, 1)


def test_unexpected_error_in_one_take_does_not_stop_the_others(mocapfix, brief, takes, monkeypatch, tmp_path):
    break_pipeline(monkeypatch, "clean_capture", UNEXPECTED["RecursionError"])
    status, out, err = mocapfix("clean", *takes, "--subject", brief.subject, "--out", tmp_path / "out")
    assert status == 1
    assert err.startswith(f"{takes[1]}: An error in mocapfix in ")
    assert [line.partition(":")[0] for line in out.splitlines() if "samples were missing" in line] == ["one.c3d", "three.c3d"]
    assert {path.name.partition(".")[0] for path in (tmp_path / "out").iterdir()} == {"one", "three"}


def test_take_that_cannot_be_used_does_not_stop_a_calibration(mocapfix, takes, monkeypatch, tmp_path):
    break_pipeline(monkeypatch, "read_capture", UNEXPECTED["KeyError"], surveys)
    for target in (tmp_path / "person.yaml", tmp_path / "people"):
        status, out, err = mocapfix("calibrate", *takes[:2], "-o", target)
        assert status == 1
        assert err.startswith(f"{takes[1]}: An error in mocapfix in ")
        assert "41 markers on 31 joints" in " ".join(out.split())
        assert target.exists()
    status, _, err = mocapfix("calibrate", takes[1], "-o", tmp_path / "nobody")
    assert (status, len(err.splitlines())) == (1, 1)
    assert not (tmp_path / "nobody").exists()


def test_interrupt_stops_all_takes(mocapfix, takes, monkeypatch, tmp_path):
    break_pipeline(monkeypatch, "clean_capture", KeyboardInterrupt())
    status, out, err = mocapfix("clean", *takes[1:], "--out", tmp_path / "out")
    assert (status, out, err.strip()) == (1, "", "Stopped; no file was left incomplete.")
    assert not (tmp_path / "out").exists()


def test_errors_of_mocapfix_keep_their_sentences():
    assert describe_error(WriteError("a.c3d: is full.")) == "a.c3d: is full."
    assert describe_error(OptionError("max_gap_s", "--max-gap", "fill.max_gap", "is wrong")) == "--max-gap is wrong."
    assert isinstance(OptionError("a", "b", "c", "d"), MocapfixError)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs the pipes of POSIX")
@pytest.mark.parametrize("arguments", [["--help"], ["clean", "--help"], ["marker-set", "list"], ["inspect", "TAKE", "--json"]])
def test_broken_pipe_ends_quietly(brief, arguments):
    reader, writer = os.pipe()
    os.close(reader)
    arguments = [str(brief.path) if each == "TAKE" else each for each in arguments]
    done = subprocess.run(
        [sys.executable, "-m", "mocapfix", *arguments], stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_output_that_cannot_be_written_is_an_error():
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        done = subprocess.run(
            [sys.executable, "-m", "mocapfix", "--help"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 1
    assert "No space left on device" in done.stderr
    assert len(done.stderr.splitlines()) == 1


# inputs and outputs


def list_files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_outputs_are_not_cleaned_into_folders_of_their_own(mocapfix, brief, takes, tmp_path, monkeypatch):
    assert mocapfix("clean", takes[0], "--subject", brief.subject)[0] == 0
    before = list_files(tmp_path)
    output = tmp_path / "one.mocapfix" / "one.c3d"
    status, out, err = mocapfix("clean", output, "--overwrite")
    assert (status, out) == (1, "")
    assert "is an output of mocapfix, since it is in one.mocapfix/; clean the original, or name a folder with --out." in err
    monkeypatch.chdir(output.parent)
    assert mocapfix("clean", "one.c3d", "--overwrite")[0] == 1
    assert list_files(tmp_path) == before
    status, _, err = mocapfix("clean", output, "--subject", brief.subject, "--out", tmp_path / "again")
    assert (status, err) == (0, "")


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
def test_no_take_of_a_command_is_replaced(mocapfix, brief, takes, tmp_path, overwrite):
    other = tmp_path / "other" / "one.c3d"
    other.parent.mkdir()
    other.write_bytes(takes[0].read_bytes())
    before = list_files(tmp_path)
    status, out, err = mocapfix("clean", takes[0], other, "--subject", brief.subject, "--out", other.parent, *overwrite)
    assert (status, out, len(err.splitlines())) == (1, "", 2)
    assert mocapfix("clean", takes[0], "--out", tmp_path, *overwrite)[0] == 1
    assert mocapfix("label", takes[0], "-o", takes[0], *overwrite)[0] == 1
    assert list_files(tmp_path) == before
