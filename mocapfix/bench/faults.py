"""Faults put into sound takes, and which of them the whole pipeline finds: how many, over which samples, and how well mended.

A take with faults of one kind is written as a file and cleaned like any other. What was put in counts as found where a fault of
its kind, and of no other markers, meets it. What is missing is one kind, what is replaced another: whether samples that are off
are called a ghost or a few spikes makes no difference to them. So do exchanges of labels, for a while or for the whole take.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix.bench import sound_takes
from mocapfix.bench.injections import INJECTIONS
from mocapfix.bench.stage import Stage
from mocapfix.bench.uncertainty import cleaned
from mocapfix.changes import differs
from mocapfix.clock import Progress
from mocapfix.faults import LABELS, MISSING, OTHERS_FILLS, REPLACED, Fault, Faults, Fragment, over
from mocapfix.fill import FillOptions
from mocapfix.mend.fragments import JOINED
from mocapfix.result import Result
from mocapfix.take import runs

ESTIMATED = (*REPLACED, *OTHERS_FILLS)
REFILL = FillOptions(refill=True)  # so that straight fills are estimated, too
Row = dict[str, float | None]  # what the table says of a kind


class Score(NamedTuple):
    """How a take with faults came off.

    overlap  (N,) of each fault put in: the samples that are in it and in what was found of it, as a part of those in either;
             NaN where it was not found
    alarms   what was found and not put in;  minutes  of the take
    predicted, true  (S,) metres: of each sample that was changed within the faults, the predicted error and the true one
    """

    overlap: np.ndarray
    alarms: list[Fault]
    minutes: float
    predicted: np.ndarray
    true: np.ndarray


def measure(data: Path | None, takes: int, progress: Progress = lambda _: None) -> dict[str, Row]:
    """-> by kind of INJECTIONS: recall, overlap, false_alarms_per_minute, predicted_mm and true_mm; null where there is nothing
    to tell. Under "all", those of all kinds together, and the false alarms in the same takes when they are sound.

    data  the folder that holds test.npz of motion; None composes takes

    Raises SceneError where less than one take is asked for, ReadError where there is no such motion.
    """
    sounds = list(sound_takes.sound(data, takes))
    scores: dict[str, list[Score]] = {}
    for number, (kind, inject) in enumerate(INJECTIONS.items()):
        for n, (name, truth) in enumerate(sounds):
            progress(f"{kind}, {name}")
            stage = Stage(truth, np.random.default_rng([number, n]))
            inject(stage)
            scores.setdefault(kind, []).append(scored(stage, cleaned(stage.damaged, REFILL)))
    quiet = []
    for name, truth in sounds:
        progress(f"nothing, {name}")
        stage = Stage(truth, np.random.default_rng(0))
        quiet.append(scored(stage, cleaned(stage.damaged, REFILL)))
    said = {kind: row(each) for kind, each in scores.items()}
    together = row([score for each in scores.values() for score in each])
    return said | {"all": together | {"false_alarms_per_minute": row(quiet)["false_alarms_per_minute"]}}


def scored(stage: Stage, result: Result) -> Score:
    """-> how what was found and mended compares with what happened."""
    found, minutes = net(result).items, stage.frames / stage.rate / 60
    struck = over([*stage.put, *stage.beside], stage.markers.shape[:2])
    struck[:, stage.count :] = True  # trajectories beside the markers' are there only because they were put in
    alarms = [fault for fault in found if not all(struck[fault.frames, m].any() for m in fault.markers)]
    seen = ~stage.damaged.struck
    overlap = np.array([overlapping(fault, found, seen) for fault in stage.put])
    predicted, true = errors(stage, result)
    return Score(overlap, alarms, minutes, predicted, true)


def net(result: Result) -> Faults:
    """-> the faults found; of exchanges of the same labels, some of which undo others, what comes of them all."""
    sources, own = result.labelled.sources, result.before.sources
    rings = {tuple(sorted(fault.markers)): fault for fault in result.faults.of(*LABELS)}
    kept = [fault for fault in result.faults.items if fault.kind not in LABELS]
    for ring, fault in rings.items():
        carried = sources[:, ring]
        among = (np.sort(carried) == np.sort(own[:, ring])).all(1)
        kept += [replace(fault, first=a, last=b) for a, b in runs(among & (carried != own[:, ring]).all(1))]
    return Faults().with_more(kept)


def overlapping(fault: Fault, found: Iterable[Fault], seen: np.ndarray) -> float:
    """-> 0..1: intersection over union of a fault's samples with those of all that was found of it; NaN where nothing was.

    Samples that are missing do not count, but where the fault is about them.

    seen  (T, M) bool
    """
    of_it = [each for each in found if each.meets(fault) and alike(each, fault) and set(each.markers) <= set(fault.markers)]
    if {m for each in of_it for m in each.markers} != set(fault.markers):
        return float("nan")
    counts = np.ones_like(seen) if fault.kind in (*MISSING, "fragment") else seen
    one, other = over([fault], seen.shape) & counts, over(of_it, seen.shape) & counts
    return float((one & other).sum() / (one | other).sum())


def alike(found: Fault, put: Fault) -> bool:
    """Is what was found of the kind of what was put in?"""
    if isinstance(found, Fragment) and found.relation not in JOINED:
        return False
    return found.kind == put.kind or any(found.kind in kinds and put.kind in kinds for kinds in (MISSING, ESTIMATED, LABELS))


def errors(stage: Stage, result: Result) -> tuple[np.ndarray, np.ndarray]:
    """-> metres (S,), (S,): predicted and true error of the samples that were changed within the faults and are there."""
    after, count = result.take, stage.count
    changed = (differs(result.before, after) & after.seen)[:, :count] & over(stage.put, stage.markers.shape[:2])[:, :count]
    deviation = np.zeros(changed.shape) if after.deviation is None else np.nan_to_num(after.deviation[:, :count])
    error = np.linalg.norm(after.markers[:, :count] - stage.true, axis=-1)
    return np.sqrt(3) * deviation[changed], error[changed]


def row(scores: list[Score]) -> Row:
    """-> what the table says of several takes with faults of a kind."""
    overlap = np.concatenate([score.overlap for score in scores])
    found = ~np.isnan(overlap)
    predicted, true = (np.concatenate(each) for each in zip(*((score.predicted, score.true) for score in scores), strict=True))
    return {
        "recall": float(found.mean()) if len(found) else None,
        "overlap": float(overlap[found].mean()) if found.any() else None,
        "false_alarms_per_minute": sum(len(score.alarms) for score in scores) / sum(score.minutes for score in scores),
        "predicted_mm": 1e3 * float(np.sqrt((predicted**2).mean())) if len(predicted) else None,
        "true_mm": 1e3 * float(np.sqrt((true**2).mean())) if len(true) else None,
    }
