import numpy as np
import pytest

from mocapfix.files.layouts import C3dLayout
from mocapfix.options import ReadOptions
from mocapfix.read import capture


@pytest.mark.parametrize("up", "XYZ")
def test_a_given_up_axis_overrules_that_of_the_file(cleaned, up):
    default, rotated = capture.read_take(cleaned.path), capture.read_take(cleaned.path, ReadOptions(up_axis=up))
    assert isinstance(default.layout, C3dLayout)
    assert isinstance(rotated.layout, C3dLayout)
    in_file = default.markers @ default.layout.rotation_y_up_file
    np.testing.assert_array_equal(np.nan_to_num(rotated.markers[..., 1]), np.nan_to_num(in_file[..., "XYZ".index(up)]))
    np.testing.assert_array_equal(rotated.markers @ rotated.layout.rotation_y_up_file, in_file)
    assert np.linalg.det(rotated.layout.rotation_y_up_file) == 1
