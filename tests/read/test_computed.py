import numpy as np

from mocapfix.read.computed import computed

CAMERAS = 7 << 8


def test_fills_among_samples_with_cameras_and_without_are_told():
    seen = np.ones((2, 4), bool)
    seen[1, 3] = False
    words = np.array([[CAMERAS + 3, 0, 5, CAMERAS], [0, 0.5, 255, 7]])
    np.testing.assert_array_equal(computed(words, seen), [[False, False, True, False], [False, False, True, False]])


def test_a_file_that_keeps_residuals_and_no_cameras_was_measured():
    words = np.array([[1, 2, 3, 0, -1]])
    assert not computed(words, words >= 0).any()
