"""Calibration against truth: people composed with bones and marker places that nobody tells it.

Beside the joint error that it reaches stands the one that it cannot but leave: everything that it weighs, markers, priors and
poses, linearised at the truth, gives the posterior covariance of bones and marker places (the poses eliminated by a Schur
complement), and that displaces the joints by so much on average; and skin does, even on the true body.
"""

import numpy as np

from mocapfix import marker_sets, synthetic
from mocapfix.calibrate import calibration as calibrate
from mocapfix.calibrate import calibration as frames
from mocapfix.calibrate import parameters, refinement
from mocapfix.initialise import initial_motion
from mocapfix.options import SolveOptions
from mocapfix.pose_prior import mean_pose as prior
from mocapfix.pose_prior.joint_limits import load_joint_limits
from mocapfix.skeleton import BodyModel, Skeleton, load_cmu31_body
from mocapfix.solve import kinematics, motion_solver
from mocapfix.subject import Subject
from mocapfix.synthetic import SyntheticTake
from mocapfix.take import Take

CALIBRATION_SEEDS = tuple(range(100, 106))
CALIBRATION_TAKE_S, CALIBRATION_RATE_HZ = 20.0, 30.0  # the composed motion there and back
MIN_COMPARED_BONE_LENGTH_M = 0.02  # metres: shorter offsets are no bones
MEAN_NORMAL_VECTOR_LENGTH = np.sqrt(8 / np.pi)  # of a vector whose three components are normal, in their standard deviation


def measure_calibration(
    seeds: tuple[int, ...] = CALIBRATION_SEEDS, duration_s: float = CALIBRATION_TAKE_S
) -> list[dict[str, str | float]]:
    """-> a row for each person, and the mean of them: mean errors in mm of the average body at the person's size
    (`average_...`) and of the calibrated one, of bone lengths, marker places and the joints that the solve then places, all of
    them and those that carry markers; the joints' on the true body (`true_...`), and at best (`allowed_...`).
    """
    body, worn_set = load_cmu31_body(), marker_sets.load_marker_set("cmu41")
    mean_pose = prior.load_mean_pose_prior("mean-pose", body.skeleton)
    rows = []
    for seed in seeds:
        truth = synthetic.compose_take(seed, duration_s, CALIBRATION_RATE_HZ, asymmetric=True)
        worn = Take(np.where(truth.spike_mask[..., None], np.nan, truth.damaged_positions), truth.labels, CALIBRATION_RATE_HZ)
        guessed = calibrate.scale_average_subject(worn, worn_set, body)
        found = calibrate.calibrate_subject(worn, worn_set, body, mean_pose)
        row: dict[str, str | float] = {"person": f"seed {seed}"}
        for prefix, subject in (("average_", guessed), ("", found)):
            row |= {
                prefix + key: value for key, value in compute_calibration_errors(truth, worn, subject, body, mean_pose).items()
            }
        by_skin = compute_mean_joint_errors(truth, worn, truth.subject, body, mean_pose)
        row |= {"true_" + key: value for key, value in summarise_joint_errors(by_skin, truth.subject).items()}
        left = np.hypot(by_skin, MEAN_NORMAL_VECTOR_LENGTH * compute_irreducible_joint_sd(truth, worn, body, mean_pose))
        row |= {"allowed_" + key: value for key, value in summarise_joint_errors(left, truth.subject).items()}
        rows.append(row)
    return [*rows, {"person": "mean"} | {key: float(np.mean([row[key] for row in rows])) for key in list(rows[0])[1:]}]


def compute_calibration_errors(
    truth: SyntheticTake, take: Take, subject: Subject, body: BodyModel, mean_pose: prior.MeanPosePrior
) -> dict[str, float]:
    """-> mean errors of a subject in mm, `joints_mm` and `carrying_mm` of poses solved on it."""
    return {
        "bones_mm": 1e3 * compute_bone_length_error(subject.skeleton, truth.subject.skeleton),
        "places_mm": 1e3 * float(np.linalg.norm(subject.marker_offsets - truth.subject.marker_offsets, axis=1).mean()),
    } | summarise_joint_errors(compute_mean_joint_errors(truth, take, subject, body, mean_pose), subject)


def compute_mean_joint_errors(
    truth: SyntheticTake, take: Take, subject: Subject, body: BodyModel, mean_pose: prior.MeanPosePrior
) -> np.ndarray:
    """-> (J,) metres: how far the joints of poses solved on a subject are off, on average."""
    start = initial_motion.initialise_motion(take, subject, body, mean_pose)
    motion = motion_solver.solve_motion(take, subject, body, mean_pose, load_joint_limits(body.skeleton), start, SolveOptions())
    joints, _ = kinematics.compute_world_poses(subject.skeleton, motion)
    return np.linalg.norm(joints - truth.joint_positions, axis=2).mean(0)


def summarise_joint_errors(joint_error: np.ndarray, subject: Subject) -> dict[str, float]:
    """-> the mean of joints' errors (J,), metres, in mm: of all, and of those that carry markers."""
    return {
        "joints_mm": 1e3 * float(joint_error.mean()),
        "carrying_mm": 1e3 * float(joint_error[np.unique(subject.joints)].mean()),
    }


def compute_irreducible_joint_sd(truth: SyntheticTake, take: Take, body: BodyModel, mean_pose: prior.MeanPosePrior) -> np.ndarray:
    """-> (J,) metres per axis: by how much the best calibration of the take displaces the joints, linearised at the truth."""
    person, motion = truth.subject, truth.motion
    nominal = calibrate.scale_average_subject(take, marker_sets.load_marker_set(person.marker_set), body)
    free = parameters.build_calibration_parameters(nominal, body, mean_pose)
    looked = frames.select_candidate_frames(take.markers)
    looked = looked[frames.select_varied_poses(motion.local_rotations[looked], np.random.default_rng(0))]
    root, local = motion.root_position[looked], motion.local_rotations[looked]
    usual, turns = np.zeros(len(free.information)), np.zeros_like(person.skeleton.offsets)
    problem = refinement.build_calibration_problem(
        person,
        body,
        mean_pose,
        take.markers[looked],
        parameters.CalibratedBody(person.skeleton.offsets, person.marker_offsets, turns),
    )
    fit = refinement.linearise_frames(free, problem, usual, root, local)
    return refinement.compute_calibration_sd(fit.responses, fit.curvature)[0]


def compute_bone_length_error(estimated: Skeleton, true: Skeleton) -> float:
    """-> metres: how much too long or too short bones are, on average."""
    lengths = np.linalg.norm(true.offsets, axis=1)
    bones = lengths > MIN_COMPARED_BONE_LENGTH_M
    return float(np.abs(np.linalg.norm(estimated.offsets, axis=1) - lengths)[bones].mean())
