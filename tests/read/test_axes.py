import numpy as np
import pytest

from mocapfix import read
from mocapfix.c3d_layout import C3DLayout


@pytest.mark.parametrize("up", "XYZ")
def test_the_way_up_that_is_asked_for_goes_before_what_the_file_tells(cleaned, up):
    told, asked = read.take(cleaned.path), read.take(cleaned.path, up)
    assert isinstance(asked.layout, C3DLayout)
    in_file = told.markers @ told.layout.axes
    np.testing.assert_array_equal(np.nan_to_num(asked.markers[..., 1]), np.nan_to_num(in_file[..., "XYZ".index(up)]))
    np.testing.assert_array_equal(asked.markers @ asked.layout.axes, in_file)
    assert np.linalg.det(asked.layout.axes) == 1
