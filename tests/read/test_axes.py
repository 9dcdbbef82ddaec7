import numpy as np
import pytest

from mocapfix.files.layouts import C3dLayout
from mocapfix.read import capture


@pytest.mark.parametrize("up", "XYZ")
def test_the_way_up_that_is_asked_for_goes_before_what_the_file_tells(cleaned, up):
    told, asked = capture.read_capture(cleaned.path), capture.read_capture(cleaned.path, up)
    assert isinstance(told.layout, C3dLayout)
    assert isinstance(asked.layout, C3dLayout)
    in_file = told.markers @ told.layout.rotation_y_up_file
    np.testing.assert_array_equal(np.nan_to_num(asked.markers[..., 1]), np.nan_to_num(in_file[..., "XYZ".index(up)]))
    np.testing.assert_array_equal(asked.markers @ asked.layout.rotation_y_up_file, in_file)
    assert np.linalg.det(asked.layout.rotation_y_up_file) == 1
