import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.animation import compose_transforms
from mocapfix.animations.repair import MappedPriorConditioner
from mocapfix.animations.retarget import SkeletonAlignment
from mocapfix.pose_prior import io
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve.prior_conditioner import PriorConditioner

OURS = load_cmu31_body().skeleton
COUNT = len(OURS.names)
LOST = np.array([OURS.find_joint(name) for name in ("LeftArm", "LeftForeArm")])
TOLD = np.array([OURS.find_joint(name) for name in ("Spine1", "Neck", "RightArm", "RightForeArm", "LeftUpLeg", "LeftLeg")])


@pytest.fixture(scope="module")
def model():
    return io.load_pose_model("gaussian", OURS)


def posed(frames: int) -> np.ndarray:
    """Return (T, 31, 3, 3) local rotations, small ones."""
    rng = np.random.default_rng(0)
    return Rotation.from_rotvec(0.3 * rng.normal(size=(frames * COUNT, 3))).as_matrix().reshape(frames, COUNT, 3, 3)


def theirs(local: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return the same poses as a file has them whose joints stand to ours by `turns` (31, 3, 3)."""
    _, world = compose_transforms(OURS.parents, np.zeros(local.shape[:3]), local)
    own = world @ np.swapaxes(turns, 1, 2)
    told = own.copy()
    for joint, parent in enumerate(OURS.parents):
        if parent >= 0:
            told[:, joint] = np.swapaxes(own[:, parent], 1, 2) @ own[:, joint]
    return told


def test_mapping_to_the_same_skeleton_equals_the_model(model):
    local, frames = posed(6), np.array([1, 3, 4])
    near = np.tile([0.0, 0, 0, 2.0], (3, len(LOST)))
    fit = SkeletonAlignment(np.arange(COUNT), np.tile(np.eye(3), (COUNT, 1, 1)), OURS)
    expected = PriorConditioner(lambda: model, 1.0).predict_rotations(local, TOLD, LOST, frames, near)
    found = MappedPriorConditioner(lambda: model, 1.0, OURS.parents, fit).predict_rotations(local, TOLD, LOST, frames, near)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_other_axes_and_joint_order_give_the_same_prediction(model):
    """The same poses in a file that has the joints' axes otherwise and a joint more at the end."""
    local, frames, rng = posed(6), np.arange(6), np.random.default_rng(1)
    turns = Rotation.random(COUNT, rng).as_matrix()
    fit = SkeletonAlignment(np.arange(COUNT), turns, OURS)
    told = np.concatenate([theirs(local, turns), np.tile(np.eye(3), (6, 1, 1, 1))], axis=1)
    parents = np.r_[OURS.parents, 0]
    near = np.tile([0.0, 0, 0, 2.0], (6, len(LOST) + 1))
    found = MappedPriorConditioner(lambda: model, 1.0, parents, fit).predict_rotations(
        told, TOLD, np.r_[LOST, COUNT], frames, near
    )
    said = PriorConditioner(lambda: model, 1.0).predict_rotations(local, TOLD, LOST, frames, near[:, :8])
    whole = local.copy()
    for at, joint in enumerate(LOST):
        whole[:, joint] = Rotation.from_quat(said[:, 4 * at : 4 * at + 4]).as_matrix()
    expected = theirs(whole, turns)
    for at, joint in enumerate(LOST):
        turned = Rotation.from_quat(found[:, 4 * at : 4 * at + 4]).as_matrix()
        np.testing.assert_allclose(turned, expected[:, joint], atol=1e-8)
    np.testing.assert_array_equal(found[:, -4:], near[:, -4:])  # of which nobody knows


def test_unmapped_joints_return_the_reference(model):
    near = np.ones((2, 8))
    fit = SkeletonAlignment(np.arange(COUNT), np.tile(np.eye(3), (COUNT, 1, 1)), OURS)
    found = MappedPriorConditioner(lambda: model, 1.0, OURS.parents, fit).predict_rotations(
        posed(2), np.zeros(0, int), LOST, np.arange(2), near
    )
    assert found is near
