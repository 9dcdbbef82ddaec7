"""Benchmark of the scopes of the trained prior: cleans with known truth, where all markers, few or single ones are missing.

Each take is damaged in several ways and cleaned with each scope. All errors are against the truth, and include those of the
calibration from the take itself, which are the same for all scopes.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from mocapfix.lab.common_task import clean_composed_take
from mocapfix.lab.sound_takes import iterate_sound_takes
from mocapfix.lab.uncertainty import damage_take
from mocapfix.options import PRIOR_SCOPES, CleanOptions
from mocapfix.result import CleaningResult
from mocapfix.subject.library import load_marker_set, write_marker_set
from mocapfix.synthetic import SyntheticTake

MEASURED_TAKES = 3
NOISE_SD_M = 0.005
"""Standard deviation per axis of a marker in the case `noisy`."""
SINGLE_LOST_MARKERS = ("LFIN", "RTOE", "RFHD", "RWRA", "LMT5", "LANK")
"""One after another, each for a fifth of the take."""
LOST_MARKER_PAIRS = (("LWRA", "LFIN"), ("RTOE", "RMT5"), ("LFHD", "RFHD"), ("RKNE", "RTHI"), ("LWRB", "LWRA"))
"""The same, of two markers of a segment or of adjacent ones."""
LOST_AT_BEGIN, LOST_AT_END = ("LWRA", "LWRB", "LFIN", "RANK", "RTOE", "RMT5"), ("RWRA", "RWRB", "RFIN", "LFHD", "LBHD")
LOST_END_S = 0.6
LEG_MARKER_SUFFIXES = ("KNE", "THI", "SHN", "ANK", "HEE", "TOE", "MT5")
TWENTY_MARKERS = (
    "LFHD", "RFHD", "C7", "CLAV", "LSHO", "RSHO", "LELB", "RELB", "LWRA", "LWRB", "RWRA", "RWRB", "LFWT", "RFWT", "LBWT", "RBWT",
    "LKNE", "RKNE", "LANK", "RANK",
)  # fmt: skip
TWELVE_MARKERS = ("LFHD", "C7", "LELB", "RELB", "LWRA", "RWRA", "LFWT", "RFWT", "LKNE", "RKNE", "LANK", "RANK")

ScopeRow = dict[str, float | str]
"""case, scope, joint_mm, joint_p95_mm, fill_mm and seconds; seconds are those of all takes together"""


class PriorCase(NamedTuple):
    """What is done to a sound take, and the markers that the marker set keeps; empty: all."""

    damage: Callable[[SyntheticTake], SyntheticTake]
    kept_labels: tuple[str, ...] = ()


def hide_samples(take: SyntheticTake, is_hidden: Bool[np.ndarray, "T M"]) -> SyntheticTake:
    """Return a take without some samples."""
    positions = np.where(is_hidden[..., None], np.nan, take.damaged_positions)
    return replace(take, damaged_positions=positions, missing_mask=take.missing_mask | is_hidden)


def hide_in_turn(take: SyntheticTake, groups: Sequence[tuple[str, ...]]) -> SyntheticTake:
    """Return a take in which one group of markers after another is hidden for a fifth of the take."""
    is_hidden, frame_count = np.zeros_like(take.missing_mask), len(take.missing_mask)
    for n, group in enumerate(groups):
        first = round(frame_count * (0.1 + 0.12 * n))
        is_hidden[first : first + frame_count // 5, np.isin(take.labels, group)] = True
    return hide_samples(take, is_hidden)


def hide_at_ends(take: SyntheticTake) -> SyntheticTake:
    """Return a take without some markers in its first and last frames."""
    is_hidden, frames = np.zeros_like(take.missing_mask), round(LOST_END_S * take.rate)
    is_hidden[:frames, np.isin(take.labels, LOST_AT_BEGIN)] = True
    is_hidden[-frames:, np.isin(take.labels, LOST_AT_END)] = True
    return hide_samples(take, is_hidden)


def hide_legs(take: SyntheticTake) -> SyntheticTake:
    """Return a take without markers on the legs."""
    is_hidden = np.zeros_like(take.missing_mask)
    is_hidden[:, [label[1:] in LEG_MARKER_SUFFIXES for label in take.labels]] = True
    return hide_samples(take, is_hidden)


def add_marker_noise(take: SyntheticTake) -> SyntheticTake:
    """Return a take with independent noise on all samples."""
    noise = np.random.default_rng(0).normal(0, NOISE_SD_M, take.damaged_positions.shape)
    return replace(take, damaged_positions=take.damaged_positions + noise)


def keep_take(take: SyntheticTake) -> SyntheticTake:
    """Return a take as it is."""
    return take


PRIOR_CASES: dict[str, PriorCase] = {
    "all markers": PriorCase(keep_take),
    "gaps and spikes": PriorCase(lambda take: damage_take(take, np.random.default_rng(0))),
    "single markers lost": PriorCase(lambda take: hide_in_turn(take, [(label,) for label in SINGLE_LOST_MARKERS])),
    "two of three lost": PriorCase(lambda take: hide_in_turn(take, LOST_MARKER_PAIRS)),
    "first and last frames": PriorCase(hide_at_ends),
    "5 mm noise": PriorCase(add_marker_noise),
    "no legs": PriorCase(hide_legs),
    "20 markers": PriorCase(keep_take, TWENTY_MARKERS),
    "12 markers": PriorCase(keep_take, TWELVE_MARKERS),
}


def measure_prior_scopes(
    motion_folder: Path | None = None,
    take_count: int = MEASURED_TAKES,
    cases: Sequence[str] = tuple(PRIOR_CASES),
    scopes: Sequence[str] = PRIOR_SCOPES,
    report_progress: Callable[[str], None] = lambda _: None,
) -> list[ScopeRow]:
    """Return a row for each case and scope.

    motion_folder  holds test.npz of motion, of which takes are made; None for composed takes

    Raises ReadError if there is no such motion.
    """
    takes, rows = list(iterate_sound_takes(motion_folder, take_count)), list[ScopeRow]()
    for case in cases:
        for scope in scopes:
            report_progress(f"{case}, {scope}")
            scores: list[dict[str, float]] = []
            begin = perf_counter()
            for _, truth in takes:
                scores.append(clean_case(truth, PRIOR_CASES[case], scope))
            seconds = perf_counter() - begin
            means = {key: float(np.mean([score[key] for score in scores])) for key in scores[0]}
            rows.append({"case": case, "scope": scope, **means, "seconds": seconds})
    return rows


def clean_case(truth: SyntheticTake, case: PriorCase, scope: str) -> dict[str, float]:
    """Return the errors of one damaged take that is cleaned with one scope."""
    damaged, options = case.damage(truth), CleanOptions().change(prior_scope=scope)
    if not case.kept_labels:
        return score_cleaning(damaged, clean_composed_take(damaged, options))
    is_kept = np.isin(damaged.labels, case.kept_labels)
    thinned = replace(
        damaged,
        labels=tuple(label for label, kept in zip(damaged.labels, is_kept, strict=True) if kept),
        marker_positions=damaged.marker_positions[:, is_kept],
        damaged_positions=damaged.damaged_positions[:, is_kept],
        missing_mask=damaged.missing_mask[:, is_kept],
        spike_mask=damaged.spike_mask[:, is_kept],
    )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "thinned.yaml"
        write_thinned_marker_set(path, case.kept_labels)
        return score_cleaning(thinned, clean_composed_take(thinned, options.change(marker_set=path)))


def write_thinned_marker_set(path: Path, kept_labels: Sequence[str]) -> None:
    """Write the CMU marker set with some of its markers only."""
    full = load_marker_set("cmu41")
    kept = [full.labels.index(label) for label in kept_labels]
    thinned = replace(
        full,
        name=path.stem,
        labels=tuple(kept_labels),
        joints=full.joints[kept],
        marker_offsets=full.marker_offsets[kept],
        marker_spread=full.marker_spread[kept],
        aliases=tuple(full.aliases[k] for k in kept),
        optional_labels=full.optional_labels & set(kept_labels),
        other_names=(),
    )
    write_marker_set(path, thinned)


def score_cleaning(truth: SyntheticTake, result: CleaningResult) -> dict[str, float]:
    """Return the errors in mm of the solved joints, and of the samples that were missing and are filled, 0 without any."""
    if result.joint_position_world is None:
        raise ValueError("a take with a known marker set is solved")
    joint_mm = 1e3 * np.linalg.norm(result.joint_position_world - truth.joint_positions, axis=-1)
    fill_mm = 1e3 * np.linalg.norm(result.take.markers - truth.marker_positions, axis=-1)[truth.missing_mask]
    return {
        "joint_mm": float(np.nanmean(joint_mm)),
        "joint_p95_mm": float(np.nanpercentile(joint_mm, 95)),
        "fill_mm": float(np.nanmean(fill_mm)) if np.isfinite(fill_mm).any() else 0.0,
    }
