"""Starts of the solve compared: where they lie, how many iterations they cost, and in which frames the solve ends wrong.

Where the truth is known, it is a start like any other, `truth`: what ends wrong from there, too, is no start's fault.
`alone` is the first solve, of each frame from its start (`previous` starts where the frame before ended); what has no such word
is the whole solve, as `mocapfix clean --prior none` does it. What is wrong, see start_ends; on which takes, see start_takes.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix import initialise, prior
from mocapfix.bench import start_takes
from mocapfix.bench.start_ends import Found, Way, found, told_of, wrong
from mocapfix.bench.start_takes import Case
from mocapfix.clock import Progress
from mocapfix.motion import Motion
from mocapfix.scenes import STARTS
from mocapfix.skeleton import cmu31

TRUTH = "truth"
SEEDS = range(8)  # people on whom no constant was set
REPEATS = 3  # of which the median is the time
SPARED = 4  # one performance of so many is also damaged, for limbs that are lost take long to put back


class Outcome(NamedTuple):
    """What became of a take, and which of its frames (T,) ended wrong, after the first solve and after all of it; and which of
    the latter ends right from the truth.
    """

    case: Case
    found: Found
    wrong_alone: np.ndarray
    wrong: np.ndarray
    astray: np.ndarray


def run(
    ways: Sequence[str] = STARTS,
    data: Path | None = None,
    captures: Path | None = None,
    seeds: Iterable[int] = SEEDS,
    repeats: int = REPEATS,
    progress: Progress = lambda _: None,
) -> dict[str, dict[str, dict]]:
    """-> set of takes -> way -> `row`.

    ways      names of starts, out of scenes.STARTS
    data      a folder with test.npz, motion of people whom no model has seen, and skeletons.json
    captures  a folder of C3D files, of which the truth is not known
    seeds     of the composed takes
    repeats   how often each take is timed

    Raises ReadError where a folder does not hold what it should.
    """
    starts: dict[str, Way] = {name: partial(started, by=name) for name in ways}
    said = {}
    for name, cases in sets(data, captures, seeds).items():
        said[name] = compared(cases, starts, repeats, lambda take, name=name: progress(f"{name}: {take}"))
    return said


def started(case: Case, by: str) -> Motion:
    """-> the start of a take that mocapfix has under this name."""
    body = cmu31()
    return initialise.motion(case.worn, case.subject, body, prior.load("mean-pose", body.skeleton), by)


def from_truth(case: Case) -> dict[str, Way]:
    """-> the start from the truth, by its name; none where nobody knows it."""
    motion = case.motion
    return {} if motion is None else {TRUTH: lambda _: motion}


def sets(data: Path | None, captures: Path | None, seeds: Iterable[int]) -> dict[str, Iterable[Case]]:
    """-> the takes of each set, as `run` is told."""
    found: dict[str, Iterable[Case]] = {"composed": start_takes.composed(seeds)}
    if data is not None:
        whole = list(start_takes.whole(data))
        found["performed"] = whole
        found |= {f"performed, {name}": start_takes.damaged(whole[::SPARED], lost) for name, lost in start_takes.LOSSES.items()}
        found["performed, a ghost"] = start_takes.with_ghosts(whole[::SPARED])
    if captures is not None:
        found["captures"] = start_takes.captured(captures)
    return found


def compared(
    cases: Iterable[Case], ways: dict[str, Way], repeats: int = REPEATS, progress: Progress = lambda _: None
) -> dict[str, dict]:
    """-> way -> the `row` of all takes; also from the truth, where that is known."""
    outcomes: dict[str, list[Outcome]] = {}
    for case in cases:
        progress(case.name)
        came = {name: found(case, way, repeats) for name, way in (from_truth(case) | ways).items()}
        alone = wrong(case, {name: each.alone for name, each in came.items()})
        whole = wrong(case, {name: each.whole for name, each in came.items()})
        best = whole.get(TRUTH, np.zeros(case.worn.frames, bool))
        for name, each in came.items():
            outcomes.setdefault(name, []).append(Outcome(case, each, alone[name], whole[name], whole[name] & ~best))
    return {name: row(each) for name, each in outcomes.items()}


def row(outcomes: list[Outcome]) -> dict:
    """-> over all takes: `frames`, how many end `wrong`, are `astray` (wrong, and right from the truth), end `wrong_alone` or are
    `unconverged`; `iterations` and `iterations_alone` of a frame on average; where frames start, `start_markers_mm` from those
    seen on average and `start_joints_mm` from the true ones that markers tell of (None where nobody knows them);
    `start_seconds` and `seconds`, of the start alone and with the solve; `wrong_in`, the takes with frames that end wrong, and
    how many.
    """
    came = [each.found for each in outcomes]
    return {
        "frames": sum(each.case.worn.frames for each in outcomes),
        "wrong": int(sum(each.wrong.sum() for each in outcomes)),
        "astray": int(sum(each.astray.sum() for each in outcomes)),
        "wrong_alone": int(sum(each.wrong_alone.sum() for each in outcomes)),
        "unconverged": int(sum(each.unconverged.sum() for each in came)),
        "iterations": float(np.concatenate([each.whole.iterations for each in came]).mean()),
        "iterations_alone": float(np.concatenate([each.alone.iterations for each in came]).mean()),
        "start_markers_mm": 1e3 * float(np.nanmean(np.concatenate([each.markers for each in came]))),
        "start_joints_mm": joints_mm(outcomes),
        "start_seconds": sum(each.seconds[0] for each in came),
        "seconds": sum(each.seconds[1] for each in came),
        "wrong_in": {each.case.name: int(each.wrong.sum()) for each in outcomes if each.wrong.any()},
    }


def joints_mm(outcomes: list[Outcome]) -> float | None:
    """-> mm: how far from the truth frames start, on average over the joints that markers tell of."""
    known = [(each.case, each.found.joints) for each in outcomes if each.case.joints is not None]
    if not known:
        return None
    return 1e3 * float(np.concatenate([np.linalg.norm(at - case.joints, axis=-1)[told_of(case)] for case, at in known]).mean())
