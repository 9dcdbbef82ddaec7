import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.characters.bone_mapping import map_joints
from mocapfix.errors import ReadError, WriteError
from mocapfix.io import asf_amc, bvh
from mocapfix.io.asf_amc import get_bone_axes_deg, get_cmu_bone_names, read_amc, write_asf_amc
from mocapfix.io.patches import patch_animation
from mocapfix.model.animation import Animation
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import compose_transforms, load_cmu31_body
from mocapfix.solve import kinematics
from tests.asf_files import AMC, ASF, FRAMES
from tests.captures import CAPTURES, needs_captures

SKELETON = load_cmu31_body().skeleton
CMU = CAPTURES / "cmu"


def random_motion(seed: int, frames: int = 20, fixed: tuple[str, ...] = ("LHipJoint", "RHipJoint")) -> Motion:
    """Return a motion of all joints except the fixed ones, with rotations beyond full turns."""
    rng = np.random.default_rng(seed)
    vectors = np.cumsum(rng.normal(0, 0.4, (frames, 31, 3)), axis=0)
    vectors[:, [SKELETON.find_joint(name) for name in fixed]] = 0.0
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 31, 3, 3)
    none = np.zeros((frames, 0))
    return Motion(rng.normal(0, 2, (frames, 3)), rotations, np.zeros(frames, int), np.zeros(frames, int), none, none)


def write_and_read(folder: Path, motion: Motion, first_frame: int = 1):
    write_asf_amc(folder / "w.asf", folder / "w_1.amc", SKELETON, motion, 100.0, first_frame)
    return read_amc(folder / "w_1.amc")


@pytest.mark.parametrize("fixed", [("LHipJoint", "RHipJoint"), ()])
def test_joints_read_back_at_their_positions(tmp_path, fixed):
    motion = random_motion(0, fixed=fixed)
    found = write_and_read(tmp_path, motion, first_frame=301)
    assert (found.frame_count, found.first_frame, found.rate) == (motion.frame_count, 301, 100.0)
    order = [found.names.index(name) for name in get_cmu_bone_names(SKELETON)]
    error_deg = np.degrees(
        np.linalg.norm(found.compute_local_rotations()[:, order] - motion.local_rotations, axis=(2, 3)) / np.sqrt(2)
    )
    assert error_deg.max() < 1e-4
    position, _ = kinematics.compute_world_poses(SKELETON, motion)
    assert np.linalg.norm(found.compute_world_poses()[0][:, order] - position, axis=-1).max() < 1e-6
    for joint, name in enumerate(SKELETON.names):
        if not np.isnan(SKELETON.ends[joint]).any():
            np.testing.assert_allclose(
                found.end_sites[order[joint]][0] * found.unit_m, SKELETON.ends[joint], atol=1e-9, err_msg=name
            )


@pytest.mark.parametrize("moved", ["LeftShoulder", "LThumb", "RHipJoint", "LowerBack"])
def test_joints_that_begin_beside_the_end_of_their_parents_are_kept(tmp_path, moved):
    motion, offsets = random_motion(0), SKELETON.offsets.copy()
    offsets[SKELETON.find_joint(moved)] += [0.01, 0.02, -0.03]
    skeleton = replace(SKELETON, offsets=offsets)
    write_asf_amc(tmp_path / "w.asf", tmp_path / "w_1.amc", skeleton, motion, 100.0)
    found = read_amc(tmp_path / "w_1.amc")
    order = [found.names.index(name) for name in get_cmu_bone_names(SKELETON)]
    position, _ = kinematics.compute_world_poses(skeleton, motion)
    assert np.linalg.norm(found.compute_world_poses()[0][:, order] - position, axis=-1).max() < 1e-6


def test_angles_are_continuous(tmp_path):
    motion = random_motion(1, frames=200, fixed=SKELETON.names)
    motion.local_rotations[:, 0] = Rotation.from_rotvec(np.radians(np.arange(200) * 10.0)[:, None] * [1, 0, 0]).as_matrix()
    found = write_and_read(tmp_path, motion)
    np.testing.assert_allclose(found.values[:, found.get_rotation_channels(0)[0][-1]], np.arange(200) * 10.0, atol=1e-6)


def test_the_layout_is_that_of_cmus_files(tmp_path):
    write_and_read(tmp_path, random_motion(2))
    lines = (tmp_path / "w_1.amc").read_text(encoding="utf-8").splitlines()
    assert [line.split()[0] for line in lines[1:6]] == [":FULLY-SPECIFIED", ":DEGREES", "1", "root", "lfemur"]
    assert len(lines) == 3 + 20 * (1 + 29)  # the frame number, the root and 28 bones: all except the hip joints
    assert all(len(line.split()) in (1, 4, 7) for line in lines[3:])


@pytest.mark.skipif(not CMU.is_dir(), reason="no captures beside the repository")
def test_names_tree_and_axes_are_those_of_cmus_skeleton(tmp_path):
    write_and_read(tmp_path, random_motion(3))
    own, cmu = read_amc(tmp_path / "w.asf"), read_amc(CMU / "02.asf")
    assert sorted(own.names) == sorted(cmu.names)
    for joint, name in enumerate(own.names):
        other = cmu.names.index(name)
        np.testing.assert_allclose(own.rest_rotations[joint], cmu.rest_rotations[other], atol=1e-4, err_msg=name)
        above = own.names[own.parents[joint]] if joint else ""
        assert above == (cmu.names[cmu.parents[other]] if joint else "")
    assert own.unit_m == cmu.unit_m
    assert get_bone_axes_deg("rhumerus") == (180, 30, 90)


def test_refused_motions_leave_no_files(tmp_path):
    motion = random_motion(4)
    motion.root_position[3, 1] = np.nan
    with pytest.raises(WriteError, match=r"w\.amc: the motion has missing frames"):
        write_asf_amc(tmp_path / "w.asf", tmp_path / "w.amc", SKELETON, motion, 100.0)
    assert not list(tmp_path.iterdir())


UNIT = 0.0254 / 0.45


def read(folder: Path, text: str = AMC, skeleton: str = ASF):
    (folder / "09.asf").write_text(skeleton, encoding="utf-8")
    (folder / "09_01.amc").write_text(text, encoding="utf-8")
    return asf_amc.read_amc(folder / "09_01.amc")


def rotate_zyx(x, y, z):
    return Rotation.from_euler("ZYX", [z, y, x], degrees=True).as_matrix()


def test_bones_rotate_about_their_own_axes(tmp_path):
    found = read(tmp_path)
    assert found.names == ("root", "lhipjoint", "lfemur", "lfoot", "head")
    assert found.parents.tolist() == [-1, 0, 1, 2, 0]
    assert (found.frame_count, found.first_frame, found.rate) == (2, 7, 120.0)
    assert found.unit_m == pytest.approx(UNIT)
    rotations = found.compute_local_rotations()[0]
    np.testing.assert_allclose(rotations[0], rotate_zyx(10, 20, 30), atol=1e-12)
    np.testing.assert_array_equal(rotations[1], np.eye(3))
    c = rotate_zyx(0, 0, 20)
    np.testing.assert_allclose(rotations[2], c @ rotate_zyx(15, -5, 25) @ c.T, atol=1e-12)
    c = rotate_zyx(10, 20, 30)
    np.testing.assert_allclose(
        rotations[3], c @ rotate_zyx(8, 0, 0) @ rotate_zyx(0, 7, 0) @ c.T, atol=1e-12
    )  # ry is the innermost rotation
    c = rotate_zyx(0, 0, 90)  # the order is ZXY, so 90 is about Z
    np.testing.assert_allclose(rotations[4], c @ rotate_zyx(0, 0, 40) @ c.T, atol=1e-12)


def test_bones_begin_at_the_end_of_their_parents(tmp_path):
    found = read(tmp_path)
    position, rotation = found.compute_world_poses()
    root = np.array([1, 2 + 1, 3.0])  # its position is added to that of the skeleton
    np.testing.assert_allclose(position[0, 0], root * UNIT)
    np.testing.assert_allclose(position[0, 2], (root + rotation[0, 0] @ [1.5, -2, 0]) * UNIT)
    np.testing.assert_allclose(position[0, 3] - position[0, 2], rotation[0, 2] @ [4.8, -6.4, 0] * UNIT)
    along = rotate_zyx(0, 0, 90) @ [0.5, 0, 0]  # the head moves along its own axis
    np.testing.assert_allclose(position[0, 4], (root + rotation[0, 0] @ along) * UNIT)
    assert [each.tolist() for each in found.end_sites] == [[], [], [], [[0, 0, 8]], [[0, 16, 0]]]


def test_length_channels_move_the_child_bones(tmp_path):
    skeleton = ASF.replace("dof rx ry rz", "dof rx ry rz l")
    longer = read(tmp_path, AMC.replace("lfemur 15 -5 25", "lfemur 15 -5 25 2").replace("16 -6 26", "16 -6 26 0"), skeleton)
    np.testing.assert_allclose(np.linalg.norm(longer.compute_local_positions()[:, 3], axis=-1), [10 * UNIT, 8 * UNIT])


def test_a_patch_changes_only_the_edited_numbers(tmp_path):
    before = read(tmp_path)
    patch_animation(tmp_path / "same.amc", before, before.values)
    assert (tmp_path / "same.amc").read_text(encoding="utf-8") == AMC
    after = before.replace_rotations(np.array([3]), np.array([1]), before.compute_local_rotations()[:1, 3:4])
    patch_animation(tmp_path / "out.amc", before, after.values)
    assert (tmp_path / "out.amc").read_text(encoding="utf-8") == AMC.replace("lfoot 7.5 8.5", "lfoot 7.0 8.0")


def test_radians_are_converted_to_degrees(tmp_path):
    rotation_columns = {"root": (3, 4, 5), "lfemur": (0, 1, 2), "head": (1,), "lfoot": (0, 1)}
    lines = []
    for words in (line.split() for line in FRAMES.splitlines()):
        angles = [1 + at for at in rotation_columns.get(words[0], ())]
        lines.append(" ".join(str(np.radians(float(word))) if at in angles else word for at, word in enumerate(words)))
    found = read(tmp_path, AMC.replace(FRAMES, "\n".join(lines)).replace(":DEGREES", ":RADIANS"))
    np.testing.assert_allclose(found.values, read(tmp_path).values, atol=1e-12)


def test_the_rate_is_read_from_comments_and_keywords(tmp_path):
    for spelling in ("# 60 fps", "# at 60.0 frames per second", ":SAMPLES-PER-SECOND 60"):
        found = read(tmp_path, AMC.replace(":DEGREES", f"{spelling}\n:DEGREES"))
        assert found.rate == 60
        assert not any("rate" in note for note in found.notes)
    for comment in ("", "# 0 fps\n"):
        found = read(tmp_path, comment + AMC)
        assert found.rate == 120
        assert any("rate" in note for note in found.notes)


def test_an_asf_alone_is_read_as_its_rest_pose(tmp_path):
    moving = read(tmp_path)
    found = asf_amc.read_amc(tmp_path / "09.asf")
    assert found.frame_count == 1
    np.testing.assert_allclose(found.compute_world_poses()[0][0], moving.skeleton.rest_positions)


def test_the_asf_is_found_in_the_folder_of_the_amc(tmp_path):
    read(tmp_path)
    (tmp_path / "09_0.asf").write_text("", encoding="utf-8")
    (tmp_path / "1.asf").write_text("", encoding="utf-8")
    assert asf_amc.find_asf(tmp_path / "09_01.amc").name == "09_0.asf"
    (tmp_path / "09_0.asf").unlink()
    assert asf_amc.find_asf(tmp_path / "09_01.amc").name == "09.asf"
    (tmp_path / "09.asf").unlink()
    assert asf_amc.find_asf(tmp_path / "09_01.amc").name == "1.asf"
    (tmp_path / "2.asf").write_text("", encoding="utf-8")
    (tmp_path / "my skeleton.asf").write_text(ASF, encoding="utf-8")
    assert asf_amc.read_amc(tmp_path / "09_01.amc", asf_path=tmp_path / "my skeleton.asf").frame_count == 2
    (tmp_path / "my skeleton.asf").unlink()
    with pytest.raises(ReadError, match=r"not in its folder, only 1\.asf, 2\.asf; copy it there as 09\.asf or 09_01\.asf"):
        asf_amc.read_amc(tmp_path / "09_01.amc")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lfoot 7 8\n", "", "line 4: bone lfoot is missing in frame 7"),
        ("lfoot 7 8\n", "lfoot 7 8\nlfoot 7 8\n", "line 4: bone lfoot occurs twice in frame 7"),
        ("lfoot 7 8", "lfoot 7", "line 8: bone lfoot has 1 values and 2 degrees of freedom"),
        ("lfoot 7 8", "lfoot 7 x", "line 8: 'x' is given where"),
        ("lfoot 7 8", "1 2 3", "line 8: '1' is given where"),
        ("lfoot 7 8\n", "lfoot 7 8\n" + 400 * "9" + "\n", "line 9: '9999"),
        ("lfoot 7 8", "lfoot 7 8\ntail 1", "line 9: bone tail is not in the skeleton"),
        (FRAMES, "", "has no frames"),
    ],
)
def test_invalid_amc_files_are_refused_with_the_line(tmp_path, old, new, message):
    assert AMC.count(old) == 1
    with pytest.raises(ReadError, match=rf"09_01\.amc.*{message}"):
        read(tmp_path, AMC.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("length 0.45", "length 0", "line 6: the unit of length is 0 and must be positive"),
        ("length 0.45", "length x", "line 6: x is given where a number is expected"),
        ("direction 0 0 1", "direction 0 0", "line 37: 0 0 is given where 3 numbers are expected"),
        ("axis 0 0 20  XYZ", "axis 0 0 20 XYX", "line 28: 'XYX' is not an order of the axes"),
        ("dof ry rx", "dof ry rw", "line 40: rw is not one of the degrees of freedom"),
        ("name lfoot", "name lfemur", "line 36: there is a second bone lfemur"),
        ("lfemur lfoot", "lfemur lfoot toe", "line 54: bone toe is in the hierarchy and not"),
        ("lfemur lfoot", "", "line 36: bone lfoot has no parent"),
        ("lfemur lfoot", "lfemur lfoot head", "line 54: bone head has two parents"),
        (ASF[ASF.index(":bonedata") :], ":bonedata\n", "the skeleton has no bones"),
    ],
)
def test_invalid_asf_files_are_refused_with_the_line(tmp_path, old, new, message):
    assert ASF.count(old) == 1
    with pytest.raises(ReadError, match=rf"09\.asf, .*{message}"):
        read(tmp_path, skeleton=ASF.replace(old, new))


def map_to_31_joints(animation: Animation) -> np.ndarray:
    """Return the animation's joint for each of the 31 joints."""
    file_joints = map_joints(animation.names, animation.parents).file_joints
    assert file_joints is not None
    return file_joints


@needs_captures
@pytest.mark.parametrize("trial", ["02_01", "05_13"])
def test_an_amc_of_cmu_agrees_with_its_bvh(trial):
    """Hahne's release omits the lengths of thorax and wrists. With these inserted in, all joints agree to 0.1 mm."""
    motion, release = asf_amc.read_amc(CMU / f"{trial}.amc"), bvh.read_bvh(CMU / f"{trial}.bvh")
    order = map_to_31_joints(release)[np.argsort(map_to_31_joints(motion))]
    rotations = release.compute_local_rotations()[1:, order]  # its frame 0 is a T-pose
    degrees = np.degrees(np.linalg.norm(motion.compute_local_rotations() - rotations, axis=(2, 3)) / np.sqrt(2))
    assert degrees.max() < 2e-4
    omitted = [name in ("lowerneck", "lclavicle", "rclavicle", "lhand", "lthumb", "rhand", "rthumb") for name in motion.names]
    offsets = release.offsets[order]
    np.testing.assert_array_equal(offsets[omitted], 0)
    np.testing.assert_allclose(offsets[np.invert(omitted)], motion.offsets[np.invert(omitted)], atol=1e-5)
    completed = release.compute_local_positions()[1:, order]
    completed[:, omitted] = motion.compute_local_positions()[:, omitted]
    position, _ = compose_transforms(motion.parents, completed, rotations)
    assert np.linalg.norm(position - motion.compute_world_poses()[0], axis=-1).max() < 1e-4
    own = release.compute_world_poses()[0][1:, order]
    below = [name for name in motion.names if name[1:] in ("femur", "tibia", "foot", "toes") or name in ("root", "thorax")]
    for name in below:  # no length is omitted between the root and these
        joint = motion.names.index(name)
        assert np.linalg.norm(own[:, joint] - motion.compute_world_poses()[0][:, joint], axis=-1).max() < 1e-4


@needs_captures
def test_an_unchanged_patch_is_byte_identical(tmp_path):
    before = asf_amc.read_amc(CMU / "35_01.amc")
    patch_animation(tmp_path / "35_01.amc", before, before.values)
    assert (tmp_path / "35_01.amc").read_bytes() == (CMU / "35_01.amc").read_bytes()


@settings(max_examples=200)
@given(st.binary(max_size=6), st.integers(0, len(ASF)), st.integers(0, 120), st.booleans())
def test_damaged_files_are_read_or_refused_with_a_message(tmp_path_factory, inserted, at, removed, of_motion):
    texts = [ASF.encode(), AMC.encode()]
    texts[of_motion] = texts[of_motion][:at] + inserted + texts[of_motion][at + removed :]
    folder = tmp_path_factory.getbasetemp()
    (folder / "09.asf").write_bytes(texts[0])
    (folder / "09_01.amc").write_bytes(texts[1])
    found, refused = None, ""
    try:
        found = asf_amc.read_amc(folder / "09_01.amc")
    except ReadError as error:
        refused = str(error)
    if found is None:
        assert re.match(rf"{re.escape(str(folder))}/09(_01)?\.(asf|amc)\b.*[.)]$", refused, re.DOTALL)
    else:
        assert found.compute_world_poses()[0].shape == (found.frame_count, len(found.names), 3)


def test_long_number_in_the_header_is_read_at_once(tmp_path):
    started = time.process_time()
    assert read(tmp_path, f"# 120 fps of {'9' * 20_000}\n{AMC}").rate == 120
    assert read(tmp_path, f"# {'9' * 20_000}\n{AMC}").rate == 120
    assert time.process_time() - started < 1
