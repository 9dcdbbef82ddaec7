import numpy as np

from mocapfix.read.point_types import detect_computed_samples, detect_uncaptured_samples

CAMERAS = 7 << 8


def test_fills_among_samples_with_cameras_and_without_are_told():
    seen = np.ones((2, 4), bool)
    seen[1, 3] = False
    words = np.array([[CAMERAS + 3, 0, 5, CAMERAS], [0, 0.5, 255, 7]])
    np.testing.assert_array_equal(
        detect_computed_samples(words, seen), [[False, False, True, False], [False, False, True, False]]
    )


def test_a_file_that_keeps_residuals_and_no_cameras_was_measured():
    words = np.array([[1, 2, 3, 0, -1]])
    assert not detect_computed_samples(words, words >= 0).any()


def test_samples_without_cameras_tell_only_where_the_file_keeps_cameras():
    words = np.full((10, 10), CAMERAS)
    words[3:6, 2] = 0
    words[6, 2] = 4
    words[7, 2] = -1
    found = np.argwhere(detect_uncaptured_samples(words, words >= 0))
    np.testing.assert_array_equal(found, [[3, 2], [4, 2], [5, 2], [6, 2]])
    words[:, :2] = 0
    assert not detect_uncaptured_samples(words, words >= 0).any()
