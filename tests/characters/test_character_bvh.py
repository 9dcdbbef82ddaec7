from dataclasses import replace

import numpy as np
import pytest

from mocapfix.characters.character import compute_character_poses
from mocapfix.characters.character_files import write_character_bvh
from mocapfix.characters.load_character import read_character_skeletons
from mocapfix.errors import WriteError
from mocapfix.model.skeleton import Skeleton
from tests.characters.character_files import (
    FIGURE,
    PREFIX,
    build_figure_character,
    build_mixamo_glb,
    build_motion,
    build_vrm,
    change_bones,
    map_figure,
)
from tests.io.read_back import Bvh


def read_figure(folder, data, name="figure.glb"):
    (folder / name).write_bytes(data)
    character = read_character_skeletons(folder / name)[0]
    return character if character.mapping.bones else replace(character, mapping=map_figure(character.skeleton.names))


def read_world_positions(bvh):
    """Return the positions (T, J, 3) of a BVH in which any joint may have position channels, in file units."""
    from scipy.spatial.transform import Rotation

    positions, rotations, column = [], [], 0
    for joint, (parent, names) in enumerate(zip(bvh.parents, bvh.channels, strict=True)):
        values = bvh.rows[:, column : column + len(names)]
        column += len(names)
        own = values[:, :3] if len(names) == 6 else np.tile(bvh.offsets[joint], (len(values), 1))
        turned = Rotation.from_euler("ZYX", values[:, -3:], degrees=True).as_matrix()
        if parent >= 0:
            own = positions[parent] + (rotations[parent] @ own[..., None])[..., 0]
            turned = rotations[parent] @ turned
        positions.append(own)
        rotations.append(turned)
    assert column == bvh.rows.shape[1]
    return np.stack(positions, axis=1)


def write(folder, character, motion):
    write_character_bvh(folder / "out.bvh", character, motion)
    return Bvh((folder / "out.bvh").read_text(encoding="utf-8"))


def check_positions(bvh, character, motion, unit_m):
    expected = compute_character_poses(character, motion)[0]
    found = read_world_positions(bvh) * unit_m
    for joint, name in enumerate(bvh.names):
        np.testing.assert_allclose(found[:, joint], expected[:, character.skeleton.find_joint(name)], atol=2e-6, err_msg=name)


@pytest.mark.parametrize(("scale", "unit_m"), [(0.01, 0.01), (1.0, 1.0), (0.0254, 0.0254), (0.37, 0.01)])
def test_bones_are_where_the_motion_has_them(tmp_path, scale, unit_m):
    character = build_figure_character(scale)
    motion = build_motion(character)
    bvh = write(tmp_path, character, motion)
    assert set(bvh.names) == set(FIGURE.names)
    assert float(bvh.frame_time) == pytest.approx(1 / 60, rel=1e-7)
    check_positions(bvh, character, motion, unit_m)


def test_the_armature_node_of_a_glb_is_left_out(tmp_path):
    character = read_figure(tmp_path, build_mixamo_glb())
    motion = build_motion(character)
    bvh = write(tmp_path, character, motion)
    assert bvh.names[0] == f"{PREFIX}Hips"
    assert [len(channels) for channels in bvh.channels].count(6) == 1
    check_positions(bvh, character, motion, 0.01)


def test_in_the_rest_pose_all_angles_are_zero_and_offsets_are_the_figure(tmp_path):
    character = read_figure(tmp_path, build_vrm(1), "figure.vrm")
    pelvis = character.mapping.bones["pelvis"][0]
    motion = build_motion(character, 3)
    motion.local_rotations[:] = character.skeleton.rest_rotations
    motion.pelvis_position[:] = character.skeleton.offsets[pelvis]
    bvh = write(tmp_path, character, motion)
    np.testing.assert_allclose(bvh.rows[:, 3:], 0, atol=1e-5)
    read = read_character_skeletons(tmp_path / "out.bvh")[0]
    rest = read.skeleton.compute_rest_pose()[0]
    pelvis_shift = FIGURE.heads[0]  # the position of the root is in its channels
    ours = character.skeleton.compute_rest_pose()[0]
    for bone, name in enumerate(read.skeleton.names):
        np.testing.assert_allclose(rest[bone] + pelvis_shift, ours[character.skeleton.find_joint(name)], atol=1e-5)


def test_a_root_above_the_pelvis_is_kept_and_the_pelvis_moves(tmp_path):
    figure = build_figure_character()
    count = len(figure.skeleton.names)
    character = replace(
        figure,
        skeleton=Skeleton(
            names=("root", *figure.skeleton.names, "ik target"),
            parents=np.concatenate([[-1], figure.skeleton.parents + 1, [0]]),
            offsets=np.concatenate([[[0.1, 0, 0]], figure.skeleton.offsets, [[1, 0, 0]]]),
            ends=np.full((count + 2, 3), np.nan),
            rest_rotations=np.concatenate([np.eye(3)[None], figure.skeleton.rest_rotations, np.eye(3)[None]]),
        ),
        scales=np.full(count + 2, 0.01),
        mapping=map_figure(("root", *figure.skeleton.names), ""),
    )
    motion = build_motion(character)
    bvh = write(tmp_path, character, motion)
    assert bvh.names[:2] == ["root", "Hips"]
    assert bvh.names[-1] == "ik_target"
    assert [len(channels) for channels in bvh.channels[:3]] == [6, 6, 3]
    bvh.names[-1] = "ik target"
    check_positions(bvh, character, motion, 0.01)


def test_several_roots_get_one_above_them(tmp_path):
    figure = build_figure_character()
    count = len(figure.skeleton.names)
    character = replace(
        figure,
        skeleton=Skeleton(
            names=("floor prop", *figure.skeleton.names),
            parents=np.concatenate([[-1], np.where(figure.skeleton.parents < 0, -1, figure.skeleton.parents + 1)]),
            offsets=np.concatenate([[[0.3, 0, 1]], figure.skeleton.offsets]),
            ends=np.full((count + 1, 3), np.nan),
            rest_rotations=np.concatenate([np.eye(3)[None], figure.skeleton.rest_rotations]),
        ),
        scales=np.full(count + 1, 0.01),
        mapping=map_figure(("floor prop", *figure.skeleton.names), ""),
    )
    motion = build_motion(character)
    bvh = write(tmp_path, character, motion)
    assert bvh.names[:3] == ["figure", "floor_prop", "Hips"]
    found, expected = read_world_positions(bvh) * 0.01, compute_character_poses(character, motion)[0]
    np.testing.assert_allclose(
        found[:, bvh.names.index("LeftFoot")], expected[:, character.skeleton.find_joint("LeftFoot")], atol=2e-6
    )
    np.testing.assert_allclose(found[:, 1], np.tile([0.3, 0, 1], (40, 1)), atol=2e-6)


def test_last_bones_have_ends(tmp_path):
    character = build_figure_character()
    bvh = write(tmp_path, character, build_motion(character))
    head = FIGURE.axes[FIGURE.names.index("HeadTop_End")] @ [0, 5, 0]
    np.testing.assert_allclose(bvh.ends["HeadTop_End"], head, atol=1e-5)
    assert len(bvh.ends) == 5
    assert all(np.linalg.norm(end) >= 1 - 1e-6 for end in bvh.ends.values())


def test_names_in_other_scripts_are_kept(tmp_path):
    figure = build_figure_character()
    character = change_bones(figure, names=("\u8170 \u9aa8{1}", *figure.skeleton.names[1:]))
    assert write(tmp_path, character, build_motion(character)).names[0] == "\u8170_\u9aa8_1_"


def test_a_missing_folder_is_refused(tmp_path):
    character = build_figure_character()
    with pytest.raises(WriteError, match="nowhere"):
        write_character_bvh(tmp_path / "nowhere" / "out.bvh", character, build_motion(character))
