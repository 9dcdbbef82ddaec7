import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import cmu31
from mocapfix.train.recordings import amc

NAMES = cmu31().skeleton.names
ASF = """\
# as CMU's, of some bones
:version 1.10
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 2
     name lfemur
     direction 0.34 -0.94 0
     length 7.1
     axis 0 0 20  XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
     id 3
     name ltibia
     axis 10 20 30 XYZ
    dof rx
  end
  begin
     id 1
     name lhipjoint
     axis 0 0 0 XYZ
  end
  begin
     id 9
     name lthumb
     axis 0 0 0 XYZ
    dof rx rz
  end
:hierarchy
  begin
    root lhipjoint
  end
"""
FRAME = "root 1 2 3 10 20 30\nlfemur 15 -5 25\nltibia 40\nlthumb 7 8\n"


def rotation(x, y, z):
    return Rotation.from_euler("ZYX", [z, y, x], degrees=True).as_matrix()


@pytest.fixture
def motion(tmp_path):
    (tmp_path / "09.asf").write_text(ASF)
    frames = "".join(f"{i + 1}\n{FRAME if i % 4 == 0 else FRAME.replace('40', '50')}" for i in range(9))
    (tmp_path / "09_01.amc").write_text(f"#!OML\n:FULLY-SPECIFIED\n:DEGREES\n{frames}")
    return tmp_path / "09_01.amc"


def test_bones_turn_about_axes_of_their_own(motion):
    (found,) = amc.read(motion)
    assert (found.name, found.subject, found.rate) == ("09_01", "09", 30.0)
    assert found.rotations.shape == (3, 31, 3, 3)
    expected = {"Hips": rotation(10, 20, 30), "LThumb": rotation(7, 0, 8)}
    c = rotation(0, 0, 20)
    expected["LeftUpLeg"] = c @ rotation(15, -5, 25) @ c.T
    c = rotation(10, 20, 30)
    expected["LeftLeg"] = c @ rotation(40, 0, 0) @ c.T
    for j, name in enumerate(NAMES):
        np.testing.assert_allclose(found.rotations[:, j], np.tile(expected.get(name, np.eye(3)), (3, 1, 1)), atol=1e-12)


def test_every_bone_is_one_joint():
    assert sorted(amc.BONES.values()) == sorted(NAMES)


def test_without_its_skeleton_a_motion_is_refused(motion):
    (motion.parent / "09.asf").unlink()
    with pytest.raises(ReadError, match=r"09\.asf, is not beside it"):
        list(amc.read(motion))


def test_a_frame_that_lacks_a_bone_is_refused(motion):
    motion.write_text(motion.read_text().replace("ltibia 40", "", 1))
    with pytest.raises(ReadError, match="ltibia"):
        list(amc.read(motion))
