from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.errors import WriteError
from mocapfix.io.bvh import compute_euler_angles, write_bvh
from mocapfix.solve import kinematics
from tests.io.read_back import SKELETON, Bvh, motion_of, smooth_rotations


def build_matrices(angles, order="ZYX"):
    return Rotation.from_euler(order, angles.reshape(-1, 3)).as_matrix().reshape(*angles.shape, 3)


def compute_steps(rotations):
    """Return the angle (rad) by which each joint rotates between frames, (T - 1, J)."""
    change = np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:]
    return Rotation.from_matrix(change.reshape(-1, 3, 3)).magnitude().reshape(change.shape[:2])


def rotate_about(axis, degrees):
    """Return rotations (T, 1, 3, 3) rotate_about one axis."""
    return Rotation.from_euler(axis, degrees[:, None], degrees=True).as_matrix()[:, None]


def write(folder, motion, rate=120.0):
    write_bvh(folder / "walk.bvh", SKELETON, motion, rate)
    return Bvh((folder / "walk.bvh").read_text(encoding="utf-8"))


def test_joints_read_back_at_their_positions(tmp_path):
    rotations = smooth_rotations(0, 240, 31, swing=2.5)
    root = np.random.default_rng(1).normal(size=(240, 3)) * 4
    read = write(tmp_path, motion_of(rotations, root))
    position, _ = kinematics.compute_world_poses(SKELETON, motion_of(rotations, root))
    assert read.frames == len(read.rows) == 240
    order = [read.names.index(name) for name in SKELETON.names]
    np.testing.assert_allclose(read.compute_world_positions()[:, order] / 100, position, atol=1e-6)


def test_the_hierarchy_is_that_of_the_skeleton(tmp_path):
    read = write(tmp_path, motion_of(np.tile(np.eye(3), (1, 31, 1, 1))))
    assert sorted(read.names) == sorted(SKELETON.names)
    assert read.channels[0] == ["Xposition", "Yposition", "Zposition", "Zrotation", "Yrotation", "Xrotation"]
    assert all(names == ["Zrotation", "Yrotation", "Xrotation"] for names in read.channels[1:])
    for name, parent, offset in zip(read.names, read.parents, read.offsets, strict=True):
        joint = SKELETON.find_joint(name)
        assert name == "Hips" or read.names[parent] == SKELETON.names[SKELETON.parents[joint]]
        np.testing.assert_allclose(offset, SKELETON.offsets[joint] * 100, atol=1e-6)
    leaves = {name for index, name in enumerate(read.names) if index not in read.parents}
    assert read.ends.keys() == leaves
    for name, end in read.ends.items():
        np.testing.assert_allclose(end, SKELETON.ends[SKELETON.find_joint(name)] * 100, atol=1e-6)
        assert np.linalg.norm(end) > 1  # centimetre
    assert not read.rows.any()  # the rest pose is all zeros


@pytest.mark.parametrize("rate", [24, 50, 59.94, 120, 240, 1000])
def test_frame_time_has_seven_digits(tmp_path, rate):
    text = write(tmp_path, motion_of(np.tile(np.eye(3), (1, 31, 1, 1))), rate).frame_time
    assert len(text.replace(".", "").lstrip("0")) >= 7
    assert float(text) == pytest.approx(1 / rate, rel=1e-7)


@given(seed=st.integers(0, 2**32), swing=st.floats(0.1, 20), frames=st.integers(2, 300))
@example(seed=0, swing=1e-9, frames=2)
def test_angles_reproduce_rotations_with_small_steps(seed, swing, frames):
    rotations = smooth_rotations(seed, frames, 3, swing)
    angles = compute_euler_angles(rotations)
    np.testing.assert_allclose(build_matrices(angles), rotations, atol=1e-6)
    step, turn = np.abs(np.diff(angles, axis=0)).max(axis=-1), compute_steps(rotations)
    assert (step <= np.pi / 2 + turn + 1e-9).all()  # outside gimbal lock
    away = np.cos(angles[..., 1]) ** 2
    clear = np.minimum(away[1:], away[:-1]) > np.sin(np.minimum(2 * turn, np.pi / 2)) ** 2
    assert (step[clear & (turn < np.pi / 4)] < np.pi / 2).all()


@pytest.mark.parametrize("order", ["ZYX", "ZXY", "YXZ", "YZX", "XYZ", "XZY"])
def test_angles_in_every_order_reproduce_rotations(order):
    rotations = smooth_rotations(5, 100, 3, swing=4)
    np.testing.assert_allclose(build_matrices(compute_euler_angles(rotations, order), order), rotations, atol=1e-6)


@pytest.mark.parametrize("order", ["ZYX", "ZXY"])
def test_channels_are_listed_in_rotation_order(tmp_path, order):
    rotations = smooth_rotations(0, 20, 31, swing=2.5)
    write_bvh(tmp_path / "walk.bvh", SKELETON, motion_of(rotations), 120.0, rotation_order=order)
    read = Bvh((tmp_path / "walk.bvh").read_text(encoding="utf-8"))
    assert {tuple(names[-3:]) for names in read.channels} == {tuple(f"{axis}rotation" for axis in order)}
    places, _ = kinematics.compute_world_poses(SKELETON, motion_of(rotations))
    found = read.compute_world_positions()[:, [read.names.index(name) for name in SKELETON.names]]
    np.testing.assert_allclose(found / 100, places, atol=1e-6)


@given(seed=st.integers(0, 2**32))
def test_no_equivalent_angles_are_closer_to_the_previous_frame(seed):
    angles = compute_euler_angles(smooth_rotations(seed, 50, 2, swing=6))
    other = angles * [1, -1, 1] + np.pi
    before, step = angles[:-1], np.linalg.norm(np.diff(angles, axis=0), axis=-1)
    for triple in (angles[1:], other[1:]):
        nearest = (triple - before + np.pi) % (2 * np.pi) - np.pi
        assert (step <= np.linalg.norm(nearest, axis=-1) + 1e-9).all()


@pytest.mark.parametrize(("axis", "channel"), [("Z", 0), ("Y", 1), ("X", 2)])
def test_rotation_about_one_axis_changes_one_channel_through_gimbal_lock(axis, channel):
    degrees = np.arange(0, -1081, -3.0)  # three compute_steps; frames at 90 and 270 degrees rotate_about Y are in gimbal lock
    angles = np.degrees(compute_euler_angles(rotate_about(axis, degrees)))[:, 0]
    expected = np.zeros_like(angles)
    expected[:, channel] = degrees
    np.testing.assert_allclose(angles, expected, atol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_rotation_in_gimbal_lock_is_shared_by_z_and_x(sign):
    degrees = np.arange(0, 720, 2.0)
    locked = rotate_about("Y", np.full(len(degrees), 90.0 * sign)) @ rotate_about("X", degrees)
    angles = np.degrees(compute_euler_angles(locked))[:, 0]
    np.testing.assert_allclose(angles[:, 1], 90 * sign)
    np.testing.assert_allclose(angles[:, 2] - sign * angles[:, 0], degrees, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.diff(angles[:, [0, 2]], axis=0)), 1, atol=1e-6)


@given(z=st.floats(-180, 180), x=st.floats(-180, 180), sign=st.sampled_from([1, -1]), off=st.floats(-0.1, 0.1))
def test_angles_reproduce_rotations_near_gimbal_lock(z, x, sign, off):
    rotation = Rotation.from_euler("ZYX", [[z, 90 * sign + off, x]], degrees=True).as_matrix()[:, None]
    np.testing.assert_allclose(build_matrices(compute_euler_angles(rotation)), rotation, atol=1e-6)


def test_angles_are_continuous_through_gimbal_lock_with_twist():
    time = np.linspace(0, 1, 101)[:, None]  # frame 50 is in gimbal lock
    degrees = np.hstack([20 + 10 * time, 60 + 60 * time, -40 * time])
    rotations = Rotation.from_euler("ZYX", degrees, degrees=True).as_matrix()[:, None]
    angles = np.degrees(compute_euler_angles(rotations))[:, 0]
    np.testing.assert_allclose(np.delete(angles, 50, axis=0), np.delete(degrees, 50, axis=0), atol=1e-6)
    assert np.abs(np.diff(angles, axis=0)).max() < 2


def test_a_last_bone_without_length_is_refused(tmp_path):
    motion = motion_of(np.tile(np.eye(3), (2, 31, 1, 1)))
    for end in (0.0, np.nan):
        ends = SKELETON.ends.copy()
        ends[SKELETON.find_joint("Head")] = end
        with pytest.raises(WriteError, match=r"walk\.bvh.*Head"):
            write_bvh(tmp_path / "walk.bvh", replace(SKELETON, ends=ends), motion, 120.0)
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(WriteError, match="nowhere"):
        write_bvh(tmp_path / "nowhere" / "walk.bvh", SKELETON, motion_of(np.tile(np.eye(3), (2, 31, 1, 1))), 120.0)
