import numpy as np

from mocapfix.io.points import detect_computed_samples, detect_uncaptured_samples

CAMERAS = 7 << 8


def test_computed_samples_have_a_residual_and_no_cameras():
    visible = np.ones((2, 4), bool)
    visible[1, 3] = False
    words = np.array([[CAMERAS + 3, 0, 5, CAMERAS], [0, 0.5, 255, 7]])
    np.testing.assert_array_equal(
        detect_computed_samples(words, visible), [[False, False, True, False], [False, False, True, False]]
    )


def test_samples_are_measured_in_a_file_without_cameras():
    words = np.array([[1.0, 2, 3, 0, -1]])
    assert not detect_computed_samples(words, words >= 0).any()


def test_uncaptured_samples_are_detected_if_the_file_records_cameras():
    words = np.full((10, 10), float(CAMERAS))
    words[3:6, 2] = 0
    words[6, 2] = 4
    words[7, 2] = -1
    found = np.argwhere(detect_uncaptured_samples(words, words >= 0))
    np.testing.assert_array_equal(found, [[3, 2], [4, 2], [5, 2], [6, 2]])
    words[:, :2] = 0
    assert not detect_uncaptured_samples(words, words >= 0).any()
