"""Benchmark of predicted uncertainty: how often the truth lies within the predicted standard deviations on composed takes,
or on takes of recorded motion.

Errors are per coordinate axis and include the error of calibration. Of a normal distribution, 68 % lie within one standard
deviation and 95 % within two.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

import mocapfix
from mocapfix import synthetic
from mocapfix.lab.common_task import clean_composed_take
from mocapfix.lab.sound_takes import find_informative_markers, iterate_sound_takes
from mocapfix.model.subject import Subject
from mocapfix.options import CleanOptions
from mocapfix.result import CleaningResult
from mocapfix.stats.sequences import find_runs

ONE_SIGMA_SHARE = 0.6827  # of a normal distribution within one standard deviation
UNCERTAINTY_SEEDS = range(8)  # subjects that no constant was tuned on; those used for tuning have seeds of 100 and more
MAX_SHORT_FILL_S = 0.2
MIN_LONG_FILL_S = 1.0
MIN_LOST_ARM_MARKERS = 6  # missing at the same time: a whole arm
OTHER_TAKE_SEED = 1000  # of the skin in the take from which a known subject is calibrated
MIN_ARM_LOSS_S = 0.5  # minimum duration of the gaps of a lost arm


class PredictedErrors(NamedTuple):
    """The errors of N points and their predicted standard deviations."""

    error_m: np.ndarray  # (N, 3)
    predicted_sd_m: np.ndarray  # (N,) per axis


ErrorGroups = dict[str, PredictedErrors]


def measure_uncertainty(
    seeds: Iterable[int] = UNCERTAINTY_SEEDS,
    motion_folder: Path | None = None,
    *,
    is_subject_known: bool = False,
    report_progress: Callable[[str], None] = lambda _: None,
) -> dict[str, dict[str, Any]]:
    """Return the rows of `joints` and `filled_markers`, with rows of groups of samples as `by`, and of joints as `by_joint`.

    Args:
        seeds: Of the composed takes, or of the damage of the performed takes, one take for each.
        motion_folder: Holds test.npz of motion, of which takes are made; None for composed takes.
        is_subject_known: Whether the subject is calibrated from another take of the same person, not from the take itself.

    Raises:
        ReadError: If there is no such motion.
    """
    joints, joint_groups, fills = list[ErrorGroups](), list[ErrorGroups](), list[ErrorGroups]()
    for name, truth in iterate_damaged_takes(list(seeds), motion_folder):
        report_progress(name)
        options = CleanOptions().change(subject=calibrate_from_other_take(truth)) if is_subject_known else CleanOptions()
        result = clean_composed_take(truth, options)
        joints.append(gather_joint_errors(truth, result))
        joint_groups.append(gather_errors_by_joint(truth, result))
        fills.append(gather_fill_errors(truth, result))
    of_joints, of_fills, by_joint = map(summarise_error_groups, (joints, fills, joint_groups))
    return {"joints": of_joints | {"by_joint": by_joint["by"]}, "filled_markers": of_fills}


def iterate_damaged_takes(seeds: list[int], motion_folder: Path | None) -> Iterator[tuple[str, synthetic.SyntheticTake]]:
    """Yield the names of takes and the takes, with gaps and spikes. Raises ReadError if the folder holds no motion."""
    if motion_folder is None:
        for seed in seeds:
            yield f"seed {seed}", synthetic.compose_take(seed=seed, asymmetric=True)
        return
    for seed, (name, truth) in zip(seeds, iterate_sound_takes(motion_folder, len(seeds)), strict=False):
        yield name, damage_take(truth, np.random.default_rng(seed))


def damage_take(truth: synthetic.SyntheticTake, rng: np.random.Generator) -> synthetic.SyntheticTake:
    """Return a take with gaps and spikes like those of a composed take."""
    is_arm_marker = np.isin(
        truth.subject.joints, [truth.subject.skeleton.find_joint(name) for name in synthetic.DAMAGED_ARM_JOINTS]
    )
    missing = synthetic.draw_gaps(rng, truth.motion.frame_count, truth.rate, is_arm_marker)
    shift = synthetic.draw_spikes(rng, ~missing, truth.rate)
    damaged = np.where(missing[..., None], np.nan, truth.marker_positions + shift)
    return replace(truth, damaged_positions=damaged, missing_mask=missing, spike_mask=(shift != 0).any(axis=2))


def calibrate_from_other_take(truth: synthetic.SyntheticTake) -> Subject:
    """Return the person of a take, calibrated from a take of the same motion with other skin and without damage."""
    _, markers = synthetic.simulate_markers(np.random.default_rng(OTHER_TAKE_SEED), truth.subject, truth.motion, truth.rate)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "other.c3d"
        synthetic.write_synthetic_take(path, replace(truth, damaged_positions=markers, missing_mask=np.isnan(markers[..., 0])))
        return mocapfix.calibrate_takes([path])


def gather_errors_by_joint(truth: synthetic.SyntheticTake, result: CleaningResult) -> ErrorGroups:
    """Return the errors of all joints, left and right together."""
    error_m, sd_m = _compute_joint_errors(truth, result)
    names = [re.sub("^(Left|Right|L(?=[A-Z])|R(?=[A-Z]))", "", name) for name in truth.subject.skeleton.names]
    groups = {name: [each == name for each in names] for name in names}
    return {name: PredictedErrors(error_m[:, group].reshape(-1, 3), sd_m[:, group].ravel()) for name, group in groups.items()}


def gather_joint_errors(truth: synthetic.SyntheticTake, result: CleaningResult) -> ErrorGroups:
    """Return the errors of all joints, grouped by how many of their informative markers were missing."""
    error_m, sd_m = _compute_joint_errors(truth, result)
    is_informative = find_informative_markers(truth.subject)
    missing_share = truth.missing_mask.astype(int) @ is_informative.T / is_informative.sum(1)
    groups = {
        "all their markers seen": missing_share == 0,
        "some missing": (missing_share > 0) & (missing_share < 1),
        "all missing": missing_share == 1,
    }
    return {name: PredictedErrors(error_m[group], sd_m[group]) for name, group in groups.items()}


def gather_fill_errors(truth: synthetic.SyntheticTake, result: CleaningResult) -> ErrorGroups:
    """Return the errors of all estimated samples, grouped by the reason for the estimate."""
    duration_s = np.zeros(truth.missing_mask.shape)
    for m in range(truth.missing_mask.shape[1]):
        for first, last in find_runs(truth.missing_mask[:, m]):
            duration_s[first : last + 1, m] = (last - first + 1) / truth.rate
    is_arm = (is_lost := duration_s >= MIN_ARM_LOSS_S) & (is_lost.sum(1) >= MIN_LOST_ARM_MARKERS)[:, None]
    is_short, is_long = duration_s < MAX_SHORT_FILL_S, duration_s >= MIN_LONG_FILL_S
    groups = {
        "spikes and other faulty samples": ~truth.missing_mask,
        f"gaps under {MAX_SHORT_FILL_S:g} s": truth.missing_mask & is_short,
        f"gaps of {MAX_SHORT_FILL_S:g} to {MIN_LONG_FILL_S:g} s": ~is_short & ~is_long & ~is_arm,
        f"gaps over {MIN_LONG_FILL_S:g} s": is_long & ~is_arm,
        "a whole arm lost": is_arm,
    }
    error_m, is_estimated = result.take.markers - truth.marker_positions, ~np.isnan(sd_m := result.take.estimated_sd)
    return {name: PredictedErrors(error_m[group & is_estimated], sd_m[group & is_estimated]) for name, group in groups.items()}


def summarise_error_groups(takes: list[ErrorGroups]) -> dict[str, Any]:
    """Return the row of all samples of several takes, and as `by` the rows of the groups that have samples, the worst first.

    `share_error` is the standard error of the share within one standard deviation; takes are the samples, since the errors of
    calibration are the same in all frames of a take.
    """
    groups = {name: _concatenate_errors([take[name] for take in takes]) for name in takes[0]}
    rows = {name: summarise_errors(group) for name, group in groups.items() if len(group.predicted_sd_m)}
    for name, row in rows.items():
        shares = [summarise_errors(take[name])["within_1_sigma"] for take in takes if len(take[name].predicted_sd_m)]
        row["share_error"] = float(np.std(shares, ddof=1) / len(shares) ** 0.5) if len(shares) > 1 else np.nan
    by = dict(sorted(rows.items(), key=lambda each: -abs(each[1]["within_1_sigma"] - ONE_SIGMA_SHARE)))
    return summarise_errors(_concatenate_errors(list(groups.values()))) | {"by": by}


def summarise_errors(samples: PredictedErrors) -> dict[str, float]:
    """Return the count, the root mean squares of errors and deviations per axis in mm, and the shares within one and two."""
    ratio = np.abs(samples.error_m) / samples.predicted_sd_m[:, None]
    return {
        "samples": len(samples.predicted_sd_m),
        "error_mm": 1e3 * float(np.sqrt((samples.error_m**2).mean())),
        "deviation_mm": 1e3 * float(np.sqrt((samples.predicted_sd_m**2).mean())),
        "within_1_sigma": float((ratio <= 1).mean()),
        "within_2_sigma": float((ratio <= 2).mean()),
    }


def _concatenate_errors(parts: list[PredictedErrors]) -> PredictedErrors:
    return PredictedErrors(*map(np.concatenate, zip(*parts, strict=True)))


def _compute_joint_errors(truth: synthetic.SyntheticTake, result: CleaningResult) -> tuple[np.ndarray, np.ndarray]:
    if result.joint_position_world is None or result.motion is None:
        raise ValueError("a composed take has a known marker set, so it is solved")
    return result.joint_position_world - truth.joint_positions, result.motion.joint_sd
