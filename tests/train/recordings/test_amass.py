import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train import amass_recordings

SKELETON = load_cmu31_body().skeleton


def saved(folder, vectors):
    """-> an AMASS file of rotation vectors {joint: (3,)}, the same in all of 9 frames, 52 joints as SMPL+H has"""
    poses = np.zeros((9, 52, 3))
    poses[:, 22:] = 0.3  # fingers
    for name, vector in vectors.items():
        poses[:, amass_recordings.SMPL_JOINT_NAMES.index(name)] = vector
    (folder / "Person7").mkdir()
    path = folder / "Person7" / "walk_poses.npz"
    np.savez(path, poses=poses.reshape(9, -1), trans=np.zeros((9, 3)), betas=np.zeros(16), mocap_framerate=60.0)
    return path


def directions(rotations):
    """-> name: where in the world the bone beyond a joint points, of local rotations (31, 3, 3)"""
    world, found = np.empty_like(rotations), {}
    for j, parent in enumerate(SKELETON.parents):
        world[j] = rotations[j] if parent < 0 else world[parent] @ rotations[j]
        if parent >= 0:
            along = world[parent] @ SKELETON.offsets[j]
            found.setdefault(SKELETON.names[parent], along / max(np.linalg.norm(along), 1e-9))
    return found


UPRIGHT = Rotation.from_matrix(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])).as_rotvec()  # facing +x, Z up


def test_at_rest_the_bones_point_as_smpls_do(tmp_path):
    (found,) = amass_recordings.read_amass_recordings(saved(tmp_path, {"pelvis": UPRIGHT}))
    assert (found.subject, found.rate_hz, len(found.rotations)) == ("Person7", 30.0, 5)
    np.testing.assert_allclose(found.rotations[0, 0], np.eye(3), atol=1e-9)  # Y up, facing +Z
    for name, there in amass_recordings.SMPL_REST_DIRECTIONS.items():
        for side, sign in (("Left", 1.0), ("Right", -1.0)):
            expected = np.array(there) * [sign, 1, 1] / np.linalg.norm(there)
            np.testing.assert_allclose(directions(found.rotations[0])[side + name], expected, atol=1e-9)


def test_a_turned_joint_turns_its_bone_and_all_beyond_as_in_smpl(tmp_path):
    lifted = Rotation.from_rotvec([0.0, 0.0, 0.7])
    bent = Rotation.from_rotvec([0.2, 0.9, 0.0])
    vectors = {"pelvis": UPRIGHT, "left_shoulder": lifted.as_rotvec(), "left_elbow": bent.as_rotvec()}
    (found,) = amass_recordings.read_amass_recordings(saved(tmp_path, vectors))
    there = directions(found.rotations[4])
    for name, turn in (("Arm", lifted), ("ForeArm", lifted * bent)):
        rest = np.array(amass_recordings.SMPL_REST_DIRECTIONS[name]) / np.linalg.norm(amass_recordings.SMPL_REST_DIRECTIONS[name])
        np.testing.assert_allclose(there[f"Left{name}"], turn.apply(rest), atol=1e-9)
    rest = np.array(amass_recordings.SMPL_REST_DIRECTIONS["Leg"]) / np.linalg.norm(amass_recordings.SMPL_REST_DIRECTIONS["Leg"])
    np.testing.assert_allclose(there["LeftLeg"], rest, atol=1e-9)


def test_every_body_joint_has_one_of_ours():
    assert set(amass_recordings.CMU31_NAME_OF_SMPL_JOINT) == set(amass_recordings.SMPL_JOINT_NAMES)
    assert len(set(amass_recordings.CMU31_NAME_OF_SMPL_JOINT.values())) == 22
    assert set(amass_recordings.CMU31_NAME_OF_SMPL_JOINT.values()) <= set(SKELETON.names)


def test_a_file_of_a_subjects_shape_holds_no_motion(tmp_path):
    np.savez(tmp_path / "shape.npz", betas=np.zeros(16))
    assert not list(amass_recordings.read_amass_recordings(tmp_path / "shape.npz"))


def test_poses_of_fewer_joints_are_refused(tmp_path):
    np.savez(tmp_path / "short.npz", poses=np.zeros((4, 60)), mocap_framerate=120.0)
    with pytest.raises(ReadError, match="22 joints"):
        list(amass_recordings.read_amass_recordings(tmp_path / "short.npz"))
