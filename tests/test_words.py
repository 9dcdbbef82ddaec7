import numpy as np

from mocapfix.animations import joint_points
from mocapfix.read import bvh
from mocapfix.report.terms import use_joint_terms
from mocapfix.take import Take
from tests.bvh_files import TEXT


def test_what_is_said_of_markers_is_said_of_joints_only_of_an_animation(tmp_path):
    (tmp_path / "figure.bvh").write_text(TEXT)
    said = "Markers: every marker is there, as measured; 3 samples are not."
    animated = joint_points.build_joint_take(bvh.read_bvh(tmp_path / "figure.bvh"))
    assert use_joint_terms(said, animated) == "Joints: every joint is there, as read; 3 values are not."
    assert use_joint_terms(said, Take(np.zeros((1, 1, 3)), ("A",), 100.0)) == said
