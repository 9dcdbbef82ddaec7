"""Kill `mocapfix clean --overwrite` at random moments, and check that no output is broken and nothing stays behind.

Most of the moments are within the writing, a small part of a clean: these runs write the result of one cleaning from a
forked process. The others are of the whole command.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from mocapfix import synthetic
from mocapfix.errors import MocapfixError
from mocapfix.files.temporary_files import TEMPORARY_PATTERN
from mocapfix.report.recording import check_recording_complete
from mocapfix.result import CleaningResult

KILLED_TAKE_S = 1.0
COMMAND_SHARE = 0.1
"""of the runs that are of the whole command"""
CLEAN_ARGUMENTS = ("-m", "mocapfix", "clean", "--overwrite", "--out")


def measure_kills(
    folder: Path, count: int, seed: int, report_progress: Callable[[str], None] = lambda _: None
) -> Mapping[str, int]:
    """Kill `count` runs that overwrite the outputs in a folder; return how many were killed, and what was found.

    broken_outputs   outputs that were neither the old nor the new file, changed_inputs  runs after which the input differed
    left_behind      temporary files and folders that were there after the run that follows the last one
    """
    from mocapfix import pipeline

    path, output, random_source = folder / "killed.c3d", folder / "out", random.Random(seed)
    synthetic.write_synthetic_take(path, synthetic.compose_take(0, KILLED_TAKE_S))
    data, command = path.read_bytes(), (sys.executable, *CLEAN_ARGUMENTS, str(output), str(path))
    started = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    command_s = time.perf_counter() - started
    result = pipeline.clean(path)
    result.write(output, overwrite=True)  # imports what the reports need
    started = time.perf_counter()
    outputs = result.write(output, overwrite=True)
    write_s = time.perf_counter() - started
    stable = {
        suffix: each.read_bytes() for suffix, each in outputs.items() if suffix in ("c3d", "bvh", "subject.yaml", "changes.yaml")
    }
    tally = {"runs": 0, "killed": 0, "broken_outputs": 0, "changed_inputs": 0, "most_left_behind": 0}
    for run in range(count):
        if random_source.random() < COMMAND_SHARE:
            is_killed = _kill_command(command, random_source.uniform(0, 1.2 * command_s))
        else:
            is_killed = _kill_writing(result, output, random_source.uniform(0, 1.2 * write_s))
        tally["runs"] += 1
        tally["killed"] += is_killed
        tally["broken_outputs"] += sum(not is_whole(suffix, each, stable) for suffix, each in outputs.items())
        tally["changed_inputs"] += path.read_bytes() != data
        tally["most_left_behind"] = max(tally["most_left_behind"], len(list(output.glob(TEMPORARY_PATTERN))))
        report_progress(f"run {run + 1} of {count}, {tally['killed']} killed, {tally['broken_outputs']} outputs broken")
    result.write(output, overwrite=True)
    names = {each.name for each in outputs.values()}
    return tally | {"left_behind": sum(each.name not in names for each in output.iterdir())}


def is_whole(suffix: str, path: Path, stable: Mapping[str, bytes]) -> bool:
    """Return whether an output is complete.

    stable  the bytes of those outputs that are the same in every run; the others contain the times of the run
    """
    try:
        if suffix in stable:
            return path.read_bytes() == stable[suffix]
        if suffix == "rrd":
            check_recording_complete(path)
        elif suffix.endswith("json"):
            json.loads(path.read_text(encoding="utf-8"))
        elif suffix.endswith("html"):
            return path.read_text(encoding="utf-8").rstrip().endswith("</html>")
    except (OSError, ValueError):
        return False
    return path.stat().st_size > 0


def _kill_command(command: tuple[str, ...], delay_s: float) -> bool:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        process.wait(delay_s)
    except subprocess.TimeoutExpired:
        process.kill()
    return process.wait() == -signal.SIGKILL


def _kill_writing(result: CleaningResult, output: Path, delay_s: float) -> bool:
    child = os.fork()
    if not child:
        try:
            result.write(output, overwrite=True)
        except MocapfixError:
            os._exit(1)
        finally:
            os._exit(0)
    time.sleep(delay_s)
    os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
