import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.train.recordings import bvh
from tests.train.people import walked, write_bvh


def test_what_mocapfix_writes_it_reads(tmp_path):
    rotations = walked(0)
    write_bvh(tmp_path / "07_02.bvh", rotations)
    (found,) = bvh.read(tmp_path / "07_02.bvh")
    assert (found.name, found.subject) == ("07_02", "07")
    assert found.rate == pytest.approx(30.0)
    np.testing.assert_allclose(found.rotations, rotations, atol=1e-7)


def test_fast_motion_is_thinned_and_a_t_pose_at_its_start_left_out(tmp_path):
    rotations = walked(1)
    rotations[0] = np.eye(3)
    write_bvh(tmp_path / "a.bvh", rotations, rate=120.0)
    (found,) = bvh.read(tmp_path / "a.bvh")
    assert found.rate == pytest.approx(30.0)
    assert found.subject == tmp_path.name
    np.testing.assert_allclose(found.rotations, rotations[1::4], atol=1e-7)


def test_channels_are_counted_over_all_joints_and_applied_in_their_order():
    text = ["ROOT Hips", "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation", "JOINT Head"]
    channels = bvh.header([*text, "CHANNELS 3 Yrotation Xrotation Zrotation"])
    assert channels == {"Hips": [(3, "Z"), (4, "X"), (5, "Y")], "Head": [(6, "Y"), (7, "X"), (8, "Z")]}
    values = np.array([[0, 0, 0, 10, 20, 30, 40, 50, 60.0]])
    y, x, z = (Rotation.from_euler(axis, angle, degrees=True) for axis, angle in (("y", 40), ("x", 50), ("z", 60)))
    np.testing.assert_allclose(bvh.joint(channels["Head"], values)[0], (y * x * z).as_matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("JOINT LeftArm", "JOINT LeftWing"),
        ("MOTION", "NOTION"),
        ("Frame Time: 0.0333333333", "Frame Time: 0"),
        ("\n0.0", "\n0.0 1 "),
    ],
)
def test_another_skeleton_or_a_torn_file_is_refused(tmp_path, old, new):
    write_bvh(tmp_path / "a.bvh", walked(3))
    text = (tmp_path / "a.bvh").read_text()
    assert old in text
    (tmp_path / "a.bvh").write_text(text.replace(old, new, 1))
    with pytest.raises(ReadError, match=r"a\.bvh: is no BVH"):
        list(bvh.read(tmp_path / "a.bvh"))
