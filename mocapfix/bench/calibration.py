"""Benchmark of calibration: the errors of bones, marker offsets and joints on composed takes of known bodies.

Some of the joint error is unavoidable. The markers, priors and poses that calibration uses, linearised at the truth, give the
posterior covariance of bones and marker offsets (with the poses eliminated by a Schur complement), and so a mean displacement of
the joints; and skin motion displaces them even on the true body.
"""

import numpy as np
from jaxtyping import Float

from mocapfix import marker_sets, synthetic
from mocapfix.calibrate.calibration import calibrate_subject, scale_average_subject, select_candidate_frames, select_varied_poses
from mocapfix.calibrate.parameters import CalibratedBody, build_calibration_parameters
from mocapfix.calibrate.refinement import (
    build_calibration_problem,
    compute_calibration_sd,
    compute_curvature,
    linearise_frames,
)
from mocapfix.initialise import initial_motion
from mocapfix.options import SolveOptions
from mocapfix.pose_prior.mean_pose import MeanPosePrior, load_joint_limits, load_mean_pose_prior
from mocapfix.skeleton import BodyModel, Skeleton, load_cmu31_body
from mocapfix.solve import kinematics, motion_solver
from mocapfix.subject import Subject
from mocapfix.synthetic import SyntheticTake
from mocapfix.take import Take

CALIBRATION_SEEDS = tuple(range(100, 106))
CALIBRATION_TAKE_S = 20.0  # the whole composed motion
CALIBRATION_RATE_HZ = 30.0
MIN_COMPARED_BONE_LENGTH_M = 0.02  # shorter offsets are not compared
MEAN_NORMAL_VECTOR_LENGTH = np.sqrt(8 / np.pi)  # mean length of a 3-D vector of standard normal components

CalibrationRow = dict[str, str | float]


def measure_calibration(
    seeds: tuple[int, ...] = CALIBRATION_SEEDS, duration_s: float = CALIBRATION_TAKE_S
) -> list[CalibrationRow]:
    """Return a row for each person and the mean row, with mean errors in mm.

    bones_mm, offsets_mm, joints_mm, marked_mm  of bone lengths, marker offsets, all joints of the solved poses, and joints that
                                                carry markers
    average_...                                 the same for the average body, scaled to the size of the person
    true_...                                    joint errors on the true body
    lower_bound_...                             joint errors of the best possible calibration
    """
    body, marker_set = load_cmu31_body(), marker_sets.load_marker_set("cmu41")
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    rows: list[CalibrationRow] = []
    for seed in seeds:
        truth = synthetic.compose_take(seed, duration_s, CALIBRATION_RATE_HZ, asymmetric=True)
        markers = np.where(truth.spike_mask[..., None], np.nan, truth.damaged_positions)
        take = Take(markers, truth.labels, CALIBRATION_RATE_HZ)
        average = scale_average_subject(take, marker_set, body)
        calibrated = calibrate_subject(take, marker_set, body, prior)
        row: CalibrationRow = {"person": f"seed {seed}"}
        for prefix, subject in (("average_", average), ("", calibrated)):
            errors = compute_calibration_errors(truth, take, subject, body, prior)
            row |= {prefix + key: value for key, value in errors.items()}
        skin_error = compute_mean_joint_errors(truth, take, truth.subject, body, prior)
        row |= {"true_" + key: value for key, value in summarise_joint_errors(skin_error, truth.subject).items()}
        calibration_error = MEAN_NORMAL_VECTOR_LENGTH * compute_irreducible_joint_sd(truth, take, body, prior)
        lower_bound = summarise_joint_errors(np.hypot(skin_error, calibration_error), truth.subject)
        row |= {"lower_bound_" + key: value for key, value in lower_bound.items()}
        rows.append(row)
    means: CalibrationRow = {key: float(np.mean([float(row[key]) for row in rows])) for key in list(rows[0])[1:]}
    return [*rows, {"person": "mean"} | means]


def compute_calibration_errors(
    truth: SyntheticTake, take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior
) -> dict[str, float]:
    """Return the mean errors of a subject in mm: bones, marker offsets, and joints of the poses solved with it."""
    offset_error = np.linalg.norm(subject.marker_offsets - truth.subject.marker_offsets, axis=1).mean()
    return {
        "bones_mm": 1e3 * compute_bone_length_error(subject.skeleton, truth.subject.skeleton),
        "offsets_mm": 1e3 * float(offset_error),
    } | summarise_joint_errors(compute_mean_joint_errors(truth, take, subject, body, prior), subject)


def compute_mean_joint_errors(
    truth: SyntheticTake, take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior
) -> Float[np.ndarray, " J"]:
    """Return the mean error of each joint in metres of the poses solved with a subject."""
    start = initial_motion.initialise_motion(take, subject, body, prior)
    limits = load_joint_limits(body.skeleton)
    motion = motion_solver.solve_motion(take, subject, body, prior, limits, start, SolveOptions())
    joint_positions, _ = kinematics.compute_world_poses(subject.skeleton, motion)
    return np.linalg.norm(joint_positions - truth.joint_positions, axis=2).mean(0)


def summarise_joint_errors(joint_error: Float[np.ndarray, " J"], subject: Subject) -> dict[str, float]:
    """Return the mean errors in mm of all joints and of those that carry markers."""
    marked_error = joint_error[np.unique(subject.joints)]
    return {"joints_mm": 1e3 * float(joint_error.mean()), "marked_mm": 1e3 * float(marked_error.mean())}


def compute_irreducible_joint_sd(
    truth: SyntheticTake, take: Take, body: BodyModel, prior: MeanPosePrior
) -> Float[np.ndarray, " J"]:
    """Return the displacement of the joints by the best calibration of the take, in metres per axis, linearised at the truth."""
    subject, motion = truth.subject, truth.motion
    nominal = scale_average_subject(take, marker_sets.load_marker_set(subject.marker_set), body)
    parameters = build_calibration_parameters(nominal, body, prior)
    candidates = select_candidate_frames(take.markers)
    frames = candidates[select_varied_poses(motion.local_rotations[candidates], np.random.default_rng(0))]
    root, local = motion.root_position[frames], motion.local_rotations[frames]
    unknowns, mean_pose_vectors = np.zeros(len(parameters.information)), np.zeros_like(subject.skeleton.offsets)
    true_body = CalibratedBody(subject.skeleton.offsets, subject.marker_offsets, mean_pose_vectors)
    problem = build_calibration_problem(subject, body, prior, take.markers[frames], true_body)
    state = linearise_frames(parameters, problem, unknowns, root, local)
    return compute_calibration_sd(state, compute_curvature(state))[0]


def compute_bone_length_error(estimated: Skeleton, true: Skeleton) -> float:
    """Return the mean absolute error of bone lengths in metres."""
    lengths = np.linalg.norm(true.offsets, axis=1)
    is_bone = lengths > MIN_COMPARED_BONE_LENGTH_M
    return float(np.abs(np.linalg.norm(estimated.offsets, axis=1) - lengths)[is_bone].mean())
