import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab import recordings
from mocapfix.model.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton


def write_amass(folder, vectors):
    """Write 9 equal frames of rotation vectors {joint: (3,)}, with the 52 joints of SMPL+H, and return the path."""
    poses = np.zeros((9, 52, 3))
    poses[:, 22:] = 0.3  # fingers
    for name, vector in vectors.items():
        poses[:, recordings.SMPL_JOINT_NAMES.index(name)] = vector
    (folder / "Person7").mkdir()
    path = folder / "Person7" / "walk_poses.npz"
    np.savez(path, poses=poses.reshape(9, -1), trans=np.tile([1.0, 2.0, 3.0], (9, 1)), betas=np.zeros(16), mocap_framerate=60.0)
    return path


def compute_bone_directions(rotations):
    """Return by joint the world direction of the bone beyond it, given local rotations (31, 3, 3)."""
    world, directions = np.empty_like(rotations), {}
    for j, parent in enumerate(SKELETON.parents):
        world[j] = rotations[j] if parent < 0 else world[parent] @ rotations[j]
        if parent >= 0:
            along = world[parent] @ SKELETON.offsets[j]
            directions.setdefault(SKELETON.names[parent], along / max(np.linalg.norm(along), 1e-9))
    return directions


UPRIGHT = Rotation.from_matrix(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])).as_rotvec()  # facing +x, Z up


def test_rest_pose_has_smpl_bone_directions(tmp_path):
    (recording,) = recordings.read_amass_recordings(write_amass(tmp_path, {"pelvis": UPRIGHT}))
    assert (recording.subject, recording.rate_hz, len(recording.rotations)) == ("Person7", 30.0, 5)
    np.testing.assert_allclose(recording.rotations[0, 0], np.eye(3), atol=1e-9)  # Y up, facing +Z
    np.testing.assert_array_equal(recording.root_position, np.tile([2.0, 3.0, 1.0], (5, 1)))
    for name, direction in recordings.SMPL_REST_DIRECTIONS.items():
        for side, sign in (("Left", 1.0), ("Right", -1.0)):
            expected = np.array(direction) * [sign, 1, 1] / np.linalg.norm(direction)
            np.testing.assert_allclose(compute_bone_directions(recording.rotations[0])[side + name], expected, atol=1e-9)


def test_joint_rotation_moves_its_bone_and_descendants_as_in_smpl(tmp_path):
    raised = Rotation.from_rotvec([0.0, 0.0, 0.7])
    bent = Rotation.from_rotvec([0.2, 0.9, 0.0])
    vectors = {"pelvis": UPRIGHT, "left_shoulder": raised.as_rotvec(), "left_elbow": bent.as_rotvec()}
    (recording,) = recordings.read_amass_recordings(write_amass(tmp_path, vectors))
    direction = compute_bone_directions(recording.rotations[4])
    for name, rotation in (("Arm", raised), ("ForeArm", raised * bent)):
        rest = np.array(recordings.SMPL_REST_DIRECTIONS[name]) / np.linalg.norm(recordings.SMPL_REST_DIRECTIONS[name])
        np.testing.assert_allclose(direction[f"Left{name}"], rotation.apply(rest), atol=1e-9)
    rest = np.array(recordings.SMPL_REST_DIRECTIONS["Leg"]) / np.linalg.norm(recordings.SMPL_REST_DIRECTIONS["Leg"])
    np.testing.assert_allclose(direction["LeftLeg"], rest, atol=1e-9)


def test_every_smpl_joint_maps_to_a_cmu_joint():
    assert set(recordings.CMU31_NAME_OF_SMPL_JOINT) == set(recordings.SMPL_JOINT_NAMES)
    assert len(set(recordings.CMU31_NAME_OF_SMPL_JOINT.values())) == 22
    assert set(recordings.CMU31_NAME_OF_SMPL_JOINT.values()) <= set(SKELETON.names)


def test_file_without_poses_yields_nothing(tmp_path):
    np.savez(tmp_path / "shape.npz", betas=np.zeros(16))
    assert not list(recordings.read_amass_recordings(tmp_path / "shape.npz"))


def test_poses_of_fewer_joints_raise(tmp_path):
    np.savez(tmp_path / "short.npz", poses=np.zeros((4, 60)), trans=np.zeros((4, 3)), mocap_framerate=120.0)
    with pytest.raises(ReadError, match="22 joints"):
        list(recordings.read_amass_recordings(tmp_path / "short.npz"))
