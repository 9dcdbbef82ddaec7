"""The two protocols: any pose refined, and a take followed."""

import numpy as np
import pytest

from mocapfix.solve import learned_ik
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


@pytest.mark.parametrize("has_selector", [False, True])
def test_followed_take_reaches_given_joints(has_selector, monkeypatch):
    monkeypatch.setattr(learned_ik, "FIRST_SELECTED_FRAME", 4)
    rotations = draw_poses(1)
    positions, _ = place(rotations)
    model = PoseRegressor(build_network(scale=0.0), SKELETON)
    first = np.zeros((1, 3)), rotations[:1]
    root, local = model.follow_take(first, positions, SD_M, has_selector=has_selector)
    np.testing.assert_allclose(place(local, root)[0], positions, atol=1e-3)


def test_selector_copies_a_pose_that_fits_better(monkeypatch):
    monkeypatch.setattr(learned_ik, "FIRST_SELECTED_FRAME", 0)
    rotations = np.repeat(draw_poses(1)[:1], 12, axis=0)
    positions, _ = place(rotations)
    model = PoseRegressor(build_network(scale=5.0), SKELETON)
    sd_m = np.full((12, 31), 0.1)
    free, selected = (
        model.follow_take((np.zeros((1, 3)), rotations[:1]), positions, sd_m, has_selector=each) for each in (False, True)
    )
    np.testing.assert_allclose(selected[1], rotations, atol=1e-9)
    assert np.abs(free[1] - rotations).max() > 0.1
