import numpy as np

from mocapfix import joint_points
from mocapfix.read import bvh
from mocapfix.take import Take
from mocapfix.words import worded
from tests.bvh_files import TEXT


def test_what_is_said_of_markers_is_said_of_joints_only_of_an_animation(tmp_path):
    (tmp_path / "figure.bvh").write_text(TEXT)
    said = "Markers: every marker is there, as measured; 3 samples are not."
    animated = joint_points.places(bvh.animation(tmp_path / "figure.bvh"))
    assert worded(said, animated) == "Joints: every joint is there, as read; 3 values are not."
    assert worded(said, Take(np.zeros((1, 1, 3)), ("A",), 100.0)) == said
