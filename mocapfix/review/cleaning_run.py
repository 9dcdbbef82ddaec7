"""Cleaning a reviewed take again, by the command line in a process of its own."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal

from mocapfix.errors import SceneError
from mocapfix.options import EXTRA_FORMAT_NAMES, RIG_NAMES
from mocapfix.report.stage_timer import STAGE_LINES_VARIABLE, parse_stage_line
from mocapfix.review.take_files import CleanedTake

MAX_MESSAGE_LENGTH = 1000
END_LIMIT_S = 5.0
OUTPUT_FLAGS = {"--also": EXTRA_FORMAT_NAMES, "--bvh-for": RIG_NAMES}


@dataclass(frozen=True)
class RunStatus:
    """How far a cleaning is.

    stage    that it is in, while it runs
    message  the sentence of its error
    """

    state: Literal["idle", "running", "done", "failed"] = "idle"
    stage: str = ""
    message: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the status as plain data."""
        return asdict(self)


class CleaningRun:
    """A running `mocapfix clean`, which replaces the outputs when it has written all of them.

    report  called with each new status, in a thread
    """

    def __init__(self, command: Sequence[str], folder: os.PathLike[str], report: Callable[[RunStatus], None]) -> None:
        self._report, self._is_cancelled = report, False
        self._process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={**os.environ, STAGE_LINES_VARIABLE: "1"},
            text=True,
            encoding="utf-8",
            errors="replace",
        )
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """End the run; the outputs stay as they were."""
        self._is_cancelled = True
        self._process.terminate()
        try:
            self._process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def _follow(self) -> None:
        assert self._process.stderr is not None
        messages: list[str] = []
        for line in self._process.stderr:
            if stage := parse_stage_line(line):
                self._report(RunStatus("running", stage))
            elif line.strip():
                messages.append(line.strip())
        if not self._process.wait():
            self._report(RunStatus("done"))
        elif self._is_cancelled:
            self._report(RunStatus("failed", message="The cleaning was stopped; the outputs are unchanged."))
        else:
            text = " ".join(messages)[-MAX_MESSAGE_LENGTH:]
            self._report(RunStatus("failed", message=text or "The cleaning ended without a message; the outputs are unchanged."))


def build_clean_command(
    take: CleanedTake, subjects: Sequence[CleanedTake], formats: Sequence[str], rigs: Sequence[str]
) -> list[str]:
    """Return the command that cleans a take again in its folder, with the changes files of all its subjects.

    formats, rigs  that are written as well as those of the cleaning before

    Raises SceneError if there is no such format or rig.
    """
    arguments = take.arguments
    requested = {"--also": formats, "--bvh-for": rigs}
    for flag, names in requested.items():
        if unknown := [name for name in names if name not in OUTPUT_FLAGS[flag]]:
            raise SceneError(f"{unknown[0]}: cannot be exported; choose of {', '.join(OUTPUT_FLAGS[flag])}.")
        present = list_values(arguments, flag)
        arguments += [argument for name in dict.fromkeys(names) if name not in present for argument in (flag, name)]
    changes = [argument for each in subjects for argument in ("--changes", each.changes_path.name)]
    return [sys.executable, "-P", "-m", "mocapfix", "clean", *arguments, *changes, "--out", ".", "--overwrite"]


def list_values(arguments: Sequence[str], flag: str) -> list[str]:
    """Return all values of a flag that can be repeated."""
    return [value for argument, value in pairwise(arguments) if argument == flag]


def explain_why_not(take: CleanedTake) -> str:
    """Return why a take cannot be cleaned again from here; "" if it can."""
    if not take.arguments:
        return "The report does not say how the take was cleaned; clean it once more on the command line."
    if take.input_path is None:
        return f"The input file {take.arguments[0]} is not there; put it back, or clean the take again on the command line."
    return ""
