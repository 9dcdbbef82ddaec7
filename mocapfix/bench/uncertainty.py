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
from mocapfix.fill import FillOptions
from mocapfix.pipeline import ANYTHING
from mocapfix.result import Result
from mocapfix.subject import Subject
from mocapfix.synthetic import Truth
from mocapfix.take import runs

SEEDS = range(8)  # people on whom no constant was set; those that were used for it have numbers from 100 on
SHORT, LONG = 0.2, 1.0  # seconds
ARM, ARM_LOST = 6, 0.5  # so many markers lost at once for so many seconds are an arm


class Samples(NamedTuple):
    """What was foretold of N points, and what came true."""

    error: np.ndarray  # (N, 3) metres
    deviation: np.ndarray  # (N,) metres per axis


def measure(seeds: Iterable[int] = SEEDS) -> dict[str, dict]:
    """-> `joints` and `filled_markers`, each the `row` of all samples, with rows of the parts they fall into as `by`."""
    joints, filled = [], []
    for seed in seeds:
        truth = synthetic.take(seed=seed)
        result = cleaned(truth)
        joints.append(of_joints(truth, result))
        filled.append(of_fills(truth, result))
    return {"joints": rows(joints), "filled_markers": rows(filled)}


def cleaned(truth: Truth, options: FillOptions = ANYTHING) -> Result:
    """-> what the pipeline makes of a composed take, read from a file like any other."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "take.c3d"
        synthetic.write(path, truth)
        return pipeline.clean(path, options=options)


def of_joints(truth: Truth, result: Result) -> dict[str, Samples]:
    """-> the samples of all joints, by how many of the markers that tell of them were missing."""
    if result.joints is None or result.motion is None:
        raise ValueError("a composed take wears a known marker set, so it was solved")
    error, deviation = result.joints - truth.joints, result.motion.joint_deviation
    tell = telling(truth.subject)
    missing = truth.struck.astype(int) @ tell.T / tell.sum(1)
    parts = {"all their markers seen": missing == 0, "some missing": (missing > 0) & (missing < 1), "all missing": missing == 1}
    return {name: Samples(error[part], deviation[part]) for name, part in parts.items()}


def telling(subject: Subject) -> np.ndarray:
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


def of_fills(truth: Truth, result: Result) -> dict[str, Samples]:
    """-> the samples of all markers that were put there, by why they had to be."""
    seconds = np.zeros(truth.struck.shape)
    for m in range(truth.struck.shape[1]):
        for first, last in runs(truth.struck[:, m]):
            seconds[first : last + 1, m] = (last - first + 1) / truth.rate
    arm = seconds >= ARM_LOST
    arm &= (arm.sum(1) >= ARM)[:, None]
    parts = {
        "spikes and doubted": ~truth.struck,
        f"gaps under {SHORT:g} s": truth.struck & (seconds < SHORT),
        f"gaps of {SHORT:g} to {LONG:g} s": (seconds >= SHORT) & (seconds < LONG) & ~arm,
        f"gaps over {LONG:g} s": (seconds >= LONG) & ~arm,
        "a whole arm lost": arm,
    }
    deviation = result.take.deviation
    if deviation is None:
        raise ValueError("the pipeline gives the deviation of what it fills")
    error, put = result.take.markers - truth.markers, ~np.isnan(deviation)
    return {name: Samples(error[part & put], deviation[part & put]) for name, part in parts.items()}


def rows(takes: list[dict[str, Samples]]) -> dict:
    """-> the row of all samples of several takes, and `by`: the row of each part that there is any of."""
    together = {name: Samples(*map(np.concatenate, zip(*(take[name] for take in takes), strict=True))) for name in takes[0]}
    everything = Samples(*map(np.concatenate, zip(*together.values(), strict=True)))
    return row(everything) | {"by": {name: row(part) for name, part in together.items() if len(part.deviation)}}


def row(samples: Samples) -> dict[str, float]:
    """-> how many samples, the root mean squares of their errors and deviations per axis in mm, and which part of the errors
    lies within one deviation and within two.
    """
    times = np.abs(samples.error) / samples.deviation[:, None]
    return {
        "samples": len(samples.deviation),
        "error_mm": 1e3 * float(np.sqrt((samples.error**2).mean())),
        "deviation_mm": 1e3 * float(np.sqrt((samples.deviation**2).mean())),
        "within_1_sigma": float((times <= 1).mean()),
        "within_2_sigma": float((times <= 2).mean()),
    }
