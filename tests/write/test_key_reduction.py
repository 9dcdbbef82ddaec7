import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from mocapfix.kernels.key_reduction import interpolate_keys, measure_key_error
from mocapfix.write.gltf import write_gltf
from mocapfix.write.key_reduction import (
    reduce_position_keys,
    reduce_rotation_keys,
    select_motion_keys,
)
from tests.write.read_back import SKELETON, motion_of, smooth_rotations


def make_quaternions(seed, frames, swing):
    quaternions = Rotation.from_matrix(smooth_rotations(seed, frames, 1, swing)[:, 0]).as_quat()
    for t in range(1, frames):
        quaternions[t] *= -1 if quaternions[t] @ quaternions[t - 1] < 0 else 1
    return quaternions


def compute_angles(one, other):
    return (Rotation.from_quat(one).inv() * Rotation.from_quat(other)).magnitude()


def interpolate(keys, values, kind):
    """Return values between keys by scipy's slerp, or linearly in the components and normalised."""
    times = np.arange(len(values))
    if len(keys) == 1:
        return np.repeat(values[keys], len(values), axis=0)
    if kind == "slerp":
        return Slerp(keys, Rotation.from_quat(values[keys]))(times).as_quat()
    return np.stack([np.interp(times, keys, column) for column in values[keys].T], axis=1)  # from_quat normalises


@given(seed=st.integers(0, 2**32), frames=st.integers(2, 200), swing=st.floats(0.01, 6), limit=st.floats(1e-4, 0.5))
def test_rotations_stay_within_the_limit_in_every_frame(seed, frames, swing, limit):
    quaternions = make_quaternions(seed, frames, swing)
    keys = reduce_rotation_keys(quaternions, limit)
    assert keys[0] == 0
    assert len(keys) == 1 or keys[-1] == frames - 1
    largest = max(compute_angles(interpolate(keys, quaternions, kind), quaternions).max() for kind in ("slerp", "linear"))
    assert largest <= limit + 1e-7
    kept = np.isin(np.arange(frames), keys)
    assert measure_key_error(quaternions, kept, True) == pytest.approx(largest, abs=1e-7)
    np.testing.assert_allclose(
        compute_angles(interpolate_keys(quaternions, kept, True), interpolate(keys, quaternions, "slerp")), 0, atol=1e-7
    )


@given(seed=st.integers(0, 2**32), frames=st.integers(1, 200), limit=st.floats(1e-4, 1))
def test_positions_stay_within_the_limit_in_every_frame(seed, frames, limit):
    positions = np.cumsum(np.random.default_rng(seed).normal(size=(frames, 3)) * 0.05, axis=0)
    keys = reduce_position_keys(positions, limit)
    assert keys[0] == 0
    assert keys[-1] == frames - 1
    between = np.stack([np.interp(np.arange(frames), keys, column) for column in positions[keys].T], axis=1)
    largest = np.linalg.norm(between - positions, axis=1).max()
    assert largest <= limit * (1 + 1e-9)
    kept = np.isin(np.arange(frames), keys)
    assert measure_key_error(positions, kept, False) == pytest.approx(largest, abs=1e-9)
    np.testing.assert_allclose(interpolate_keys(positions, kept, False), between, atol=1e-12)


def test_a_uniform_rotation_has_a_key_every_third_of_a_turn_at_most():
    angles = np.radians(np.arange(361.0))
    quaternions = np.stack([np.sin(angles / 2), 0 * angles, 0 * angles, np.cos(angles / 2)], axis=1)
    keys = reduce_rotation_keys(quaternions, np.radians(3))
    assert np.diff(keys).max() <= 120
    assert len(keys) <= 7  # linear interpolation of the components alone is off by more than 3 degrees over longer spans


def test_a_path_of_straight_lines_has_keys_at_its_corners():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 1]], float)
    positions = np.stack([np.interp(np.arange(301), [0, 100, 200, 300], column) for column in corners.T], axis=1)
    assert reduce_position_keys(positions, 1e-6).tolist() == [0, 100, 200, 300]


def test_constant_curves_have_one_key_but_positions_two():
    quaternions = np.tile([0.5, 0.5, 0.5, 0.5], (50, 1))
    assert reduce_rotation_keys(quaternions, 1e-6).tolist() == [0]
    assert reduce_position_keys(np.ones((50, 3)), 1e-6).tolist() == [0, 49]
    assert reduce_position_keys(np.ones((1, 3)), 1e-6).tolist() == [0]


def test_a_lower_limit_keeps_more_keys():
    quaternions = make_quaternions(3, 400, 2.0)
    counts = [len(reduce_rotation_keys(quaternions, np.radians(limit))) for limit in (5, 1, 0.2, 0.01)]
    assert counts == sorted(counts)
    assert counts[0] < 30


def test_without_a_limit_every_frame_is_a_key_except_of_constant_rotations():
    rotations = smooth_rotations(1, 30, 3, swing=1.0)
    rotations[:, 1] = rotations[5, 1]
    keys = select_motion_keys((0, 1, 2), rotations, np.zeros((30, 3)), None, 0.9)
    assert [int(kept.sum()) for kept in keys.rotation_keys] == [30, 1, 30]
    assert keys.position_keys.all()
    assert keys.key_count == 91


def test_a_long_take_is_reduced_in_a_second():
    rotations = np.tile(smooth_rotations(1, 1000, 60, swing=1.0), (10, 1, 1, 1))
    select_motion_keys(range(60), rotations[:20], np.zeros((20, 3)), 0.01, 0.9)  # compile
    started = time.process_time()
    keys = select_motion_keys(range(60), rotations, np.zeros((10_000, 3)), np.radians(0.5), 0.9)
    assert time.process_time() - started < 1.0
    assert keys.key_count < 0.5 * 10_000 * 60


def test_the_solved_skeleton_states_its_largest_error(tmp_path):
    motion = motion_of(smooth_rotations(2, 240, 31, swing=1), np.cumsum(np.full((240, 3), 0.001), axis=0))
    assert write_gltf(tmp_path / "all.glb", SKELETON, motion, 120.0) is None
    reduction = write_gltf(tmp_path / "few.glb", SKELETON, motion, 120.0, np.radians(1))
    assert reduction is not None
    assert 0.5 < reduction.max_error_deg <= 1.0
    assert 0 < reduction.max_distance_m < 0.1
    assert (tmp_path / "few.glb").stat().st_size < 0.8 * (tmp_path / "all.glb").stat().st_size
