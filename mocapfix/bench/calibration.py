"""Calibration against truth: people composed with bones and marker places that nobody tells it."""

import numpy as np

from mocapfix import calibrate, initialise, marker_set, prior, solve, synthetic
from mocapfix.kernels import kinematics
from mocapfix.skeleton import Body, Skeleton, cmu31
from mocapfix.solve import SolveOptions
from mocapfix.subject import Subject
from mocapfix.synthetic import Truth
from mocapfix.take import Take

SEEDS = tuple(range(100, 106))
SECONDS, RATE = 20.0, 30.0  # the composed motion there and back
BONE = 0.02  # metres: shorter offsets are no bones


def measured(seeds: tuple[int, ...] = SEEDS, seconds: float = SECONDS) -> list[dict[str, str | float]]:
    """-> a row for each person, and the mean of them: mean errors in mm of the average body at the person's size
    (`average_...`) and of the calibrated one, of bone lengths, marker places and the joints that the solve then places.
    """
    body, worn_set = cmu31(), marker_set.load("cmu41")
    mean_pose = prior.load("mean-pose", body.skeleton)
    rows = []
    for seed in seeds:
        truth = synthetic.take(seed, seconds, RATE, crooked=True)
        worn = Take(np.where(truth.moved[..., None], np.nan, truth.damaged), truth.labels, RATE)
        guessed = calibrate.average(worn, worn_set, body)
        found = calibrate.subject(worn, worn_set, body, mean_pose)
        row: dict[str, str | float] = {"person": f"seed {seed}"}
        for prefix, subject in (("average_", guessed), ("", found)):
            row |= {prefix + key: value for key, value in errors(truth, worn, subject, body, mean_pose).items()}
        rows.append(row)
    return [*rows, {"person": "mean"} | {key: float(np.mean([row[key] for row in rows])) for key in list(rows[0])[1:]}]


def errors(truth: Truth, worn: Take, subject: Subject, body: Body, mean_pose: prior.Prior) -> dict[str, float]:
    """-> mean errors of a subject in mm, `joints_mm` of poses solved on it."""
    start = initialise.motion(worn, subject, body, mean_pose)
    motion = solve.motion(worn, subject, body, mean_pose, prior.load_limits(body.skeleton), start, SolveOptions())
    joints, _ = kinematics.world(subject.skeleton, motion)
    return {
        "bones_mm": 1e3 * bone_error(subject.skeleton, truth.subject.skeleton),
        "places_mm": 1e3 * float(np.linalg.norm(subject.places - truth.subject.places, axis=1).mean()),
        "joints_mm": 1e3 * float(np.linalg.norm(joints - truth.joints, axis=2).mean()),
    }


def bone_error(found: Skeleton, true: Skeleton) -> float:
    """-> metres: how much too long or too short bones are, on average."""
    lengths = np.linalg.norm(true.offsets, axis=1)
    bones = lengths > BONE
    return float(np.abs(np.linalg.norm(found.offsets, axis=1) - lengths)[bones].mean())
