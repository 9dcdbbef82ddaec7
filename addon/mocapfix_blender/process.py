"""mocapfix as a process of its own: start it, follow its stages, cancel it, and pass on its error as one sentence."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

STAGE_LINES_VARIABLE = "MOCAPFIX_STAGE_LINES"
"""environment variable that makes mocapfix write a line at the beginning of each stage"""
STAGE_LINE_PREFIX = "stage: "
COMPILATION_TEXT = "Compiling the kernels"
STAGES = {
    "read": (0.0, "reading"),
    "label": (0.05, "labelling"),
    "detect": (0.1, "detecting faults"),
    "calibrate": (0.2, "calibrating the body"),
    "initialise": (0.35, "finding first poses"),
    "solve": (0.45, "solving the body"),
    "contacts": (0.7, "holding feet"),
    "fill": (0.75, "filling gaps"),
    "retarget": (0.8, "retargeting"),
    "write": (0.9, "writing"),
    "show": (0.95, "writing the report"),
}
"""the share of the work that is done when a stage begins, and the stage in words"""
STOP_S = 5.0
"""how long a cancelled process may take to stop before it is killed"""
POLL_S = 0.05
"""interval between two looks at the process where nothing else waits for it"""
EXIT_USAGE = 2


class ProcessError(Exception):
    """mocapfix could not be started or has failed. The message is one sentence for the user."""


def find_executable(given: str) -> str:
    """Return the path of mocapfix.

    Args:
        given: Its path or name from the preferences; empty for `mocapfix` on PATH.

    Raises:
        ProcessError: If it is not there.
    """
    given = str(Path(given.strip()).expanduser()) if given.strip() else ""
    found = shutil.which(given or "mocapfix")
    if found:
        return found
    if given:
        raise ProcessError(
            f"{given} is not a program that can be started; correct the path of mocapfix in the add-on's preferences."
        )
    raise ProcessError("mocapfix was not found; install it and give the path of its program in the add-on's preferences.")


def make_temporary_folder() -> Path:
    """Make a folder for the files of one process."""
    return Path(tempfile.mkdtemp(prefix="mocapfix-blender-"))


class CleaningProcess:
    """A running `mocapfix clean`, which writes its outputs into a temporary folder unless its arguments name another."""

    def __init__(self, executable: str, arguments: list[str], temporary: Path, output_folder: Path | None = None) -> None:
        """Start the process.

        Args:
            arguments: Those after `clean`, without the output folder.
            temporary: Folder of `make_temporary_folder`, which is removed with the process.
            output_folder: Folder for the outputs, in which files are replaced; None for a temporary one.

        Raises:
            ProcessError: If it cannot be started.
        """
        self._temporary = temporary
        self.output_folder = output_folder or self._temporary / "out"
        self.stage_text = "starting"
        self.fraction = 0.0
        self._read_count = 0
        # Files instead of pipes: nothing has to be read for the process to go on.
        self._output_path, self._error_path = self._temporary / "output.txt", self._temporary / "errors.txt"
        environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        environment |= {STAGE_LINES_VARIABLE: "1", "PYTHONIOENCODING": "utf-8", "NO_COLOR": "1"}
        command = [executable, "clean", *arguments, "--out", str(self.output_folder), "--overwrite"]
        try:
            with self._output_path.open("wb") as output, self._error_path.open("wb") as errors:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=errors,
                    env=environment,
                    start_new_session=True,
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )
        except OSError as error:
            self.remove_files()
            raise ProcessError(
                f"{executable} cannot be started ({error.strerror}); correct the path of mocapfix in the add-on's preferences."
            ) from error

    def poll(self) -> bool:
        """Update the stage; return whether the process has ended."""
        has_ended = self._process.poll() is not None
        lines = self._read_errors().splitlines()
        for line in lines[self._read_count :]:
            if line.startswith(COMPILATION_TEXT):
                self.stage_text = "compiling (first run on this machine)"
            elif line.startswith(STAGE_LINE_PREFIX):
                fraction, self.stage_text = STAGES.get(
                    stage := line.removeprefix(STAGE_LINE_PREFIX).strip(), (self.fraction, stage)
                )
                self.fraction = max(self.fraction, fraction)
        self._read_count = len(lines)
        return has_ended

    def wait(self) -> None:
        """Wait until the process has ended."""
        while not self.poll():
            time.sleep(POLL_S)

    def cancel(self) -> None:
        """Stop the process and all that it has started, and remove the temporary files."""
        if self._process.poll() is None:
            self._signal(signal.SIGTERM)
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._signal(getattr(signal, "SIGKILL", signal.SIGTERM))
                self._process.wait()
        self.remove_files()

    def check_result(self) -> None:
        """Raise ProcessError with mocapfix's own sentence if the ended process has failed."""
        status, errors = self._process.returncode, self._read_errors()
        if status == 0:
            return
        if status == EXIT_USAGE and (unknown := re.search(r"Unrecognized options?:\s*(--[\w-]+)", errors)):
            raise ProcessError(
                f"mocapfix does not know the option {unknown[1]}: update it if the add-on is newer, or correct the option."
            )
        sentences = [line.strip() for line in errors.splitlines() if line.strip() and not _is_progress(line)]
        if "Traceback" in errors:
            raise ProcessError(f"mocapfix failed unexpectedly ({sentences[-1]}); update it, or report this with the take.")
        if not sentences:
            raise ProcessError(f"mocapfix stopped with status {status}; check the path in the add-on's preferences.")
        if status == EXIT_USAGE:
            sentences = [text for line in sentences if (text := line.strip("│╭╮╰╯─ "))]
        raise ProcessError(" ".join(sentences))

    def remove_files(self) -> None:
        """Remove the temporary files; outputs in another folder stay."""
        shutil.rmtree(self._temporary, ignore_errors=True)

    def _read_errors(self) -> str:
        return self._error_path.read_text(encoding="utf-8", errors="replace") if self._error_path.exists() else ""

    def _signal(self, number: int) -> None:
        if sys.platform == "win32":
            subprocess.run(["taskkill", "/F", "/T", "/PID", str(self._process.pid)], capture_output=True, check=False)
        else:
            os.killpg(self._process.pid, number)


def _is_progress(line: str) -> bool:
    return line.startswith((STAGE_LINE_PREFIX, COMPILATION_TEXT))
