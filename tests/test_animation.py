from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.animation import Animation
from mocapfix.read import bvh
from mocapfix.read.coordinates import ROTATIONS_TO_Y_UP
from tests.bvh_files import TEXT


@pytest.fixture
def figure(tmp_path) -> Animation:
    (tmp_path / "figure.bvh").write_text(TEXT)
    return bvh.read_bvh(tmp_path / "figure.bvh")


def test_joints_lie_where_their_numbers_say(figure):
    hips = Rotation.from_euler("ZXY", [10, 20, 30], degrees=True)
    knee = hips * Rotation.from_euler("X", 15, degrees=True)
    position, rotation = figure.compute_world_poses()
    root = np.array([10.5, 90, -3.25])
    below = root + hips.apply([0, -60, 0])
    np.testing.assert_allclose(position[0, 0], root / 100)
    np.testing.assert_allclose(position[0, 1], below / 100)
    np.testing.assert_allclose(position[0, 2], (below + knee.apply([0, -50, 5])) / 100)
    np.testing.assert_allclose(position[1, 3], position[1, 0] + rotation[1, 0] @ [0, 0.605, 0])
    foot = knee * Rotation.from_euler("YZX", [1, 2, 3], degrees=True)
    np.testing.assert_allclose(rotation[0, 2], foot.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(figure.rotations()[:, 4], np.tile(np.eye(3), (3, 1, 1)))


def test_a_file_with_z_up_moves_as_the_same_one_with_y_up(figure):
    axes = ROTATIONS_TO_Y_UP["Z"]
    lying = replace(figure, rotation_y_up_file=axes)
    for mine, turned in zip(lying.compute_world_poses(), figure.compute_world_poses(), strict=True):
        expected = turned @ axes.T if turned.ndim == 3 else axes @ turned @ axes.T
        np.testing.assert_allclose(mine, expected, atol=1e-12)


def test_positions_that_are_displacements_come_on_top_of_the_offset(figure):
    added = replace(figure, is_position_added=np.array([False, False, False, True, False]))
    np.testing.assert_allclose(added.places()[:, 3, 1], [1.2, 1.205, 1.21])


@pytest.mark.parametrize("axes", [np.eye(3), ROTATIONS_TO_Y_UP["Z"]])
def test_what_is_told_comes_back_as_the_numbers_it_was(figure, axes):
    figure = replace(figure, rotation_y_up_file=axes)
    joints, frames = np.arange(5), np.arange(3)
    np.testing.assert_allclose(figure.replace_rotations(joints, frames, figure.rotations()), figure.values, atol=1e-9)
    np.testing.assert_allclose(figure.replace_positions(joints, frames, figure.places()), figure.values, atol=1e-9)


def test_only_the_joints_and_frames_that_are_given_change(figure):
    turned = Rotation.from_euler("YZX", [40, 50, 60], degrees=True).as_matrix()
    values = figure.replace_rotations(np.array([2]), np.array([1]), turned[None, None])
    assert np.argwhere(values != figure.values).tolist() == [[1, 7], [1, 8], [1, 9]]
    np.testing.assert_allclose(values[1, 7:10], [40, 50, 60])
    values = figure.replace_positions(np.array([0, 1]), np.array([2]), np.array([[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]]))
    assert np.argwhere(values != figure.values).tolist() == [[2, 0], [2, 1], [2, 2]]  # the knee has no places
    np.testing.assert_allclose(values[2, :3], [100, 200, 300])


def spinning(figure: Animation, frames: int) -> Animation:
    """-> a long animation whose hips turn about Z, 5 degrees a frame, on and on."""
    values = np.tile(figure.values[0], (frames, 1))
    values[:, 3] = 5.0 * np.arange(frames) - 720
    return replace(figure, values=values)


@pytest.mark.parametrize("frames", [range(300, 320), range(30), range(400)])
def test_angles_follow_the_frames_beside_them(figure, frames):
    before = spinning(figure, 400)
    frames = np.array(frames)
    values = before.replace_rotations(np.array([0]), frames, before.compute_local_rotations()[frames, :1])
    np.testing.assert_allclose(values, before.values, atol=1e-9)


def test_an_animation_of_shorter_frames_knows_its_columns(figure):
    assert [each.tolist() for each in figure.joint_columns] == [[0, 1, 2, 3, 4, 5], [6], [7, 8, 9], [10, 11, 12, 13, 14, 15], []]
    assert figure.get_rotation_channels(3)[0].tolist() == [13, 14, 15]
    assert figure.get_rotation_channels(2)[1].tolist() == [1, 2, 0]
    assert figure.get_position_channels(1)[0].tolist() == []
