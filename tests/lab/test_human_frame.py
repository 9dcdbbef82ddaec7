"""The human-centric frame: joints in it do not depend on place and heading."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.lab.graph_ik import build_human_frame
from tests.solve.ik_cases import SKELETON, draw_poses, place


def test_rest_pose_has_the_axes_of_the_world():
    frame = build_human_frame(place(np.tile(np.eye(3), (1, 31, 1, 1)))[0])
    np.testing.assert_allclose(frame.to_human[0], np.eye(3), atol=0.05)
    np.testing.assert_allclose(frame.origin, 0)


def test_axes_are_a_rotation_with_y_to_the_thorax_and_x_to_the_left():
    positions, _ = place(draw_poses(0))
    frame = build_human_frame(positions)
    np.testing.assert_allclose(frame.to_human @ np.swapaxes(frame.to_human, 1, 2), np.tile(np.eye(3), (12, 1, 1)), atol=1e-9)
    assert (np.linalg.det(frame.to_human) > 0).all()
    human = frame.transform(positions)
    np.testing.assert_allclose(human[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(human[:, SKELETON.find_joint("Neck")][:, [0, 2]], 0, atol=1e-9)
    assert (human[:, SKELETON.find_joint("LeftUpLeg"), 0] > human[:, SKELETON.find_joint("RightUpLeg"), 0]).all()


def test_joints_in_the_frame_do_not_depend_on_place_and_heading():
    positions, _ = place(draw_poses(0))
    turn = Rotation.from_rotvec([0.5, 1.5, -0.4]).as_matrix()
    moved = positions @ turn.T + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(
        build_human_frame(moved).transform(moved), build_human_frame(positions).transform(positions), atol=1e-9
    )
