"""Run many generated cases in child processes with limits on time and memory, and collect what went wrong as findings.

A child runs cases one after the other until one of them exceeds a limit or ends the process; the next child continues after it.
Each case is determined by its seed, so a finding is repeated by running its seed alone.

Runs of `mocapfix clean --overwrite` are also killed at random moments: no output may be broken and nothing may stay behind. Most
of them only write the result of one cleaning, from a forked process; the others are of the whole command.
"""

import json
import multiprocessing
import multiprocessing.connection
import os
import random
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, Protocol, runtime_checkable

from mocapfix.errors import MocapfixError
from mocapfix.io.files import TEMPORARY_PATTERN, make_output_folder
from mocapfix.report.recording import check_recording_complete
from mocapfix.result import CleaningResult
from mocapfix.synthetic import compose_take, write_synthetic_take

FindingKind = Literal["exception", "message", "slow", "timeout", "memory", "crash"]
REFUSED = "refused"
POLL_S = 0.1
START_S = 300.0  # time that a child may take to start and to compile what its first case needs
HEAP_ALLOWANCE_BYTES = 1_000_000_000
FILE_ALLOWANCE = 4  # memory that a case may take: this many times its file, and HEAP_ALLOWANCE_BYTES
MAX_FRAME_LINES = 12  # lines of a traceback that a finding keeps


@runtime_checkable
class FuzzCase(Protocol):
    """One generated input, and how to try it."""

    @property
    def size_bytes(self) -> int:
        """Size of the input."""
        ...

    def save(self, folder: Path) -> None:
        """Write the input into a folder, for whoever looks into a finding."""
        ...

    def run(self, folder: Path) -> str:
        """Try the input, with a folder for temporary files. Return in a word what came of it, or raise."""
        ...


CaseBuilder = Callable[[int], FuzzCase]  # a function of a seed; it must be importable by name, since children import it


@dataclass(frozen=True)
class FuzzLimits:
    """What a case may take."""

    slow_s: float = 5.0  # processor time from which a case is a finding
    timeout_s: float = 60.0  # time by the clock after which the child is ended


@dataclass(frozen=True)
class FuzzFinding:
    """A case that broke a rule: which seed, what kind, the end of the traceback or a sentence."""

    seed: int
    kind: FindingKind
    text: str


@dataclass
class FuzzTally:
    """What a run of cases came to."""

    outcomes: Counter[str] = field(default_factory=lambda: Counter[str]())  # number of cases by what came of them
    findings: list[FuzzFinding] = field(default_factory=lambda: list[FuzzFinding]())
    slowest_s: float = 0.0  # the longest processor time of a case, and its seed
    slowest_seed: int = -1
    seconds: float = 0.0

    def to_json(self) -> Mapping[str, Any]:
        """Return the tally as data for JSON."""
        return {
            "cases": sum(self.outcomes.values()),
            "outcomes": dict(sorted(self.outcomes.items())),
            "findings": [vars(each) for each in self.findings],
            "slowest_s": round(self.slowest_s, 3),
            "slowest_seed": self.slowest_seed,
            "seconds": round(self.seconds, 1),
        }


def run_cases(
    build_case: CaseBuilder,
    seeds: range,
    limits: FuzzLimits,
    findings_folder: Path | None = None,
    report_progress: Callable[[str], None] = lambda _: None,
) -> FuzzTally:
    """Run the cases of all seeds in child processes, one child at a time.

    Args:
        findings_folder: Where the input and the text of each finding are written; None for nowhere.
    """
    tally, started, next_seed = FuzzTally(), time.perf_counter(), seeds.start
    while next_seed < seeds.stop:
        for seed, outcome, seconds, finding in _run_child(build_case, range(next_seed, seeds.stop), limits):
            next_seed = seed + 1
            tally.outcomes[outcome] += 1
            if seconds > tally.slowest_s:
                tally.slowest_s, tally.slowest_seed = seconds, seed
            if finding:
                tally.findings.append(finding)
                if findings_folder:
                    save_finding(findings_folder, build_case(seed), finding)
            tally.seconds = time.perf_counter() - started
            if finding or seed % 50 == 0:
                report_progress(f"{next_seed - seeds.start:,} of {len(seeds):,}, {len(tally.findings)} findings")
    return tally


def save_finding(folder: Path, case: FuzzCase, finding: FuzzFinding) -> None:
    """Write the input of a case and what went wrong into a folder of its own."""
    own = folder / f"{finding.kind}-{finding.seed}"
    make_output_folder(own)
    case.save(own)
    (own / "finding.json").write_text(json.dumps(vars(finding), indent=1) + "\n", encoding="utf-8")


Result = tuple[int, str, float, FuzzFinding | None]


def _run_child(build_case: CaseBuilder, seeds: range, limits: FuzzLimits) -> Iterator[Result]:
    """Yield seed, outcome, processor seconds and finding of each case, until all have run or the child has ended."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_run_in_child, args=(build_case, seeds, limits, sender), daemon=True)
    child.start()
    sender.close()
    seed, deadline = seeds.start, time.monotonic() + START_S
    try:
        while seed < seeds.stop:
            message = _receive(receiver, child, deadline)
            if message == "ready":
                deadline = time.monotonic() + limits.timeout_s
            elif isinstance(message, tuple):
                yield message
                seed, deadline = message[0] + 1, time.monotonic() + limits.timeout_s
            else:
                is_late = message == "late"
                problem = f"no end after {limits.timeout_s:g} s" if is_late else f"exit status {child.exitcode}"
                kind: FindingKind = "timeout" if is_late else "crash"
                yield seed, kind, limits.timeout_s if is_late else 0.0, FuzzFinding(seed, kind, problem)
                return
    finally:
        child.kill()
        child.join()


def _receive(receiver: "multiprocessing.connection.Connection[Any, Any]", child: BaseProcess, deadline: float) -> Any:
    """Return the next message of a child; "late" or "ended" if none comes."""
    while not receiver.poll(POLL_S):
        if time.monotonic() > deadline:
            return "late"
        if not child.is_alive() and not receiver.poll():
            child.join()
            return "ended"
    try:
        return receiver.recv()
    except EOFError:
        child.join()
        return "ended"


def _run_in_child(
    build_case: CaseBuilder, seeds: range, limits: FuzzLimits, sender: "multiprocessing.connection.Connection[Any, Any]"
) -> None:
    with TemporaryDirectory() as folder:
        is_warm = False
        for seed in seeds:
            case = build_case(seed)
            if not is_warm:  # imports and compilation are not the case's own
                try_case(case, seed, limits, Path(folder), is_limited=False)
                sender.send("ready")
                is_warm = True
            sender.send((seed, *try_case(case, seed, limits, Path(folder))))


def try_case(
    case: FuzzCase, seed: int, limits: FuzzLimits, folder: Path, is_limited: bool = True
) -> tuple[str, float, FuzzFinding | None]:
    """Run one case in this process; return its outcome, its processor seconds and its finding, if it broke a rule.

    Args:
        is_limited: Limit the memory of this process while it runs.
    """
    started = time.process_time()
    allowed = _limit_memory(FILE_ALLOWANCE * case.size_bytes + HEAP_ALLOWANCE_BYTES) if is_limited else None
    kind: FindingKind | None = None
    text = ""
    try:
        outcome = case.run(folder)
    except MocapfixError as error:
        outcome, text = REFUSED, str(error)
        if not text.strip() or "\n" in text or "Traceback" in text:
            kind = "message"
    except MemoryError:
        kind, text = "memory", _shorten_traceback()
        outcome = kind
    except Exception:
        kind, text = "exception", _shorten_traceback()
        outcome = kind
    finally:
        if allowed:
            resource.setrlimit(resource.RLIMIT_AS, allowed)
    seconds = time.process_time() - started
    if kind is None and seconds > limits.slow_s and is_limited:
        kind, text = "slow", f"{seconds:.1f} s of processor time"
    return outcome, seconds, FuzzFinding(seed, kind, text) if kind else None


def _limit_memory(extra_bytes: int) -> tuple[int, int]:
    """Let this process take at most so many bytes more than it has. Return the limits that it had."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    allowed = pages * resource.getpagesize() + extra_bytes
    hard = before[1]
    resource.setrlimit(resource.RLIMIT_AS, (allowed if hard == resource.RLIM_INFINITY else min(allowed, hard), hard))
    return before


def _shorten_traceback() -> str:
    return "\n".join(traceback.format_exc().rstrip().splitlines()[-MAX_FRAME_LINES:])


KILLED_TAKE_S = 1.0
COMMAND_SHARE = 0.1  # of the runs that are of the whole command
CLEAN_ARGUMENTS = ("-m", "mocapfix", "clean", "--overwrite", "--out")


def measure_kills(
    folder: Path, count: int, seed: int, report_progress: Callable[[str], None] = lambda _: None
) -> Mapping[str, int]:
    """Kill `count` runs that overwrite the outputs in a folder; return how many were killed, and what was found.

    - `broken_outputs`: outputs that were neither the old nor the new file
    - `changed_inputs`: runs after which the input differed
    - `left_behind`: temporary files and folders that were there after the run that follows the last one
    """
    from mocapfix import pipeline

    path, output, random_source = folder / "killed.c3d", folder / "out", random.Random(seed)
    write_synthetic_take(path, compose_take(0, KILLED_TAKE_S))
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

    Args:
        stable: The bytes of those outputs that are the same in every run; the others contain the times of the run.
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
