import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.animations.clean import MappedPriorConditioner
from mocapfix.characters.alignment import SkeletonAlignment
from mocapfix.model.skeleton import compose_transforms, load_cmu31_body
from mocapfix.solve import trained_priors
from mocapfix.solve.motion_prior import GapContext, GapPrediction, predict_shipped_gap
from mocapfix.solve.prior_conditioner import PriorConditioner

SKELETON = load_cmu31_body().skeleton
COUNT = len(SKELETON.names)
OCCLUDED = np.array([SKELETON.find_joint(name) for name in ("LeftArm", "LeftForeArm")])
OBSERVED = np.array(
    [SKELETON.find_joint(name) for name in ("Spine1", "Neck", "RightArm", "RightForeArm", "LeftUpLeg", "LeftLeg")]
)


@pytest.fixture(scope="module")
def model():
    return trained_priors.load_pose_model("gaussian", SKELETON)


def posed(frames: int) -> np.ndarray:
    """Return (T, 31, 3, 3) local rotations, small ones."""
    rng = np.random.default_rng(0)
    return Rotation.from_rotvec(0.3 * rng.normal(size=(frames * COUNT, 3))).as_matrix().reshape(frames, COUNT, 3, 3)


def convert_axes(local: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return the same poses in the joint axes of a file, which differ from ours by `turns` (31, 3, 3)."""
    _, world = compose_transforms(SKELETON.parents, np.zeros(local.shape[:3]), local)
    file_world = world @ np.swapaxes(turns, 1, 2)
    file_rotations = file_world.copy()
    for joint, parent in enumerate(SKELETON.parents):
        if parent >= 0:
            file_rotations[:, joint] = np.swapaxes(file_world[:, parent], 1, 2) @ file_world[:, joint]
    return file_rotations


def test_mapping_to_the_same_skeleton_equals_the_model(model):
    local, frames = posed(6), np.array([1, 3, 4])
    reference = np.tile([0.0, 0, 0, 2.0], (3, len(OCCLUDED)))
    fit = SkeletonAlignment(SKELETON, np.arange(COUNT), np.tile(np.eye(3), (COUNT, 1, 1)))
    expected = PriorConditioner(lambda: model, 1.0).predict_rotations(local, OBSERVED, OCCLUDED, frames, reference)
    found = MappedPriorConditioner(lambda: model, 1.0, parents=SKELETON.parents, alignment=fit).predict_rotations(
        local, OBSERVED, OCCLUDED, frames, reference
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_other_axes_and_joint_order_give_the_same_prediction(model):
    """The file has the same poses with other joint axes and an additional joint at the end."""
    local, frames, rng = posed(6), np.arange(6), np.random.default_rng(1)
    turns = Rotation.random(COUNT, rng).as_matrix()
    fit = SkeletonAlignment(SKELETON, np.arange(COUNT), turns)
    file_rotations = np.concatenate([convert_axes(local, turns), np.tile(np.eye(3), (6, 1, 1, 1))], axis=1)
    parents = np.r_[SKELETON.parents, 0]
    reference = np.tile([0.0, 0, 0, 2.0], (6, len(OCCLUDED) + 1))
    found = MappedPriorConditioner(lambda: model, 1.0, parents=parents, alignment=fit).predict_rotations(
        file_rotations, OBSERVED, np.r_[OCCLUDED, COUNT], frames, reference
    )
    predicted = PriorConditioner(lambda: model, 1.0).predict_rotations(local, OBSERVED, OCCLUDED, frames, reference[:, :8])
    whole = local.copy()
    for at, joint in enumerate(OCCLUDED):
        whole[:, joint] = Rotation.from_quat(predicted[:, 4 * at : 4 * at + 4]).as_matrix()
    expected = convert_axes(whole, turns)
    for at, joint in enumerate(OCCLUDED):
        turned = Rotation.from_quat(found[:, 4 * at : 4 * at + 4]).as_matrix()
        np.testing.assert_allclose(turned, expected[:, joint], atol=1e-8)
    np.testing.assert_array_equal(found[:, -4:], reference[:, -4:])  # the additional joint has no counterpart


def test_unmapped_joints_return_the_reference(model):
    reference = np.ones((2, 8))
    fit = SkeletonAlignment(SKELETON, np.arange(COUNT), np.tile(np.eye(3), (COUNT, 1, 1)))
    found = MappedPriorConditioner(lambda: model, 1.0, parents=SKELETON.parents, alignment=fit).predict_rotations(
        posed(2), np.zeros(0, int), OCCLUDED, np.arange(2), reference
    )
    assert found is reference


def move(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the root position and local rotations of a slow motion at 30 Hz."""
    rng, seconds = np.random.default_rng(3), np.arange(frames) / 30
    is_free = load_cmu31_body().free_joints & ~np.isin(SKELETON.names, ("LeftShoulder", "RightShoulder"))
    size, phase = 0.3 * rng.normal(size=(COUNT, 3)) * is_free[:, None], rng.uniform(0, 6, (COUNT, 3))
    vectors = size * np.sin(2 * seconds[:, None, None] + phase)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, COUNT, 3, 3)
    return np.stack([seconds, 1 + 0 * seconds, 0 * seconds], axis=1), rotations


def build_gap(rotations: np.ndarray, root: np.ndarray, joint_count: int) -> GapContext:
    is_known = np.ones((len(root), joint_count), bool)
    is_known[45:60] = False
    return GapContext(root, rotations, is_known, 45, 59, 30.0)


def test_motion_prior_predicts_the_same_in_other_axes(model):
    root, local = move(110)
    turns = Rotation.random(COUNT, np.random.default_rng(1)).as_matrix()
    fit, joints = SkeletonAlignment(SKELETON, np.arange(COUNT), turns), np.arange(COUNT)
    expected = PriorConditioner(lambda: model, 1.0, predict_shipped_gap).predict_gap(build_gap(local, root, COUNT), joints)
    conditioner = MappedPriorConditioner(lambda: model, 1.0, predict_shipped_gap, parents=SKELETON.parents, alignment=fit)
    found = conditioner.predict_gap(build_gap(convert_axes(local, turns), root, COUNT), joints)
    assert expected is not None
    assert found is not None
    np.testing.assert_allclose(found.root_position, expected.root_position, atol=1e-4)
    np.testing.assert_allclose(found.variance, expected.variance, rtol=1e-2)
    is_predicted = np.isfinite(expected.variance[0])
    expected_rotations = convert_axes(expected.rotations, turns)[:, is_predicted]
    np.testing.assert_allclose(found.rotations[:, is_predicted], expected_rotations, atol=1e-3)


def test_joints_without_counterpart_are_not_predicted(model):
    root, local = move(110)
    extra = np.concatenate([local, np.tile(np.eye(3), (110, 1, 1, 1))], axis=1)
    fit = SkeletonAlignment(SKELETON, np.arange(COUNT), np.tile(np.eye(3), (COUNT, 1, 1)))
    conditioner = MappedPriorConditioner(
        lambda: model, 1.0, predict_shipped_gap, parents=np.r_[SKELETON.parents, 0], alignment=fit
    )
    found = conditioner.predict_gap(build_gap(extra, root, COUNT + 1), np.array([COUNT, OCCLUDED[0]]))
    assert isinstance(found, GapPrediction)
    assert np.isinf(found.variance[:, 0]).all()
    assert np.isfinite(found.variance[:, 1]).all()


def test_hips_below_another_root_are_not_predicted(model):
    root, local = move(110)
    fit = SkeletonAlignment(SKELETON, np.arange(COUNT) + 1, np.tile(np.eye(3), (COUNT, 1, 1)))
    conditioner = MappedPriorConditioner(
        lambda: model, 1.0, predict_shipped_gap, parents=np.r_[-1, SKELETON.parents + 1], alignment=fit
    )
    rotations = np.concatenate([np.tile(np.eye(3), (110, 1, 1, 1)), local], axis=1)
    assert conditioner.predict_gap(build_gap(rotations, root, COUNT + 1), OCCLUDED + 1) is None
