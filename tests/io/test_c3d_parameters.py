import numpy as np
import pytest

from mocapfix.contacts.contacts import GaitEvent
from mocapfix.io.c3d_events import add_c3d_events, read_c3d_events
from mocapfix.io.c3d_parameters import C3dHead, replace_point_parameters
from mocapfix.io.capture import read_take
from mocapfix.options import ReadOptions
from tests.c3d_files import c3d_bytes, get_layout

XYZ = np.arange(1, 181, dtype=float).reshape(20, 3, 3) * 7.1


@pytest.mark.parametrize("processor", [84, 85, 86])
def test_a_file_without_the_group_point_gets_labels_and_events(tmp_path, processor):
    path, labels = tmp_path / "bare.c3d", ("LFHD", "RFHD", "CLAV")
    full = c3d_bytes(XYZ, labels, encoding=(processor, True))
    path.write_bytes(full[:512] + bytes([1, 0x50, 1, processor]).ljust(512, b"\0") + full[1024:])
    options = ReadOptions(up_axis="Z")
    bare = read_take(path, options)
    assert bare.labels == ("Point 1", "Point 2", "Point 3")
    data, start = path.read_bytes(), get_layout(bare).data_start_byte
    path.write_bytes(replace_point_parameters(data[:start], labels, has_same_points=True) + data[start:])
    labelled = read_take(path, options)
    assert labelled.labels == labels
    np.testing.assert_array_equal(labelled.markers, bare.markers)
    start = get_layout(labelled).data_start_byte
    path.write_bytes(data)
    assert (
        add_c3d_events(path, get_layout(bare).data_start_byte, {"": [GaitEvent("left", "foot off", 0.1, "markers")]}, 1, 120) == 1
    )
    after = read_take(path, options)
    np.testing.assert_array_equal(after.markers, bare.markers)
    assert len(read_c3d_events(C3dHead(path.read_bytes()[: get_layout(after).data_start_byte]))) == 1
