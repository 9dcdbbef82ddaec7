import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab.training_poses import (
    MIRROR_X_MATRIX,
    compute_sampling_weights,
    detect_rotation_jumps,
    find_longest_jump_free_slice,
    gather_training_poses,
    mirror_joint_name,
    mirror_pose_vectors,
)
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose
from mocapfix.solve.pose_prior import compute_pose_vectors
from tests.lab.motion_files import draw_motion, write_bvh_motion

RATE_HZ = 30.0
NAMES = load_cmu31_body().skeleton.names
REFERENCE = mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations


@pytest.fixture
def folder(tmp_path):
    for name in ("01_01", "02_01", "03_01"):
        write_bvh_motion(tmp_path / f"{name}.bvh", draw_motion(int(name[:2])))
    return tmp_path


def gather(folder, test="02", held_out="03"):
    return gather_training_poses([folder], REFERENCE, frozenset([test]), frozenset([held_out]), lambda text: None)


def test_subjects_are_separated_and_each_pose_is_mirrored(folder):
    poses = gather(folder)
    assert poses.frame_counts == {"01": 24, "03": 24}
    expected = compute_pose_vectors(draw_motion(1), REFERENCE)
    np.testing.assert_allclose(
        poses.training_vectors, np.concatenate([expected, mirror_pose_vectors(expected, NAMES)]), atol=1e-5
    )
    np.testing.assert_allclose(poses.held_out_vectors[:24], compute_pose_vectors(draw_motion(3), REFERENCE), atol=1e-5)


def test_frames_beyond_a_jump_are_dropped_except_for_a_jump_of_the_thumb(folder):
    flipped, flip = draw_motion(1), Rotation.from_rotvec([3.0, 0, 0]).as_matrix()
    flipped[:5, NAMES.index("LeftUpLeg")] = flipped[:5, NAMES.index("LeftUpLeg")] @ flip
    flipped[12:, NAMES.index("LThumb")] = flipped[12:, NAMES.index("LThumb")] @ flip
    write_bvh_motion(folder / "01_01.bvh", flipped)
    poses = gather(folder)
    assert (poses.frame_counts["01"], poses.dropped_frames) == (19, 5)
    np.testing.assert_allclose(poses.training_vectors[:19], compute_pose_vectors(flipped[5:], REFERENCE), atol=1e-5)


def test_missing_subjects_raise(folder):
    with pytest.raises(ReadError, match="the held-out subjects 77"):
        gather(folder, held_out="77")
    for name in ("01", "02"):
        (folder / f"{name}_01.bvh").unlink()
    with pytest.raises(ReadError, match="the training subjects"):
        gather(folder)


def test_retargeted_subjects_are_sampled_less_often():
    subject_index, is_retargeted = np.repeat([0, 1], [30, 10]), np.array([True, False])
    np.testing.assert_allclose(compute_sampling_weights(subject_index, 0.0, is_retargeted, 0.5), np.repeat([0.5, 1.0], [30, 10]))
    balanced = compute_sampling_weights(subject_index, 1.0, is_retargeted, 0.5)
    assert balanced[:30].sum() == pytest.approx(0.5 * balanced[30:].sum())


def rotate_joint(degrees):
    """Return the rotations (T, 1, 3, 3) of a joint by these angles about an axis."""
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * [0.0, 0.6, 0.8]).as_matrix()[:, None]


def test_half_turn_in_a_frame_is_a_jump_and_fast_rotation_is_not():
    np.testing.assert_array_equal(
        detect_rotation_jumps(rotate_joint(np.array([0.0, 50, 230, 260])), RATE_HZ)[:, 0], [False, True, False]
    )


def test_jump_threshold_is_an_angular_speed():
    rotations = rotate_joint(np.array([0.0, 50]))
    assert not detect_rotation_jumps(rotations, 30.0).any()
    assert detect_rotation_jumps(rotations, 60.0).all()


def test_longest_jump_free_slice_is_found():
    assert find_longest_jump_free_slice(rotate_joint(np.array([0.0, 1, 180, 181, 182, 0, 1])), RATE_HZ) == slice(2, 5)
    assert find_longest_jump_free_slice(rotate_joint(np.arange(6.0)), RATE_HZ) == slice(0, 6)
    assert find_longest_jump_free_slice(rotate_joint(np.zeros(1)), RATE_HZ) == slice(0, 1)


def test_jump_of_any_joint_ends_a_slice():
    two = np.concatenate([rotate_joint(np.zeros(5)), rotate_joint(np.array([0.0, 180, 180, 180, 180]))], axis=1)
    assert find_longest_jump_free_slice(two, RATE_HZ) == slice(1, 5)


@pytest.mark.parametrize(
    ("name", "other"),
    [("LeftArm", "RightArm"), ("LHipJoint", "RHipJoint"), ("RThumb", "LThumb"), ("LowerBack", "LowerBack"), ("Head", "Head")],
)
def test_mirror_joint_name(name, other):
    assert mirror_joint_name(name) == other


def test_mirroring_joint_names_is_an_involution():
    assert {mirror_joint_name(name) for name in NAMES} == set(NAMES)
    assert all(mirror_joint_name(mirror_joint_name(name)) == name for name in NAMES)


def test_mirrored_pose_has_mirrored_rotations():
    vectors = np.random.default_rng(0).normal(0, 0.5, (4, len(NAMES), 3))
    original, mirrored = (
        Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix() for v in (vectors, mirror_pose_vectors(vectors, NAMES))
    )
    other = [NAMES.index(mirror_joint_name(name)) for name in NAMES]
    original, mirrored = (m.reshape(4, len(NAMES), 3, 3) for m in (original, mirrored))
    np.testing.assert_allclose(mirrored, MIRROR_X_MATRIX @ original[:, other] @ MIRROR_X_MATRIX, atol=1e-12)
