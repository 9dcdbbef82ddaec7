"""Animations: world poses from channel values, and the channel values of replaced poses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.io import bvh
from mocapfix.io.coordinates import ROTATIONS_TO_Y_UP
from mocapfix.model.animation import Animation
from tests.bvh_files import TEXT


@pytest.fixture
def figure(tmp_path) -> Animation:
    (tmp_path / "figure.bvh").write_text(TEXT, encoding="utf-8")
    return bvh.read_bvh(tmp_path / "figure.bvh")


def test_world_poses_follow_from_channel_values(figure: Animation):
    hips = Rotation.from_euler("ZXY", [10, 20, 30], degrees=True)
    knee = hips * Rotation.from_euler("X", 15, degrees=True)
    positions, rotations = figure.compute_world_poses()
    hips_position = np.array([10.5, 90, -3.25])
    knee_position = hips_position + hips.apply([0, -60, 0])
    np.testing.assert_allclose(positions[0, 0], hips_position / 100)
    np.testing.assert_allclose(positions[0, 1], knee_position / 100)
    np.testing.assert_allclose(positions[0, 2], (knee_position + knee.apply([0, -50, 5])) / 100)
    np.testing.assert_allclose(positions[1, 3], positions[1, 0] + rotations[1, 0] @ [0, 0.605, 0])
    foot = knee * Rotation.from_euler("YZX", [1, 2, 3], degrees=True)
    np.testing.assert_allclose(rotations[0, 2], foot.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(figure.compute_local_rotations()[:, 4], np.tile(np.eye(3), (3, 1, 1)))


def test_motion_with_z_up_equals_rotated_motion_with_y_up(figure: Animation):
    rotation_y_up_file = ROTATIONS_TO_Y_UP["Z"]
    z_up = replace(figure, rotation_y_up_file=rotation_y_up_file)
    (positions, rotations), (positions_z_up, rotations_z_up) = figure.compute_world_poses(), z_up.compute_world_poses()
    np.testing.assert_allclose(positions_z_up, positions @ rotation_y_up_file.T, atol=1e-12)
    np.testing.assert_allclose(rotations_z_up, rotation_y_up_file @ rotations @ rotation_y_up_file.T, atol=1e-12)


def test_displacement_channels_are_added_to_offset(figure: Animation):
    displaced = replace(figure, is_position_added=np.array([False, False, False, True, False]))
    np.testing.assert_allclose(displaced.compute_local_positions()[:, 3, 1], [1.2, 1.205, 1.21])


@pytest.mark.parametrize("rotation_y_up_file", [np.eye(3), ROTATIONS_TO_Y_UP["Z"]])
def test_replacing_poses_by_themselves_changes_no_value(figure: Animation, rotation_y_up_file: np.ndarray):
    figure = replace(figure, rotation_y_up_file=rotation_y_up_file)
    joints, frames = np.arange(5), np.arange(3)
    with_rotations = figure.replace_rotations(joints, frames, figure.compute_local_rotations())
    np.testing.assert_allclose(with_rotations.values, figure.values, atol=1e-9)
    with_positions = figure.replace_positions(joints, frames, figure.compute_local_positions())
    np.testing.assert_allclose(with_positions.values, figure.values, atol=1e-9)


def test_only_given_joints_and_frames_are_replaced(figure: Animation):
    rotation = Rotation.from_euler("YZX", [40, 50, 60], degrees=True).as_matrix()
    values = figure.replace_rotations(np.array([2]), np.array([1]), rotation[None, None]).values
    assert np.argwhere(values != figure.values).tolist() == [[1, 7], [1, 8], [1, 9]]
    np.testing.assert_allclose(values[1, 7:10], [40, 50, 60])
    positions = np.array([[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]])
    values = figure.replace_positions(np.array([0, 1]), np.array([2]), positions).values
    assert np.argwhere(values != figure.values).tolist() == [[2, 0], [2, 1], [2, 2]]  # the knee has no position channels
    np.testing.assert_allclose(values[2, :3], [100, 200, 300])


def spin_hips(figure: Animation, frame_count: int) -> Animation:
    """Return an animation whose hips rotate about Z by 5 degrees per frame, over many turns."""
    values = np.tile(figure.values[0], (frame_count, 1))
    values[:, 3] = 5.0 * np.arange(frame_count) - 720
    return replace(figure, values=values)


@pytest.mark.parametrize("frames", [range(300, 320), range(30), range(400)])
def test_replaced_angles_continue_those_of_adjacent_frames(figure: Animation, frames: Sequence[int]):
    spinning, frame_indices = spin_hips(figure, 400), np.array(frames)
    replaced_figure = spinning.replace_rotations(
        np.array([0]), frame_indices, spinning.compute_local_rotations()[frame_indices, :1]
    )
    np.testing.assert_allclose(replaced_figure.values, spinning.values, atol=1e-9)


def test_channel_columns_are_listed_by_joint(figure: Animation):
    columns = [each.tolist() for each in figure.joint_columns]
    assert columns == [[0, 1, 2, 3, 4, 5], [6], [7, 8, 9], [10, 11, 12, 13, 14, 15], []]
    assert figure.get_rotation_channels(3)[0].tolist() == [13, 14, 15]
    assert figure.get_rotation_channels(2)[1].tolist() == [1, 2, 0]
    assert figure.get_position_channels(1)[0].tolist() == []
