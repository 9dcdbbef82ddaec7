from dataclasses import replace

import numpy as np

from mocapfix.detect import external_fills
from tests.detect.bodies import turning


def test_virtual_samples_are_detected_but_not_those_of_this_program():
    take = turning(seconds=1.0)
    blind, ours = np.zeros(take.visible.shape, bool), np.zeros(take.visible.shape, bool)
    blind[10:20, 2] = blind[40:46, 3] = blind[60:70, 2] = ours[60:70, 2] = True
    found = external_fills.detect_virtual_samples(replace(take, uncaptured=blind, computed=ours))
    assert [(f.kind, f.marker, f.first, f.last) for f in found] == [("computed", 2, 10, 19), ("computed", 3, 40, 45)]
    assert found[0].severity == np.linalg.norm(take.markers[19, 2] - take.markers[10, 2])
    assert found[0].reason == "According to the file, no camera captured M2 for 0.08 s: another program filled it."


def test_file_without_camera_counts_has_no_virtual_samples():
    assert external_fills.detect_virtual_samples(turning(seconds=0.5)) == []
