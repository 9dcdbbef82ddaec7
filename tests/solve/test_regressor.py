"""Any pose refined by learned inverse kinematics."""

import numpy as np

from mocapfix.solve.learned_ik import PoseRegressor
from tests.solve.ik_cases import SKELETON, build_network, draw_poses, place

SD_M = np.full((12, 31), 1e-3)


def test_refined_poses_do_not_depend_on_other_frames():
    start, (positions, _) = draw_poses(0), place(draw_poses(1))
    model = PoseRegressor(build_network(), SKELETON)
    root, local = model.refine_poses((np.zeros((12, 3)), start), positions, SD_M)
    one_root, one_local = model.refine_poses((np.zeros((1, 3)), start[5:6]), positions[5:6], SD_M[5:6])
    np.testing.assert_allclose(one_root[0], root[5], atol=1e-6)
    np.testing.assert_allclose(one_local[0], local[5], atol=1e-5)


def test_second_pass_starts_from_the_first():
    start, (positions, _) = draw_poses(0), place(draw_poses(1))
    one, two = (PoseRegressor(build_network(), SKELETON, passes) for passes in (1, 2))
    first = one.refine_poses((np.zeros((12, 3)), start), positions, SD_M)
    np.testing.assert_allclose(
        one.refine_poses(first, positions, SD_M)[1], two.refine_poses((np.zeros((12, 3)), start), positions, SD_M)[1]
    )
