"""Calibration against truth: people composed with bones and marker places that nobody tells it.

Beside the joint error that it reaches stands the one that it cannot but leave: everything that it weighs, markers, priors and
poses, linearised at the truth, gives the posterior covariance of bones and marker places (the poses eliminated by a Schur
complement), and that displaces the joints by so much on average; and skin does, even on the true body.
"""

import numpy as np

from mocapfix import calibrate, initialise, marker_set, prior, solve, synthetic
from mocapfix.calibrate import frames, freedom, refine
from mocapfix.kernels import kinematics
from mocapfix.skeleton import Body, Skeleton, cmu31
from mocapfix.solve import SolveOptions
from mocapfix.subject import Subject
from mocapfix.synthetic import Truth
from mocapfix.take import Take

SEEDS = tuple(range(100, 106))
SECONDS, RATE = 20.0, 30.0  # the composed motion there and back
BONE = 0.02  # metres: shorter offsets are no bones
MEAN_LENGTH = np.sqrt(8 / np.pi)  # of a vector whose three components are normal, in their standard deviation


def measured(seeds: tuple[int, ...] = SEEDS, seconds: float = SECONDS) -> list[dict[str, str | float]]:
    """-> a row for each person, and the mean of them: mean errors in mm of the average body at the person's size
    (`average_...`) and of the calibrated one, of bone lengths, marker places and the joints that the solve then places, all of
    them and those that carry markers; the joints' on the true body (`true_...`), and at best (`allowed_...`).
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
        by_skin = joint_errors(truth, worn, truth.subject, body, mean_pose)
        row |= {"true_" + key: value for key, value in of_joints(by_skin, truth.subject).items()}
        left = np.hypot(by_skin, MEAN_LENGTH * left_open(truth, worn, body, mean_pose))
        row |= {"allowed_" + key: value for key, value in of_joints(left, truth.subject).items()}
        rows.append(row)
    return [*rows, {"person": "mean"} | {key: float(np.mean([row[key] for row in rows])) for key in list(rows[0])[1:]}]


def errors(truth: Truth, worn: Take, subject: Subject, body: Body, mean_pose: prior.Prior) -> dict[str, float]:
    """-> mean errors of a subject in mm, `joints_mm` and `carrying_mm` of poses solved on it."""
    return {
        "bones_mm": 1e3 * bone_error(subject.skeleton, truth.subject.skeleton),
        "places_mm": 1e3 * float(np.linalg.norm(subject.places - truth.subject.places, axis=1).mean()),
    } | of_joints(joint_errors(truth, worn, subject, body, mean_pose), subject)


def joint_errors(truth: Truth, worn: Take, subject: Subject, body: Body, mean_pose: prior.Prior) -> np.ndarray:
    """-> (J,) metres: how far the joints of poses solved on a subject are off, on average."""
    start = initialise.motion(worn, subject, body, mean_pose)
    motion = solve.motion(worn, subject, body, mean_pose, prior.load_limits(body.skeleton), start, SolveOptions())
    joints, _ = kinematics.world(subject.skeleton, motion)
    return np.linalg.norm(joints - truth.joints, axis=2).mean(0)


def of_joints(error: np.ndarray, subject: Subject) -> dict[str, float]:
    """-> the mean of joints' errors (J,), metres, in mm: of all, and of those that carry markers."""
    return {"joints_mm": 1e3 * float(error.mean()), "carrying_mm": 1e3 * float(error[np.unique(subject.joints)].mean())}


def left_open(truth: Truth, worn: Take, body: Body, mean_pose: prior.Prior) -> np.ndarray:
    """-> (J,) metres per axis: by how much the best calibration of the take displaces the joints, linearised at the truth."""
    person, motion = truth.subject, truth.motion
    nominal = calibrate.average(worn, marker_set.load(person.marker_set), body)
    free = freedom.of(nominal, body, mean_pose)
    looked = frames.candidates(worn.markers)
    looked = looked[frames.varied(motion.rotations[looked], np.random.default_rng(0))]
    root, local = motion.root[looked], motion.rotations[looked]
    usual, turns = np.zeros(len(free.information)), np.zeros_like(person.skeleton.offsets)
    problem = refine.problem_of(person, body, mean_pose, worn.markers[looked], person.skeleton.offsets, person.places, turns)
    fit = refine.linearised(free, problem, usual, root, local)
    return refine.doubt(fit.found, fit.curvature)[0]


def bone_error(found: Skeleton, true: Skeleton) -> float:
    """-> metres: how much too long or too short bones are, on average."""
    lengths = np.linalg.norm(true.offsets, axis=1)
    bones = lengths > BONE
    return float(np.abs(np.linalg.norm(found.offsets, axis=1) - lengths)[bones].mean())
