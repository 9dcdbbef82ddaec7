"""How honest the predicted deviations are: on takes with known truth, how often the truth lies within them.

Per coordinate axis, calibration's own error included. Of a normal distribution 68 % lie within one standard deviation, 95 %
within two.
"""

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from mocapfix import pipeline, synthetic
from mocapfix.options import CleanOptions
from mocapfix.result import CleaningResult
from mocapfix.stats.runs import find_runs
from mocapfix.subject import Subject
from mocapfix.synthetic import SyntheticTake

UNCERTAINTY_SEEDS = range(8)  # people on whom no constant was set; those that were used for it have numbers from 100 on
MAX_SHORT_FILL_S, MIN_LONG_FILL_S = 0.2, 1.0  # seconds
MIN_LOST_ARM_MARKERS, MIN_ARM_LOSS_S = 6, 0.5  # so many markers lost at once for so many seconds are an arm


class PredictedErrors(NamedTuple):
    """What was foretold of N points, and what came true."""

    error_m: np.ndarray  # (N, 3) metres
    predicted_sd_m: np.ndarray  # (N,) metres per axis


def measure_uncertainty(seeds: Iterable[int] = UNCERTAINTY_SEEDS) -> dict[str, dict]:
    """-> `joints` and `filled_markers`, each the `row` of all samples, with rows of the parts they fall into as `by`."""
    joints, filled = [], []
    for seed in seeds:
        truth = synthetic.compose_take(seed=seed)
        result = clean_composed_take(truth)
        joints.append(gather_joint_errors(truth, result))
        filled.append(gather_fill_errors(truth, result))
    return {"joints": summarise_error_groups(joints), "filled_markers": summarise_error_groups(filled)}


def clean_composed_take(truth: SyntheticTake, options: CleanOptions | None = None) -> CleaningResult:
    """-> what the pipeline makes of a composed take, read from a file like any other."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "take.c3d"
        synthetic.write_synthetic_take(path, truth)
        return pipeline.clean(path, options)


def gather_joint_errors(truth: SyntheticTake, result: CleaningResult) -> dict[str, PredictedErrors]:
    """-> the samples of all joints, by how many of the markers that tell of them were missing."""
    if result.joint_position_world is None or result.motion is None:
        raise ValueError("a composed take wears a known marker set, so it was solved")
    error, deviation = result.joint_position_world - truth.joint_positions, result.motion.joint_sd
    tell = find_informative_markers(truth.subject)
    missing = truth.missing_mask.astype(int) @ tell.T / tell.sum(1)
    parts = {"all their markers seen": missing == 0, "some missing": (missing > 0) & (missing < 1), "all missing": missing == 1}
    return {name: PredictedErrors(error[part], deviation[part]) for name, part in parts.items()}


def find_informative_markers(subject: Subject) -> np.ndarray:
    """-> (J, K) bool: the markers on either side of each joint; where there are none, those nearest above it."""
    parents, on = subject.skeleton.parents, subject.joints == np.arange(len(subject.skeleton.names))[:, None]
    tell = on.copy()
    for j in range(1, len(parents)):
        above = parents[j]
        tell[j] |= on[above]
        while not tell[j].any() and above > 0:
            above = parents[above]
            tell[j] |= on[above]
    return tell


def gather_fill_errors(truth: SyntheticTake, result: CleaningResult) -> dict[str, PredictedErrors]:
    """-> the samples of all markers that were put there, by why they had to be."""
    seconds = np.zeros(truth.missing_mask.shape)
    for m in range(truth.missing_mask.shape[1]):
        for first, last in find_runs(truth.missing_mask[:, m]):
            seconds[first : last + 1, m] = (last - first + 1) / truth.rate
    arm = seconds >= MIN_ARM_LOSS_S
    arm &= (arm.sum(1) >= MIN_LOST_ARM_MARKERS)[:, None]
    parts = {
        "spikes and doubted": ~truth.missing_mask,
        f"gaps under {MAX_SHORT_FILL_S:g} s": truth.missing_mask & (seconds < MAX_SHORT_FILL_S),
        f"gaps of {MAX_SHORT_FILL_S:g} to {MIN_LONG_FILL_S:g} s": (seconds >= MAX_SHORT_FILL_S)
        & (seconds < MIN_LONG_FILL_S)
        & ~arm,
        f"gaps over {MIN_LONG_FILL_S:g} s": (seconds >= MIN_LONG_FILL_S) & ~arm,
        "a whole arm lost": arm,
    }
    deviation = result.take.sample_sd
    if deviation is None:
        raise ValueError("the pipeline gives the deviation of what it fills")
    error, put = result.take.markers - truth.marker_positions, ~np.isnan(deviation)
    return {name: PredictedErrors(error[part & put], deviation[part & put]) for name, part in parts.items()}


def summarise_error_groups(takes: list[dict[str, PredictedErrors]]) -> dict:
    """-> the row of all samples of several takes, and `by`: the row of each part that there is any of."""
    together = {
        name: PredictedErrors(*map(np.concatenate, zip(*(take[name] for take in takes), strict=True))) for name in takes[0]
    }
    everything = PredictedErrors(*map(np.concatenate, zip(*together.values(), strict=True)))
    return summarise_errors(everything) | {
        "by": {name: summarise_errors(part) for name, part in together.items() if len(part.predicted_sd_m)}
    }


def summarise_errors(samples: PredictedErrors) -> dict[str, float]:
    """-> how many samples, the root mean squares of their errors and deviations per axis in mm, and which part of the errors
    lies within one deviation and within two.
    """
    times = np.abs(samples.error_m) / samples.predicted_sd_m[:, None]
    return {
        "samples": len(samples.predicted_sd_m),
        "error_mm": 1e3 * float(np.sqrt((samples.error_m**2).mean())),
        "deviation_mm": 1e3 * float(np.sqrt((samples.predicted_sd_m**2).mean())),
        "within_1_sigma": float((times <= 1).mean()),
        "within_2_sigma": float((times <= 2).mean()),
    }
