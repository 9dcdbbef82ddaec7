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
from mocapfix.bench.damaged_take import DamagedTake
from mocapfix.bench.fault_injection import FAULT_INJECTIONS
from mocapfix.bench.uncertainty import clean_composed_take
from mocapfix.changes import compare_samples
from mocapfix.faults import (
    EXTERNAL_FILL_KINDS,
    JOINED_RELATIONS,
    LABEL_KINDS,
    MISSING_KINDS,
    REPLACED_SAMPLE_KINDS,
    Fault,
    Faults,
    Fragment,
    build_fault_mask,
)
from mocapfix.options import CleanOptions, FillOptions
from mocapfix.report.stage_timer import ProgressCallback
from mocapfix.result import CleaningResult
from mocapfix.stats.runs import find_runs

REPLACED_KINDS = (*REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS)
REFILL_OPTIONS = CleanOptions(fill=FillOptions(refill=True))  # so that straight fills are estimated, too
FaultRow = dict[str, float | None]  # what the table says of a kind


class FaultScore(NamedTuple):
    """How a take with faults came off.

    overlap  (N,) of each fault put in: the samples that are in it and in what was found of it, as a part of those in either;
             NaN where it was not found
    alarms   what was found and not put in;  minutes  of the take
    predicted, true  (S,) metres: of each sample that was changed within the faults, the predicted error and the true one
    """

    overlap: np.ndarray
    false_alarms: list[Fault]
    minutes: float
    predicted_error: np.ndarray
    true_error: np.ndarray


def measure_fault_detection(
    motion_folder: Path | None, take_count: int, progress: ProgressCallback = lambda _: None
) -> dict[str, FaultRow]:
    """-> by kind of INJECTIONS: recall, overlap, false_alarms_per_minute, predicted_mm and true_mm; null where there is nothing
    to tell. Under "all", those of all kinds together, and the false alarms in the same takes when they are sound.

    data  the folder that holds test.npz of motion; None composes takes

    Raises SceneError where less than one take is asked for, ReadError where there is no such motion.
    """
    sounds = list(sound_takes.iterate_sound_takes(motion_folder, take_count))
    scores: dict[str, list[FaultScore]] = {}
    for number, (kind, inject) in enumerate(FAULT_INJECTIONS.items()):
        for n, (name, truth) in enumerate(sounds):
            progress(f"{kind}, {name}")
            stage = DamagedTake(truth, np.random.default_rng([number, n]))
            inject(stage)
            scores.setdefault(kind, []).append(score_take(stage, clean_composed_take(stage.damaged_truth, REFILL_OPTIONS)))
    quiet = []
    for name, truth in sounds:
        progress(f"nothing, {name}")
        stage = DamagedTake(truth, np.random.default_rng(0))
        quiet.append(score_take(stage, clean_composed_take(stage.damaged_truth, REFILL_OPTIONS)))
    said = {kind: summarise_fault_scores(each) for kind, each in scores.items()}
    together = summarise_fault_scores([score for each in scores.values() for score in each])
    return said | {"all": together | {"false_alarms_per_minute": summarise_fault_scores(quiet)["false_alarms_per_minute"]}}


def score_take(damaged_take: DamagedTake, result: CleaningResult) -> FaultScore:
    """-> how what was found and mended compares with what happened."""
    found, minutes = merge_label_exchanges(result).items, damaged_take.frame_count / damaged_take.rate_hz / 60
    struck = build_fault_mask([*damaged_take.injected_faults, *damaged_take.secondary_faults], damaged_take.markers.shape[:2])
    struck[:, damaged_take.marker_count :] = True  # trajectories beside the markers' are there only because they were put in
    alarms = [fault for fault in found if not all(struck[fault.frame_slice, m].any() for m in fault.markers)]
    seen = ~damaged_take.damaged_truth.missing_mask
    overlap = np.array([compute_fault_overlap(fault, found, seen) for fault in damaged_take.injected_faults])
    predicted, true = compute_repair_errors(damaged_take, result)
    return FaultScore(overlap, alarms, minutes, predicted, true)


def merge_label_exchanges(result: CleaningResult) -> Faults:
    """-> the faults found; of exchanges of the same labels, some of which undo others, what comes of them all."""
    sources, own = result.relabelled_take.source_points, result.input_take.source_points
    rings = {tuple(sorted(fault.markers)): fault for fault in result.faults.select_kinds(*LABEL_KINDS)}
    kept = [fault for fault in result.faults.items if fault.kind not in LABEL_KINDS]
    for ring, fault in rings.items():
        carried = sources[:, ring]
        among = (np.sort(carried) == np.sort(own[:, ring])).all(1)
        kept += [replace(fault, first=a, last=b) for a, b in find_runs(among & (carried != own[:, ring]).all(1))]
    return Faults().add_faults(kept)


def compute_fault_overlap(fault: Fault, detected: Iterable[Fault], visible: np.ndarray) -> float:
    """-> 0..1: intersection over union of a fault's samples with those of all that was found of it; NaN where nothing was.

    Samples that are missing do not count, but where the fault is about them.

    seen  (T, M) bool
    """
    of_it = [
        each
        for each in detected
        if each.overlaps(fault) and is_same_kind(each, fault) and set(each.markers) <= set(fault.markers)
    ]
    if {m for each in of_it for m in each.markers} != set(fault.markers):
        return float("nan")
    counts = np.ones_like(visible) if fault.kind in (*MISSING_KINDS, "fragment") else visible
    one, other = build_fault_mask([fault], visible.shape) & counts, build_fault_mask(of_it, visible.shape) & counts
    return float((one & other).sum() / (one | other).sum())


def is_same_kind(detected: Fault, injected: Fault) -> bool:
    """Is what was found of the kind of what was put in?"""
    if isinstance(detected, Fragment) and detected.relation not in JOINED_RELATIONS:
        return False
    return detected.kind == injected.kind or any(
        detected.kind in kinds and injected.kind in kinds for kinds in (MISSING_KINDS, REPLACED_KINDS, LABEL_KINDS)
    )


def compute_repair_errors(damaged_take: DamagedTake, result: CleaningResult) -> tuple[np.ndarray, np.ndarray]:
    """-> metres (S,), (S,): predicted and true error of the samples that were changed within the faults and are there."""
    after, count = result.take, damaged_take.marker_count
    changed = (compare_samples(result.input_take, after) & after.visible)[:, :count] & build_fault_mask(
        damaged_take.injected_faults, damaged_take.markers.shape[:2]
    )[:, :count]
    deviation = np.zeros(changed.shape) if after.sample_sd is None else np.nan_to_num(after.sample_sd[:, :count])
    error = np.linalg.norm(after.markers[:, :count] - damaged_take.true_markers, axis=-1)
    return np.sqrt(3) * deviation[changed], error[changed]


def summarise_fault_scores(scores: list[FaultScore]) -> FaultRow:
    """-> what the table says of several takes with faults of a kind."""
    overlap = np.concatenate([score.overlap for score in scores])
    found = ~np.isnan(overlap)
    predicted, true = (
        np.concatenate(each) for each in zip(*((score.predicted_error, score.true_error) for score in scores), strict=True)
    )
    return {
        "recall": float(found.mean()) if len(found) else None,
        "overlap": float(overlap[found].mean()) if found.any() else None,
        "false_alarms_per_minute": sum(len(score.false_alarms) for score in scores) / sum(score.minutes for score in scores),
        "predicted_mm": 1e3 * float(np.sqrt((predicted**2).mean())) if len(predicted) else None,
        "true_mm": 1e3 * float(np.sqrt((true**2).mean())) if len(true) else None,
    }
