"""Writing that fails or is interrupted: one sentence, the input untouched, no half output, nothing left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mocapfix.errors import WriteError
from mocapfix.io.files import make_output_folder
from mocapfix.options import OutputOptions
from mocapfix.result import CleaningResult

resource = pytest.importorskip("resource", reason="limits of files, permissions and signals are those of POSIX")
ALL_FORMATS = OutputOptions(extra_formats=("gltf", "amc", "npz", "trc", "csv"))
RUN_CLEAN = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background process ignores it
from pathlib import Path
import mocapfix.result
from mocapfix.cli import app
write_files = mocapfix.result.CleaningResult._write_files
def write_slowly(self, folder, *arguments):
    write_files(self, folder, *arguments)
    print("written", flush=True)
    time.sleep(30)
mocapfix.result.CleaningResult._write_files = write_slowly
app.run_command_line(sys.argv[1:])
"""


def read_folder(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("is_overwriting", [False, True])
def test_full_disk_at_any_write_leaves_what_was_there(cleaned, tmp_path: Path, is_overwriting: bool) -> None:
    result: CleaningResult = cleaned.result
    outputs = result.write(tmp_path / "all", options=ALL_FORMATS)
    sizes = sorted({path.stat().st_size for path in outputs.values()})
    limits = [0, *(size - 1 for size in sizes), *(size // 2 for size in sizes)]
    folder = tmp_path / "out"
    before: dict[str, bytes] = {}
    if is_overwriting:
        result.write(folder, options=ALL_FORMATS)
        before = read_folder(folder)
    data, former = cleaned.path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit in limits:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, former[1]))
        try:
            with pytest.raises(WriteError, match="out") as error:
                result.write(folder, overwrite=is_overwriting, options=ALL_FORMATS)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, former)
        assert "\n" not in str(error.value)
        assert ".mocapfix-" not in str(error.value)
        assert read_folder(folder) == before
        assert cleaned.path.read_bytes() == data


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes into read-only folders")
def test_read_only_folder_is_an_error(cleaned, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(WriteError, match="Permission denied"):
            cleaned.result.write(tmp_path)
    finally:
        tmp_path.chmod(0o700)


def test_folder_that_cannot_be_written_is_an_error(cleaned) -> None:
    with pytest.raises(WriteError, match="/proc"):
        cleaned.result.write(Path("/proc/mocapfix"))


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 1), (signal.SIGTERM, 1), (signal.SIGKILL, -9)])
def test_signal_while_writing_leaves_nothing(brief, tmp_path: Path, number: signal.Signals, status: int) -> None:
    out, data = tmp_path / "out", brief.path.read_bytes()
    arguments = ["clean", str(brief.path), "--subject", str(brief.subject), "--fast", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-c", RUN_CLEAN, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout
    assert process.stdout.readline() == "written\n"
    time.sleep(0.1)
    process.send_signal(number)
    _, error = process.communicate(timeout=30)
    assert process.returncode == status
    assert brief.path.read_bytes() == data
    if number == signal.SIGKILL:
        assert len(list(out.iterdir())) == 1
        make_output_folder(out)  # as the next run does
        assert list(out.iterdir()) == []
    else:
        assert error.strip().splitlines()[-1] == "Stopped; no file was left incomplete."
        assert "Traceback" not in error
        assert read_folder(out) == {}
