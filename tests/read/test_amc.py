import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.animation import Animation, compose_transforms
from mocapfix.animations import joint_mapping
from mocapfix.errors import ReadError
from mocapfix.read import amc, bvh
from mocapfix.write.animation_patch import patch_animation
from tests.asf_files import AMC, ASF, FRAMES

CMU = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "captures" / "cmu"
UNIT = 0.0254 / 0.45
here = pytest.mark.skipif(not CMU.is_dir(), reason="the real captures are not here")


def read(folder: Path, text: str = AMC, skeleton: str = ASF):
    (folder / "09.asf").write_text(skeleton)
    (folder / "09_01.amc").write_text(text)
    return amc.read_amc(folder / "09_01.amc")


def turned(x, y, z):
    return Rotation.from_euler("ZYX", [z, y, x], degrees=True).as_matrix()


def test_bones_turn_about_axes_of_their_own(tmp_path):
    found = read(tmp_path)
    assert found.names == ("root", "lhipjoint", "lfemur", "lfoot", "head")
    assert found.parents.tolist() == [-1, 0, 1, 2, 0]
    assert (found.frame_count, found.first_frame, found.rate) == (2, 7, 120.0)
    assert found.unit_m == pytest.approx(UNIT)
    rotations = found.compute_local_rotations()[0]
    np.testing.assert_allclose(rotations[0], turned(10, 20, 30), atol=1e-12)
    np.testing.assert_array_equal(rotations[1], np.eye(3))
    c = turned(0, 0, 20)
    np.testing.assert_allclose(rotations[2], c @ turned(15, -5, 25) @ c.T, atol=1e-12)
    c = turned(10, 20, 30)
    np.testing.assert_allclose(rotations[3], c @ turned(8, 0, 0) @ turned(0, 7, 0) @ c.T, atol=1e-12)  # ry is turned about first
    c = turned(0, 0, 90)  # the order is ZXY, so 90 is about Z
    np.testing.assert_allclose(rotations[4], c @ turned(0, 0, 40) @ c.T, atol=1e-12)


def test_bones_begin_where_their_parents_end(tmp_path):
    found = read(tmp_path)
    position, rotation = found.compute_world_poses()
    root = np.array([1, 2 + 1, 3.0])  # its position comes on top of the skeleton's
    np.testing.assert_allclose(position[0, 0], root * UNIT)
    np.testing.assert_allclose(position[0, 2], (root + rotation[0, 0] @ [1.5, -2, 0]) * UNIT)
    np.testing.assert_allclose(position[0, 3] - position[0, 2], rotation[0, 2] @ [4.8, -6.4, 0] * UNIT)
    along = turned(0, 0, 90) @ [0.5, 0, 0]  # the head moves along its own axis
    np.testing.assert_allclose(position[0, 4], (root + rotation[0, 0] @ along) * UNIT)
    assert [each.tolist() for each in found.end_sites] == [[], [], [], [[0, 0, 8]], [[0, 16, 0]]]


def test_a_bone_that_grows_takes_the_next_along(tmp_path):
    skeleton = ASF.replace("dof rx ry rz", "dof rx ry rz l")
    longer = read(tmp_path, AMC.replace("lfemur 15 -5 25", "lfemur 15 -5 25 2").replace("16 -6 26", "16 -6 26 0"), skeleton)
    np.testing.assert_allclose(np.linalg.norm(longer.compute_local_positions()[:, 3], axis=-1), [10 * UNIT, 8 * UNIT])


def test_numbers_are_patched_where_they_stand(tmp_path):
    before = read(tmp_path)
    patch_animation(tmp_path / "same.amc", before, before.values)
    assert (tmp_path / "same.amc").read_text() == AMC
    values = before.replace_rotations(np.array([3]), np.array([1]), before.compute_local_rotations()[:1, 3:4])
    patch_animation(tmp_path / "out.amc", before, values)
    assert (tmp_path / "out.amc").read_text() == AMC.replace("lfoot 7.5 8.5", "lfoot 7.0 8.0")


def test_radians_become_degrees(tmp_path):
    spelled = {"root": (3, 4, 5), "lfemur": (0, 1, 2), "head": (1,), "lfoot": (0, 1)}
    told = []
    for words in (line.split() for line in FRAMES.splitlines()):
        turns = [1 + at for at in spelled.get(words[0], ())]
        told.append(" ".join(str(np.radians(float(word))) if at in turns else word for at, word in enumerate(words)))
    found = read(tmp_path, AMC.replace(FRAMES, "\n".join(told)).replace(":DEGREES", ":RADIANS"))
    np.testing.assert_allclose(found.values, read(tmp_path).values, atol=1e-12)


def test_the_rate_is_the_files_where_it_has_one(tmp_path):
    for said in ("# 60 fps", "# at 60.0 frames per second", ":SAMPLES-PER-SECOND 60"):
        found = read(tmp_path, AMC.replace(":DEGREES", f"{said}\n:DEGREES"))
        assert found.rate == 60
        assert not any("rate" in note for note in found.notes)
    for said in ("", "# 0 fps\n"):
        found = read(tmp_path, said + AMC)
        assert found.rate == 120
        assert any("rate" in note for note in found.notes)


def test_a_skeleton_alone_is_its_rest_pose(tmp_path):
    moving = read(tmp_path)
    found = amc.read_amc(tmp_path / "09.asf")
    assert found.frame_count == 1
    np.testing.assert_allclose(found.compute_world_poses()[0][0], moving.compute_rest_positions())


def test_the_skeleton_beside_it_is_taken(tmp_path):
    read(tmp_path)
    (tmp_path / "09_0.asf").write_text("")
    (tmp_path / "1.asf").write_text("")
    assert amc.find_asf(tmp_path / "09_01.amc").name == "09_0.asf"
    (tmp_path / "09_0.asf").unlink()
    assert amc.find_asf(tmp_path / "09_01.amc").name == "09.asf"
    (tmp_path / "09.asf").unlink()
    assert amc.find_asf(tmp_path / "09_01.amc").name == "1.asf"
    (tmp_path / "2.asf").write_text("")
    (tmp_path / "my skeleton.asf").write_text(ASF)
    assert amc.read_amc(tmp_path / "09_01.amc", asf_path=tmp_path / "my skeleton.asf").frames == 2
    (tmp_path / "my skeleton.asf").unlink()
    with pytest.raises(ReadError, match=r"not beside it, only 1\.asf, 2\.asf; put it there as 09\.asf or 09_01\.asf"):
        amc.read_amc(tmp_path / "09_01.amc")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lfoot 7 8\n", "", "line 4: bone lfoot is not in frame 7"),
        ("lfoot 7 8\n", "lfoot 7 8\nlfoot 7 8\n", "line 4: bone lfoot is twice in frame 7"),
        ("lfoot 7 8", "lfoot 7", "line 8: lfoot has 1 numbers where its freedoms are 2"),
        ("lfoot 7 8", "lfoot 7 x", "line 8: 'x' stands where"),
        ("lfoot 7 8", "1 2 3", "line 8: '1' stands where"),
        ("lfoot 7 8", "lfoot 7 8\ntail 1", "line 9: bone tail is not in the skeleton"),
        (FRAMES, "", "holds no frames"),
    ],
)
def test_a_motion_with_a_fault_is_refused_where_it_is(tmp_path, old, new, message):
    assert AMC.count(old) == 1
    with pytest.raises(ReadError, match=rf"09_01\.amc.*{message}"):
        read(tmp_path, AMC.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("length 0.45", "length 0", "line 6: a unit of 0 is none"),
        ("length 0.45", "length x", "line 6: x stands where a number belongs"),
        ("direction 0 0 1", "direction 0 0", "line 37: 0 0 stands where 3 numbers belong"),
        ("axis 0 0 20  XYZ", "axis 0 0 20 XYX", "line 28: 'XYX' is no order of the axes"),
        ("dof ry rx", "dof ry rw", "line 40: rw is none of the freedoms"),
        ("name lfoot", "name lfemur", "line 36: a second bone is called lfemur"),
        ("lfemur lfoot", "lfemur lfoot toe", "line 54: bone toe is in the hierarchy and not"),
        ("lfemur lfoot", "", "line 36: bone lfoot hangs on none"),
        ("lfemur lfoot", "lfemur lfoot head", "line 54: bone head hangs on two"),
        (ASF[ASF.index(":bonedata") :], ":bonedata\n", "the skeleton ends without bones"),
    ],
)
def test_a_skeleton_with_a_fault_is_refused_where_it_is(tmp_path, old, new, message):
    assert ASF.count(old) == 1
    with pytest.raises(ReadError, match=rf"09\.asf, .*{message}"):
        read(tmp_path, skeleton=ASF.replace(old, new))


def the_31_of(animation: Animation) -> np.ndarray:
    """-> (31,) the animation's joint for each of the 31."""
    choice = joint_mapping.map_joints(animation.names, animation.parents)
    assert choice.mapping is not None
    return choice.mapping.file_joints


@here
@pytest.mark.parametrize("trial", ["02_01", "05_13"])
def test_a_trial_of_cmu_is_the_same_as_its_bvh(trial):
    """Hahne's release leaves out the thorax's and the wrists' lengths: where they are put in, all joints agree to 0.1 mm."""
    motion, release = amc.read_amc(CMU / f"{trial}.amc"), bvh.read_bvh(CMU / f"{trial}.bvh")
    order = the_31_of(release)[np.argsort(the_31_of(motion))]
    rotations = release.compute_local_rotations()[1:, order]  # its frame 0 is a T-pose
    degrees = np.degrees(np.linalg.norm(motion.compute_local_rotations() - rotations, axis=(2, 3)) / np.sqrt(2))
    assert degrees.max() < 2e-4
    dropped = [name in ("lowerneck", "lclavicle", "rclavicle", "lhand", "lthumb", "rhand", "rthumb") for name in motion.names]
    offsets = release.offsets[order]
    np.testing.assert_array_equal(offsets[dropped], 0)
    np.testing.assert_allclose(offsets[np.invert(dropped)], motion.offsets[np.invert(dropped)], atol=1e-5)
    mended = release.compute_local_positions()[1:, order]
    mended[:, dropped] = motion.compute_local_positions()[:, dropped]
    position, _ = compose_transforms(motion.parents, mended, rotations)
    assert np.linalg.norm(position - motion.compute_world_poses()[0], axis=-1).max() < 1e-4
    own = release.compute_world_poses()[0][1:, order]
    below = [name for name in motion.names if name[1:] in ("femur", "tibia", "foot", "toes") or name in ("root", "thorax")]
    for name in below:  # nothing was left out on the way to these
        joint = motion.index(name)
        assert np.linalg.norm(own[:, joint] - motion.compute_world_poses()[0][:, joint], axis=-1).max() < 1e-4


@here
def test_captures_come_back_byte_for_byte(tmp_path):
    before = amc.read_amc(CMU / "35_01.amc")
    patch_animation(tmp_path / "35_01.amc", before, before.values)
    assert (tmp_path / "35_01.amc").read_bytes() == (CMU / "35_01.amc").read_bytes()


@settings(max_examples=200)
@given(st.binary(max_size=6), st.integers(0, len(ASF)), st.integers(0, 120), st.booleans())
def test_files_with_any_fault_are_read_or_refused_in_a_sentence(tmp_path_factory, put, at, dropped, of_motion):
    texts = [ASF.encode(), AMC.encode()]
    texts[of_motion] = texts[of_motion][:at] + put + texts[of_motion][at + dropped :]
    folder = tmp_path_factory.getbasetemp()
    (folder / "09.asf").write_bytes(texts[0])
    (folder / "09_01.amc").write_bytes(texts[1])
    found, refused = None, ""
    try:
        found = amc.read_amc(folder / "09_01.amc")
    except ReadError as error:
        refused = str(error)
    if found is None:
        assert re.match(rf"{re.escape(str(folder))}/09(_01)?\.(asf|amc)\b.*[.)]$", refused, re.DOTALL)
    else:
        assert found.compute_world_poses()[0].shape == (found.frame_count, len(found.names), 3)
