"""The motion prior's prediction for a body, in the joints of the 31-joint skeleton."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import motion_prior
from mocapfix.solve.motion_prior import GapContext, MotionPrior, PredictedGap, build_motion_tree

SKELETON = load_cmu31_body().skeleton
RATE_HZ = 60.0


@pytest.fixture
def record(monkeypatch):
    """Return a function that lets motion priors return a known motion, and returns a list that gets what they are given."""

    def record_gaps(motion):
        given = []
        monkeypatch.setattr(MotionPrior, "predict_gap", lambda self, *arguments: given.extend(arguments) or motion)
        return given

    return record_gaps


def build_context(frame_count=300, first=140, last=170):
    rotations = np.tile(np.eye(3), (frame_count, 31, 1, 1))
    root = np.arange(frame_count)[:, None] * np.array([1.0, 0, 0])
    is_known = np.ones((frame_count, 31), bool)
    is_known[first : last + 1, SKELETON.find_joint("LeftArm")] = False
    return GapContext(root, rotations, is_known, first, last, RATE_HZ)


def test_clavicles_are_part_of_the_arms_and_sizes_are_those_of_the_body(record):
    context, joints = build_context(), build_motion_tree().joints
    arm = SKELETON.find_joint("LeftArm")
    turn, raised = (Rotation.from_rotvec([0, 0, angle]).as_matrix() for angle in (0.3, 1.0))
    context.local_rotations[:, arm - 1] = turn
    predicted = np.tile(np.eye(3), (31, len(joints), 1, 1))
    predicted[:, joints == arm] = raised
    gap = predicted, np.full((31, len(joints)), 0.1), np.ones((31, 3)), np.full(31, 0.1)
    given = record(PredictedGap(*gap))
    found = motion_prior.predict_model_gap(MotionPrior({}), context, size_ratio=2.0)
    assert found is not None
    np.testing.assert_allclose(given[0], context.root_position / 2)
    np.testing.assert_allclose(given[1][0, arm], turn)
    assert given[2].shape == (300, len(joints))
    np.testing.assert_allclose(turn @ found.rotations[0, arm], raised, atol=1e-12)
    assert np.isinf(found.variance[:, arm - 1]).all()
    np.testing.assert_allclose(found.variance[:, arm], 0.01)
    np.testing.assert_allclose(found.root_position, 2)
    np.testing.assert_allclose(found.root_variance, 0.04)


def test_unpredicted_gap_is_none(record):
    record(None)
    assert motion_prior.predict_model_gap(MotionPrior({}), build_context()) is None
