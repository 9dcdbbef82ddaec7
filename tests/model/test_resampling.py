from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.model.motion import Motion, is_frame_subset, resample_motion
from tests.io.read_back import motion_of, smooth_rotations

RATES = st.sampled_from([24.0, 25.0, 29.97, 30.0, 50.0, 59.94, 60.0, 100.0, 119.88, 120.0, 240.0])


def walking(frames: int, seed: int = 0) -> Motion:
    root = np.cumsum(np.random.default_rng(seed).normal(size=(frames, 3)) * 0.01, axis=0)
    return motion_of(smooth_rotations(seed, frames, 3, swing=2), root)


@given(frames=st.integers(1, 200), rate=RATES, fps=RATES)
def test_first_frame_is_kept_and_none_lies_beyond_the_last(frames, rate, fps):
    before = walking(frames)
    after = resample_motion(before, rate, fps)
    np.testing.assert_allclose(after.root_position[0], before.root_position[0], atol=1e-12)
    np.testing.assert_allclose(after.local_rotations[0], before.local_rotations[0], atol=1e-12)
    lasts, spare = (frames - 1) / rate, 1e-9 / rate
    assert (after.frame_count - 1) / fps <= lasts + spare < after.frame_count / fps + 2 * spare


@given(frames=st.integers(2, 60), seed=st.integers(0, 2**32), times=st.integers(2, 5))
def test_all_frames_are_kept_at_a_multiple_of_the_rate(frames, seed, times):
    before = walking(frames, seed)
    after = resample_motion(before, 30, 30 * times)
    assert after.frame_count == (frames - 1) * times + 1
    np.testing.assert_allclose(after.root_position[::times], before.root_position, atol=1e-12)
    np.testing.assert_allclose(after.local_rotations[::times], before.local_rotations, atol=1e-10)


@given(frames=st.integers(2, 80), rate=RATES, fps=RATES, turn=st.floats(-1.5, 1.5))
def test_uniform_motion_is_exact(frames, rate, fps, turn):
    axis, time = np.array([0.6, 0.0, 0.8]), np.arange(frames)[:, None]
    rotations = Rotation.from_rotvec(axis * turn * time).as_matrix()[:, None]
    after = resample_motion(motion_of(rotations, np.array([[1.0, 2.0, 3.0]]) + time * [0.1, 0, -0.2]), rate, fps)
    at = np.arange(after.frame_count)[:, None] * rate / fps
    np.testing.assert_allclose(after.local_rotations[:, 0], Rotation.from_rotvec(axis * turn * at).as_matrix(), atol=1e-7)
    np.testing.assert_allclose(after.root_position, np.array([[1.0, 2.0, 3.0]]) + at * [0.1, 0, -0.2], atol=1e-9)


@given(frames=st.integers(2, 60), fps=RATES)
def test_results_are_rotations(frames, fps):
    turns = resample_motion(walking(frames), 47.0, fps).local_rotations
    np.testing.assert_allclose(turns @ turns.swapaxes(-1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)


@pytest.mark.parametrize(("rate", "fps"), [(120.0, 30.0), (119.88, 29.97), (100.0, 25.0), (240.0, 120.0), (59.94, 59.94)])
def test_existing_frames_are_bit_identical(rate, fps):
    before = walking(101)
    assert is_frame_subset(rate, fps)
    np.testing.assert_array_equal(
        resample_motion(before, rate, fps).local_rotations, before.local_rotations[:: round(rate / fps)]
    )


def test_same_rate_returns_the_motion():
    before = walking(10)
    assert resample_motion(before, 120.0, 120.0) is before


@pytest.mark.parametrize(("rate", "fps"), [(120.0, 25.0), (30.0, 120.0), (120.0, 50.0)])
def test_rate_with_other_frames_is_no_subset(rate, fps):
    assert not is_frame_subset(rate, fps)


def test_splines_are_more_accurate_than_slerp():
    truth = walking(241, seed=4)
    after = resample_motion(truth.select_frames(np.arange(0, 241, 8)), 30, 240)

    def off(turns):
        return Rotation.from_matrix((turns.swapaxes(-1, -2) @ truth.local_rotations[4::8]).reshape(-1, 3, 3)).magnitude().mean()

    start, end = (Rotation.from_matrix(truth.local_rotations[a].reshape(-1, 3, 3)) for a in (slice(0, -8, 8), slice(8, None, 8)))
    evenly = (start * Rotation.from_rotvec((start.inv() * end).as_rotvec() / 2)).as_matrix().reshape(-1, 3, 3, 3)
    assert off(after.local_rotations[4::8]) < off(evenly) / 10


def test_sd_is_at_least_that_of_the_neighbouring_frames():
    before = replace(walking(5), status=np.array([0, 3, 0, 0, 0]), marker_sd=np.array([[1.0], [9], [2], [2], [2]]))
    after = resample_motion(before, 2.0, 3.0)  # at 0, 2/3, 4/3, 2, 8/3, 10/3, 4
    np.testing.assert_array_equal(after.marker_sd[:, 0], [1, 9, 9, 2, 2, 2, 2])
    np.testing.assert_array_equal(after.status, [0, 3, 3, 0, 0, 0, 0])
