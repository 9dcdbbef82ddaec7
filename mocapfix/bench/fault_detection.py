"""Benchmark of fault detection: recall, overlap and false alarms of the pipeline on takes with injected faults, and repair
errors.

A take with faults of one kind is written to a file and cleaned. An injected fault counts as found if a detected fault of its
kind, and of no other markers, overlaps it. Kinds are compared in groups: missing samples, replaced samples (a ghost may be
reported as spikes), and label errors, whether temporary or permanent.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.bench.composed_cleaning import clean_composed_take
from mocapfix.bench.damaged_take import DamagedTake
from mocapfix.bench.fault_injection import FAULT_INJECTIONS
from mocapfix.bench.sound_takes import SOUND_TAKE_RATE_HZ, iterate_sound_takes, remove_damage
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
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import compose_take

REPLACED_KINDS = (*REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS)
REFILL_OPTIONS = CleanOptions(fill=FillOptions(refill=True))  # other programs' fills are estimated as well
FAULT_MIXES: dict[str, tuple[str, ...]] = {
    "samples": ("gap", "flicker", "spike", "jitter"),
    "fills": ("stuck", "straight", "ghost"),
    "labels": ("swap", "ring", "fragment"),
    "placements": ("moved", "drift"),
    "whole takes": ("mislabelled",),
}
"""kinds of FAULT_INJECTIONS that the short version of the benchmark injects into one take"""
MIXED_TAKE_S = 10.0  # duration of a take of the short version
FaultRow = dict[str, float | None]  # a row of the benchmark's table


class FaultScore(NamedTuple):
    """The detection and repair of the faults of one take.

    overlap          (N,) intersection over union of the samples of each injected fault and those found of it; NaN if not found
    false_alarms     detected faults that were not injected
    minutes          duration of the take
    predicted_error  (S,) metres: predicted error of each sample that was changed within the injected faults
    true_error       (S,) metres
    """

    overlap: np.ndarray
    false_alarms: list[Fault]
    minutes: float
    predicted_error: np.ndarray
    true_error: np.ndarray


def measure_fault_detection(
    motion_folder: Path | None, take_count: int, progress: ProgressCallback = lambda _: None
) -> dict[str, FaultRow]:
    """Return the scores by kind of FAULT_INJECTIONS; a score without data is None.

    The scores are recall, overlap, false_alarms_per_minute, predicted_mm and true_mm. "all" has those of all kinds together, and
    the false alarms in the same takes without faults.

    motion_folder  holds test.npz of motion; None for composed takes

    Raises SceneError if `take_count` is less than one, ReadError if there is no such motion.
    """
    sound_takes = list(iterate_sound_takes(motion_folder, take_count))
    scores: dict[str, list[FaultScore]] = {}
    for number, (kind, inject) in enumerate(FAULT_INJECTIONS.items()):
        for n, (name, truth) in enumerate(sound_takes):
            progress(f"{kind}, {name}")
            damaged_take = DamagedTake(truth, np.random.default_rng([number, n]))
            inject(damaged_take)
            result = clean_composed_take(damaged_take.damaged_truth, REFILL_OPTIONS)
            scores.setdefault(kind, []).append(score_take(damaged_take, result))
    sound_scores: list[FaultScore] = []
    for name, truth in sound_takes:
        progress(f"no faults, {name}")
        sound_take = DamagedTake(truth, np.random.default_rng(0))
        sound_scores.append(score_take(sound_take, clean_composed_take(sound_take.damaged_truth, REFILL_OPTIONS)))
    return summarise_fault_kinds(scores, sound_scores)


def measure_mixed_faults(progress: ProgressCallback = lambda _: None) -> dict[str, FaultRow]:
    """Return the scores of the short version, as `measure_fault_detection` does: one take for each of FAULT_MIXES."""
    scores: dict[str, list[FaultScore]] = {}
    sound_scores: list[FaultScore] = []
    for seed, (name, kinds) in enumerate(FAULT_MIXES.items()):
        progress(name)
        truth = remove_damage(compose_take(seed, MIXED_TAKE_S, SOUND_TAKE_RATE_HZ, asymmetric=True))
        damaged_take = DamagedTake(truth, np.random.default_rng(seed))
        for kind in kinds:
            FAULT_INJECTIONS[kind](damaged_take)
        scores[name] = [score_take(damaged_take, clean_composed_take(damaged_take.damaged_truth, REFILL_OPTIONS))]
        if not sound_scores:
            sound_scores = [
                score_take(DamagedTake(truth, np.random.default_rng(seed)), clean_composed_take(truth, REFILL_OPTIONS))
            ]
    return summarise_fault_kinds(scores, sound_scores)


def summarise_fault_kinds(scores: dict[str, list[FaultScore]], sound_scores: list[FaultScore]) -> dict[str, FaultRow]:
    """Return the row of each kind, and "all" with those of all kinds together and the false alarms in takes without faults."""
    rows = {kind: summarise_fault_scores(each) for kind, each in scores.items()}
    total = summarise_fault_scores([score for each in scores.values() for score in each])
    alarms = summarise_fault_scores(sound_scores)["false_alarms_per_minute"]
    return rows | {"all": total | {"false_alarms_per_minute": alarms}}


def score_take(damaged_take: DamagedTake, result: CleaningResult) -> FaultScore:
    """Return the comparison of detected and injected faults."""
    detected, minutes = merge_label_exchanges(result).items, damaged_take.frame_count / damaged_take.rate_hz / 60
    injected = [*damaged_take.injected_faults, *damaged_take.secondary_faults]
    has_fault = build_fault_mask(injected, damaged_take.markers.shape[:2])
    has_fault[:, damaged_take.marker_count :] = True  # additional trajectories exist only because they were injected
    alarms = [fault for fault in detected if not all(has_fault[fault.frame_slice, m].any() for m in fault.markers)]
    visible = ~damaged_take.damaged_truth.missing_mask
    overlap = np.array([compute_fault_overlap(fault, detected, visible) for fault in damaged_take.injected_faults])
    predicted_error, true_error = compute_repair_errors(damaged_take, result)
    return FaultScore(overlap, alarms, minutes, predicted_error, true_error)


def merge_label_exchanges(result: CleaningResult) -> Faults:
    """Return the detected faults, with exchanges of the same labels replaced by their net effect, since some revert others."""
    sources, own_sources = result.relabelled_take.source_points, result.input_take.source_points
    cycles = {tuple(sorted(fault.markers)): fault for fault in result.faults.select_kinds(*LABEL_KINDS)}
    merged = [fault for fault in result.faults.items if fault.kind not in LABEL_KINDS]
    for cycle, fault in cycles.items():
        cycle_sources, own = sources[:, cycle], own_sources[:, cycle]
        is_permuted = (np.sort(cycle_sources) == np.sort(own)).all(1)
        exchanged = find_runs(is_permuted & (cycle_sources != own).all(1))
        merged += [replace(fault, first=first, last=last) for first, last in exchanged]
    return Faults().add_faults(merged)


def compute_fault_overlap(fault: Fault, detected: Iterable[Fault], visible: Bool[np.ndarray, "T M"]) -> float:
    """Return the intersection over union of a fault's samples and those of all that was detected of it; NaN if nothing was.

    Missing samples do not count, except for faults about missing samples.
    """
    matches = [
        each
        for each in detected
        if each.overlaps(fault) and is_same_kind(each, fault) and set(each.markers) <= set(fault.markers)
    ]
    if {m for each in matches for m in each.markers} != set(fault.markers):
        return float("nan")
    counts = np.ones_like(visible) if fault.kind in (*MISSING_KINDS, "fragment") else visible
    injected, found = build_fault_mask([fault], visible.shape) & counts, build_fault_mask(matches, visible.shape) & counts
    return float((injected & found).sum() / (injected | found).sum())


def is_same_kind(detected: Fault, injected: Fault) -> bool:
    """Return whether a detected fault is of the kind, or the group of kinds, of an injected one."""
    if isinstance(detected, Fragment) and detected.relation not in JOINED_RELATIONS:
        return False
    groups = (MISSING_KINDS, REPLACED_KINDS, LABEL_KINDS)
    return detected.kind == injected.kind or any(detected.kind in group and injected.kind in group for group in groups)


def compute_repair_errors(
    damaged_take: DamagedTake, result: CleaningResult
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Return the predicted and the true errors in metres of the visible samples that were changed within the injected faults."""
    after, count = result.take, damaged_take.marker_count
    has_fault = build_fault_mask(damaged_take.injected_faults, damaged_take.markers.shape[:2])[:, :count]
    is_changed = (compare_samples(result.input_take, after) & after.visible)[:, :count] & has_fault
    sd_m = np.zeros(is_changed.shape) if after.sample_sd is None else np.nan_to_num(after.sample_sd[:, :count])
    error_m = np.linalg.norm(after.markers[:, :count] - damaged_take.true_markers, axis=-1)
    return np.sqrt(3) * sd_m[is_changed], error_m[is_changed]


def summarise_fault_scores(scores: list[FaultScore]) -> FaultRow:
    """Return the row of the table for several takes."""
    overlap = np.concatenate([score.overlap for score in scores])
    is_found = ~np.isnan(overlap)
    predicted = np.concatenate([score.predicted_error for score in scores])
    true = np.concatenate([score.true_error for score in scores])
    return {
        "recall": float(is_found.mean()) if len(is_found) else None,
        "overlap": float(overlap[is_found].mean()) if is_found.any() else None,
        "false_alarms_per_minute": sum(len(score.false_alarms) for score in scores) / sum(score.minutes for score in scores),
        "predicted_mm": 1e3 * float(np.sqrt((predicted**2).mean())) if len(predicted) else None,
        "true_mm": 1e3 * float(np.sqrt((true**2).mean())) if len(true) else None,
    }
