"""The motion solver on bodies with exact, missing and outlying markers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.lab.sound_takes import solve_motion
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import (
    initial_motion,
    kinematics,
    mean_pose,
    motion_solver,
    occluded_joints,
    pose_problem,
    trained_priors,
)
from mocapfix.solve.mean_pose import load_joint_limits
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.solve.terms import build_no_tracking
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take

BODY, MARKER_SET = load_cmu31_body(), load_marker_set("cmu41")
MEAN, NONE = (mean_pose.load_mean_pose_prior(name, BODY.skeleton) for name in ("mean-pose", "none"))
LIMITS = load_joint_limits(BODY.skeleton)
NO_LIMITS = replace(LIMITS, lower_rad=np.full_like(LIMITS.lower_rad, -np.inf), upper_rad=np.full_like(LIMITS.upper_rad, np.inf))
NAMES = BODY.skeleton.names
SUBJECT = Subject(
    BODY.skeleton, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, MARKER_SET.marker_spread
)


@pytest.fixture(scope="module")
def exact():
    """Return a function that composes a take with markers exactly at their positions on the body."""

    def at(rate, seconds=3.0):
        truth = compose_take(seed=2, seconds=seconds, rate=rate)
        return replace(truth, marker_positions=kinematics.compute_joint_and_marker_positions(truth.subject, truth.motion)[1])

    return at


def solved(truth, markers, prior=NONE, limits=LIMITS):
    take = Take(markers, truth.labels, truth.rate)
    start = initial_motion.initialise_motion(take, truth.subject, BODY, prior)
    return solve_motion(take, truth.subject, BODY, prior, limits, start, SolveOptions())


def compute_joint_errors(truth, motion, frames=slice(None)):
    """Return (T, J) the distances of the joints from the true ones in metres."""
    return np.linalg.norm(
        kinematics.compute_world_poses(truth.subject.skeleton, motion)[0] - truth.joint_positions[frames], axis=-1
    )


def check(motion: Motion):
    """Check what holds for every motion: finite values, rotation matrices, and a standard deviation for every marker."""
    assert np.isfinite(motion.root_position).all()
    np.testing.assert_allclose(np.linalg.det(motion.local_rotations), 1.0)
    across = motion.local_rotations @ np.swapaxes(motion.local_rotations, 2, 3)
    np.testing.assert_allclose(across, np.broadcast_to(np.eye(3), across.shape), atol=1e-9)
    assert np.isfinite(motion.marker_sd).all()
    assert (motion.marker_sd > 0).all()


@pytest.mark.parametrize(("rate", "millimetres"), [(30.0, 2.2), (120.0, 1.2), (240.0, 1.0)])
def test_exact_markers_give_the_true_joints_at_any_rate(exact, rate, millimetres):
    truth = exact(rate)
    motion = solved(truth, truth.marker_positions)
    check(motion)
    assert compute_joint_errors(truth, motion).mean() * 1e3 < millimetres
    assert (motion.status < 2).all()


def test_static_body_is_accurate_to_a_fifth_of_a_millimetre(exact):
    truth = exact(120.0)
    still = np.tile(truth.marker_positions[200], (30, 1, 1))
    motion = solved(truth, still, limits=NO_LIMITS)  # without joint limits, which may bend the body
    assert compute_joint_errors(truth, motion, slice(200, 201)).max() < 2e-3
    assert compute_joint_errors(truth, motion, slice(200, 201)).mean() < 2e-4


def test_prior_hardly_biases_the_markers(exact):
    truth = exact(120.0)
    motion = solved(truth, truth.marker_positions, MEAN, LIMITS)
    carried = kinematics.compute_joint_and_marker_positions(truth.subject, motion)[1]
    assert np.linalg.norm(carried - truth.marker_positions, axis=-1).mean() < 0.002
    determined = [NAMES.index(name) for name in ("Hips", "LeftLeg", "RightFoot", "Spine1", "Head", "LeftArm", "RightHand")]
    assert compute_joint_errors(truth, motion)[:, determined].mean() < 0.003


@pytest.mark.parametrize("frames", [1, 2, 3, 5, 20])
def test_very_short_takes_are_solved(exact, frames):
    truth = exact(120.0)
    motion = solved(truth, truth.marker_positions[100 : 100 + frames])
    check(motion)
    assert motion.frame_count == frames
    assert compute_joint_errors(truth, motion, slice(100, 100 + frames)).mean() < 1.2e-3


def test_frames_without_markers_are_guessed_between_neighbours(exact):
    truth = exact(120.0)
    markers = truth.marker_positions.copy()
    markers[:10] = markers[150:160] = np.nan
    markers[200:205, 2:] = np.nan
    motion = solved(truth, markers)
    check(motion)
    empty = np.zeros(len(markers), bool)
    empty[:10] = empty[150:160] = empty[200:205] = True
    np.testing.assert_array_equal(motion.status == 3, empty)
    np.testing.assert_allclose(np.diff(motion.root_position[145:165], 2, axis=0), 0.0, atol=1e-3)  # no jump


@pytest.mark.parametrize("prior", [NONE, MEAN], ids=["none", "mean-pose"])
def test_short_gap_of_all_markers_is_interpolated(exact, prior):
    truth = exact(120.0)
    markers = truth.marker_positions.copy()
    markers[150:160] = np.nan
    assert compute_joint_errors(truth, solved(truth, markers, prior))[150:160].mean() < 0.02


def test_outlying_marker_has_no_influence(exact):
    truth = exact(120.0)
    markers = truth.marker_positions.copy()
    markers[:, truth.labels.index("LKNE")] += [0.0, 0.0, 0.4]
    assert compute_joint_errors(truth, solved(truth, markers)).mean() < 0.004


def test_missing_marker_increases_its_sd_only(exact):
    truth = exact(120.0)
    markers, k = truth.marker_positions.copy(), truth.labels.index("LFIN")
    sd_before = solved(truth, markers).marker_sd
    markers[150:250, k] = np.nan
    motion = solved(truth, markers)
    assert (motion.marker_sd[160:240, k] > 1.3 * sd_before[160:240, k]).all()
    other = truth.labels.index("RFIN")
    np.testing.assert_allclose(motion.marker_sd[:, other], sd_before[:, other], rtol=0.05)
    assert compute_joint_errors(truth, motion)[160:240, NAMES.index("LeftHand")].mean() < 0.01


def test_lost_arm_moves_smoothly_and_the_rest_is_unaffected(exact):
    truth = exact(120.0)
    markers = truth.marker_positions.copy()
    arm = [NAMES.index(name) for name in ("LeftArm", "LeftForeArm", "LeftHand")]
    markers[150:210][:, np.isin(truth.subject.joints, arm)] = np.nan
    motion = solved(truth, markers)
    check(motion)
    joints = kinematics.compute_world_poses(truth.subject.skeleton, motion)[0]
    step = np.linalg.norm(np.diff(joints, axis=0), axis=-1)
    assert step.max() < 1.5 * np.linalg.norm(np.diff(truth.joint_positions, axis=0), axis=-1).max()
    other_joints = [NAMES.index(name) for name in ("RightHand", "LeftFoot", "RightFoot", "Hips")]
    assert compute_joint_errors(truth, motion)[:, other_joints].mean() < 0.003


def test_inputs_are_not_modified(exact):
    truth = exact(30.0)
    take = Take(truth.marker_positions.copy(), truth.labels, truth.rate)
    start = initial_motion.initialise_motion(take, truth.subject, BODY, MEAN)
    was = [field.copy() for field in (take.markers, *vars(start).values())]
    solve_motion(take, truth.subject, BODY, MEAN, LIMITS, start, SolveOptions())
    for now, before in zip((take.markers, *vars(start).values()), was, strict=True):
        np.testing.assert_array_equal(now, before)


def test_pose_model_is_not_loaded_if_all_segments_are_observed(exact):
    truth = exact(120.0)
    markers = truth.marker_positions.copy()
    markers[100:140, truth.labels.index("LWRA")] = np.nan  # the forearm carries others

    def refuse_to_load():
        raise AssertionError("the pose model was loaded")

    take = Take(markers, truth.labels, truth.rate)
    start = initial_motion.initialise_motion(take, truth.subject, BODY, MEAN)
    arguments = (take, truth.subject, BODY, MEAN, LIMITS, start, SolveOptions())
    with_model, without = (
        solve_motion(*arguments, conditioner=PriorConditioner(refuse_to_load, 1.0)),
        solve_motion(*arguments),
    )
    for one, other in zip(vars(with_model).values(), vars(without).values(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_pose_model_affects_the_lost_limb_only(exact, monkeypatch):
    monkeypatch.setattr(occluded_joints, "MIN_QUERY_SD_RAD", 0.0)  # the motion is slow, so the model would not be used
    truth = exact(120.0)
    markers = truth.marker_positions.copy()
    arm = [NAMES.index(name) for name in ("LeftArm", "LeftForeArm", "LeftHand")]
    markers[100:, np.isin(truth.subject.joints, arm)] = np.nan  # to the end of the take
    take = Take(markers, truth.labels, truth.rate)
    start = initial_motion.initialise_motion(take, truth.subject, BODY, MEAN)
    arguments = (take, truth.subject, BODY, MEAN, LIMITS, start, SolveOptions())
    motions = (
        solve_motion(
            *arguments, conditioner=PriorConditioner(lambda: trained_priors.load_pose_model("gaussian", BODY.skeleton), 1.0)
        ),
        solve_motion(*arguments),
    )
    moved = np.linalg.norm(
        np.subtract(*(kinematics.compute_world_poses(truth.subject.skeleton, each)[0] for each in motions)), axis=-1
    )
    elbow = [NAMES.index(name) for name in NAMES if name.startswith(("LeftForeArm", "LeftHand", "LeftFinger", "LThumb"))]
    assert moved[200:, elbow].max() > 5e-4
    assert np.delete(moved, elbow, axis=1).max() < 3e-4
    assert moved[:90].max() < 3e-4


def test_forearm_follows_its_markers_across_the_hinge_of_the_elbow():
    """Skin on the upper arm does not turn with the bone, so that a forearm seems to turn where an elbow cannot."""
    truth = compose_take(seed=2, seconds=1.0, rate=120.0)
    forearm = NAMES.index("LeftForeArm")
    local_rotations = truth.motion.local_rotations.copy()
    across = np.linalg.eigh(MEAN.information[forearm])[1][:, -1]  # the locked axis
    turn = Rotation.from_rotvec(0.9 * np.sin(np.pi * np.linspace(0, 1, 120))[:, None] * across)
    local_rotations[:, forearm] = turn.as_matrix() @ local_rotations[:, forearm]
    motion = replace(truth.motion, local_rotations=local_rotations)
    markers = kinematics.compute_joint_and_marker_positions(truth.subject, motion)[1]
    carried = kinematics.compute_joint_and_marker_positions(truth.subject, solved(truth, markers, MEAN))[1]
    assert np.linalg.norm(carried - markers, axis=-1).max() < 0.03


def test_limb_that_was_left_behind_is_solved_again(exact):
    truth = exact(60.0, 1.0)
    take, frames = Take(truth.marker_positions, truth.labels, truth.rate), [20, 21, 22, 40]
    problem = pose_problem.build_pose_problem(take, truth.subject, BODY, MEAN, LIMITS, SolveOptions())
    root_position, local_rotations = truth.motion.root_position.copy(), truth.motion.local_rotations.copy()
    right = root_position.copy(), local_rotations.copy()
    local_rotations[frames, NAMES.index("LeftArm")] = local_rotations[frames, NAMES.index("LeftArm")] @ compute_turn_x(2.5)
    own = root_position.copy(), local_rotations.copy()  # the frame's own solution lost the arm as well
    motion_solver.recover_lost_limbs(
        problem,
        truth.subject,
        MEAN,
        (root_position, local_rotations),
        own_pose=own,
        tracking=build_no_tracking(31),
        is_uncertain=np.zeros(local_rotations.shape[:2], bool),
        options=SolveOptions(),
    )
    wanted, found = (
        kinematics.compute_world_poses(truth.subject.skeleton, replace(truth.motion, root_position=r, local_rotations=rotations))[
            0
        ]
        for r, rotations in (right, (root_position, local_rotations))
    )
    assert np.linalg.norm(wanted - found, axis=-1).max() < 0.02
    kept = np.setdiff1d(np.arange(60), frames)
    np.testing.assert_array_equal(local_rotations[kept], right[1][kept])


def compute_turn_x(angle_rad):
    return Rotation.from_rotvec([angle_rad, 0.0, 0.0]).as_matrix()
