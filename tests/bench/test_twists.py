"""The figure of how far bones are twisted."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.train.people import write_bvh

from mocapfix.bench import pictures, twists
from mocapfix.errors import ReadError
from mocapfix.skeleton import load_cmu31_skeleton

NAMES = load_cmu31_skeleton().names


@pytest.fixture
def motion(tmp_path):
    """-> a folder in which somebody's left arm is twisted from 0 to 60 degrees, and his thigh swings"""
    rotations = np.tile(np.eye(3), (102, 31, 1, 1))  # the first frame is the T-pose, as in CMU's
    angles = np.append(0, np.linspace(0, 60, 101) + 1e-4)[:, None]  # whole degrees are the T-pose's alone
    rotations[:, NAMES.index("LeftArm")] = Rotation.from_euler("x", angles, degrees=True).as_matrix()
    bone = load_cmu31_skeleton().offsets[NAMES.index("RightLeg")]
    across = np.cross(bone, [0, 0, 1]) / np.linalg.norm(np.cross(bone, [0, 0, 1]))
    rotations[:, NAMES.index("RightUpLeg")] = Rotation.from_rotvec(np.radians(angles) * across).as_matrix()
    write_bvh(tmp_path / "01_01.bvh", rotations)
    return tmp_path


def test_percentiles_are_in_degrees_and_of_twists_alone(motion):
    spread = twists.compute_twist_distribution(motion)
    assert len(spread) == 23
    np.testing.assert_allclose(spread.pop("LeftArm"), [0.6, 15, 30, 45, 59.4], atol=1e-3)
    np.testing.assert_allclose(list(spread.values()), 0, atol=1e-3)


def test_frames_beyond_a_flip_are_left_out(motion):
    rotations = np.tile(np.eye(3), (30, 31, 1, 1))
    rotations[20:, NAMES.index("RightHand")] = Rotation.from_euler("x", 170, degrees=True).as_matrix()
    (motion / "01_01.bvh").unlink()
    write_bvh(motion / "01_02.bvh", rotations)
    np.testing.assert_allclose(twists.compute_twist_distribution(motion)["RightHand"], 0, atol=1e-3)


def test_a_folder_without_motion_is_named(tmp_path):
    with pytest.raises(ReadError, match="holds no motion"):
        twists.compute_twist_distribution(tmp_path)


def test_the_figure_is_drawn(motion, tmp_path):
    pictures.draw_twists(tmp_path / "twists.png", twists.compute_twist_distribution(motion))
    assert (tmp_path / "twists.png").read_bytes().startswith(b"\x89PNG\r\n")


def test_left_and_right_share_a_row():
    told = {name: pictures.split_side(name) for name in ("LHipJoint", "RightLeg", "LeftLeg", "LowerBack", "RThumb")}
    assert told == {
        "LHipJoint": ("left", "HipJoint"),
        "RightLeg": ("right", "Leg"),
        "LeftLeg": ("left", "Leg"),
        "LowerBack": ("middle", "LowerBack"),
        "RThumb": ("right", "Thumb"),
    }
