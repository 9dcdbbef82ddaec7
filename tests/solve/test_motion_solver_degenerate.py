"""Frames with little information within a take: a status and a finite pose for each, without effect on the others."""

import numpy as np

from mocapfix.lab.sound_takes import solve_motion
from mocapfix.model.motion import FrameStatus
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import initial_motion, kinematics, mean_pose
from mocapfix.solve.mean_pose import load_joint_limits
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)
LIMITS = load_joint_limits(BODY.skeleton)


def solved(truth, markers):
    take = Take(markers, truth.labels, truth.rate)
    start = initial_motion.initialise_motion(take, truth.subject, BODY, MEAN)
    return solve_motion(take, truth.subject, BODY, MEAN, LIMITS, start, SolveOptions())


def finite(motion):
    assert np.isfinite(motion.root_position).all()
    assert np.isfinite(motion.marker_sd).all()
    unit = motion.local_rotations @ np.swapaxes(motion.local_rotations, 2, 3)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-12)


def test_degenerate_frames_have_a_status_and_do_not_affect_others():
    truth, strange = compose_take(seed=2, seconds=1.0, rate=60), (10, 25, 40)
    _, sound = kinematics.compute_joint_and_marker_positions(truth.subject, truth.motion)
    markers = sound.copy()
    markers[10] = np.nan  # none
    markers[25, 1:] = np.nan  # one
    markers[40] = markers[40, 0]  # all at one point
    motions = [solved(truth, each) for each in (sound, markers)]
    finite(motions[1])
    words = [FrameStatus(motions[1].status[t]).description.split(":")[0] for t in (*strange, 50)]
    assert words == ["guessed", "guessed", "poor", "solved"]
    expected, joints = (kinematics.compute_world_poses(truth.subject.skeleton, motion)[0] for motion in motions)
    away = np.abs(np.subtract.outer(np.arange(60), strange)).min(1) > 1
    assert np.linalg.norm(joints - expected, axis=-1)[away].max() < 0.03


def test_invisible_take_is_guessed_throughout():
    truth = compose_take(seed=2, seconds=0.5, rate=60)
    motion = solved(truth, np.full_like(truth.marker_positions, np.nan))
    finite(motion)
    assert all(FrameStatus(status).description.startswith("guessed") for status in motion.status)
