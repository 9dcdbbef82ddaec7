import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.subject import calibration


def seen(counts, markers=20):
    """Return a take (T, K, 3) whose frame t shows counts[t] markers"""
    take = np.zeros((len(counts), markers, 3))
    take[np.arange(markers)[None] >= np.asarray(counts)[:, None]] = np.nan
    return take


def poses(count, rng):
    return Rotation.from_rotvec(rng.normal(0, 0.2, (count * 4, 3))).as_matrix().reshape(count, 4, 3, 3)


def test_candidates_show_the_most_markers():
    counts = [20, 5, 19, 0, 18, 17, 20, 12]
    np.testing.assert_array_equal(calibration.select_candidate_frames(seen(counts)), [0, 2, 4, 6])


@given(st.integers(1, 3000))
def test_candidates_are_evenly_spaced(length):
    found = calibration.select_candidate_frames(seen(np.full(length, 3), markers=3))
    assert len(found) == min(length, calibration.MAX_CANDIDATE_FRAMES)
    assert (np.diff(found) > 0).all()
    assert found[0] == 0
    assert found[-1] == length - 1 or length == 1
    assert np.diff(found).max(initial=1) <= -(-length // len(found)) + 1


def test_few_poses_are_all_selected():
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(
        calibration.select_varied_poses(poses(calibration.MAX_CALIBRATION_FRAMES, rng), rng),
        np.arange(calibration.MAX_CALIBRATION_FRAMES),
    )


@pytest.mark.parametrize("count", [151, 600])
def test_selected_poses_are_distinct_sorted_and_limited(count):
    rng = np.random.default_rng(1)
    found = calibration.select_varied_poses(poses(count, rng), rng)
    assert len(found) == calibration.MAX_CALIBRATION_FRAMES
    assert (np.diff(found) > 0).all()
    assert found[0] >= 0
    assert found[-1] < count


def test_outlying_poses_are_selected_and_root_rotation_is_ignored():
    rng = np.random.default_rng(2)
    still = np.tile(np.eye(3), (600, 4, 1, 1)) + rng.normal(0, 1e-6, (600, 4, 3, 3))
    rare = [17, 230, 599]
    still[rare, 2] = Rotation.from_rotvec([[1, 0, 0], [0, 1, 0], [0, 0, 1]]).as_matrix()
    assert set(rare) <= set(calibration.select_varied_poses(still, np.random.default_rng(0)))
    still[:, 0] = Rotation.from_rotvec(np.random.default_rng(3).normal(size=(600, 3))).as_matrix()
    assert set(rare) <= set(calibration.select_varied_poses(still, np.random.default_rng(0)))


def test_identical_poses_are_selected_once_each():
    found = calibration.select_varied_poses(np.tile(np.eye(3), (400, 4, 1, 1)), np.random.default_rng(0))
    assert len(np.unique(found)) == calibration.MAX_CALIBRATION_FRAMES
