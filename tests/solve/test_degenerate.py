"""Frames that say little, in the midst of a take: a status in words and a finite pose each, and the others none the worse."""

import numpy as np

from mocapfix import initialise, prior, solve, synthetic
from mocapfix.kernels import kinematics
from mocapfix.motion import STATUS
from mocapfix.skeleton import cmu31
from mocapfix.take import Take

BODY = cmu31()
MEAN = prior.load("mean-pose", BODY.skeleton)
LIMITS = prior.load_limits(BODY.skeleton)


def solved(truth, markers):
    worn = Take(markers, truth.labels, truth.rate)
    start = initialise.motion(worn, truth.subject, BODY, MEAN)
    return solve.motion(worn, truth.subject, BODY, MEAN, LIMITS, start, solve.SolveOptions())


def finite(motion):
    assert np.isfinite(motion.root).all()
    assert np.isfinite(motion.deviation).all()
    unit = motion.rotations @ np.swapaxes(motion.rotations, 2, 3)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-12)


def test_frames_that_say_little_are_told_in_words_and_spoil_no_others():
    truth, strange = synthetic.take(seed=2, seconds=1.0, rate=60), (10, 25, 40)
    _, sound = kinematics.placed(truth.subject, truth.motion)
    markers = sound.copy()
    markers[10] = np.nan  # none
    markers[25, 1:] = np.nan  # one
    markers[40] = markers[40, 0]  # all at one point
    motions = [solved(truth, each) for each in (sound, markers)]
    finite(motions[1])
    words = [STATUS[motions[1].status[t]].split(":")[0] for t in (*strange, 50)]
    assert words == ["guessed", "guessed", "poor", "solved"]
    expected, joints = (kinematics.world(truth.subject.skeleton, motion)[0] for motion in motions)
    away = np.abs(np.subtract.outer(np.arange(60), strange)).min(1) > 1
    assert np.linalg.norm(joints - expected, axis=-1)[away].max() < 0.03


def test_a_take_in_which_nothing_is_seen_is_guessed_throughout():
    truth = synthetic.take(seed=2, seconds=0.5, rate=60)
    motion = solved(truth, np.full_like(truth.markers, np.nan))
    finite(motion)
    assert all(STATUS[status].startswith("guessed") for status in motion.status)
