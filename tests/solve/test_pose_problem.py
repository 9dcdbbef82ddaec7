"""The pose problem of a take."""

from dataclasses import replace

import numpy as np

from mocapfix.kernels.compilation import CACHE_FOLDER
from mocapfix.model.motion import FrameStatus
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.parallel import order_from_gap_ends
from mocapfix.solve.pose_problem import PoseProblem
from mocapfix.solve.terms import MarkerAttachment, build_no_joint_limits, build_pose_prior_term
from tests.kernels import dense_oracle, random_terms

FRAMES, JOINTS, SD = 6, 5, 0.01
PLAIN = (np.inf,)


def problem(seed=0):
    """Return a problem with four exact markers per joint, and its true poses."""
    rng = np.random.default_rng(seed)
    tree = random_terms.draw_tree(rng, JOINTS)._replace(free=np.ones(JOINTS, bool))
    root, local = rng.normal(size=(FRAMES, 3)), np.tile(random_terms.draw_rotations(rng, JOINTS), (FRAMES, 1, 1, 1))
    joints, places = np.repeat(np.arange(JOINTS), 4), rng.normal(0, 0.15, (4 * JOINTS, 3))
    markers = np.stack(
        [
            dense_oracle.compute_point_positions(joints, places, dense_oracle.compute_world(tree, *pose))
            for pose in zip(root, local, strict=True)
        ]
    )
    ignored, solver_mask = (
        build_pose_prior_term(MeanPosePrior("none", local[0], *np.zeros((3, JOINTS, 3, 3)))),
        np.ones(markers.shape[:2], bool),
    )
    return (
        PoseProblem(tree, MarkerAttachment(joints, places), markers, solver_mask, SD, ignored, build_no_joint_limits(JOINTS)),
        root,
        local,
    )


def off(root, local):
    """Return a start 5 cm and up to 0.1 rad a joint off"""
    return root + 0.05, random_terms.draw_rotations(np.random.default_rng(1), JOINTS, 0.1) @ local


def test_exact_markers_recover_poses_and_the_compiled_solver_is_cached():
    body, root, local = problem()
    start = off(root, local)
    given = start[0].copy(), start[1].copy()
    found = body.minimise(start, PLAIN, max_iterations=50)
    assert np.isin(found.status, [FrameStatus.CONVERGED, FrameStatus.EXACT]).all()
    assert (found.iterations > 0).all()
    np.testing.assert_allclose(found.root_position, root, atol=1e-3 * SD)
    np.testing.assert_allclose(found.local_rotations, local, atol=1e-3)
    for now, before in zip(start, given, strict=True):
        np.testing.assert_array_equal(now, before)
    assert CACHE_FOLDER
    assert list(CACHE_FOLDER.glob("kernels_*/*.solve_frames-*.nbi"))


def test_selected_markers_have_the_types_of_the_compiled_solver():
    body, *_ = problem()
    order = np.arange(4 * JOINTS)[::-1]
    selected = replace(body, marker_positions=body.marker_positions[:, order], solver_mask=body.solver_mask[:, order])
    assert not selected.marker_positions.flags.c_contiguous
    assert selected.point_term.measured.flags.c_contiguous
    assert selected.point_term.weight.flags.c_contiguous
    np.testing.assert_array_equal(selected.point_term.measured, body.marker_positions[:, order])


def test_masked_markers_are_ignored():
    body, root, local = problem()
    deaf = replace(
        body, marker_positions=np.full_like(body.marker_positions, np.nan), solver_mask=np.zeros_like(body.solver_mask)
    )
    start = off(root, local)
    found = deaf.minimise(start, PLAIN)
    assert (found.status == FrameStatus.UNCONSTRAINED).all()
    np.testing.assert_array_equal(found.root_position, start[0])
    np.testing.assert_array_equal(found.local_rotations, start[1])


def test_robust_scales_are_in_metres():
    np.testing.assert_allclose(problem()[0].normalise_robust_scales((0.02, 0.05)), [4.0, 25.0])


def test_uncertain_joints_start_from_their_neighbours():
    body, root, local = problem()
    start = root.copy(), local.copy()
    start[1][2:4] = off(root, local)[1][2:4]
    solver_mask, uncertain_joints = body.solver_mask.copy(), np.zeros((FRAMES, JOINTS), bool)
    uncertain_joints[2:4, 3], solver_mask[2:4] = True, False
    order = order_from_gap_ends([(2, 3)], uncertain_joints)
    found = replace(body, solver_mask=solver_mask).minimise(start, (0.05,), order=order).poses
    np.testing.assert_array_equal(found[1][2:4, 3], local[[1, 4], 3])
    np.testing.assert_array_equal(found[1][2:4, :3], off(root, local)[1][2:4, :3])
    np.testing.assert_array_equal(found[0], root)


def test_pose_uncertainty_is_proportional_to_marker_sd():
    """But for the last digits: what holds an unknown that nothing holds is there, too."""
    body, root, local = problem()
    one, two = (replace(body, marker_sd=sd).compute_uncertainty((root, local), np.inf) for sd in (SD, 2 * SD))
    for half, whole, power in zip(one, two, (1, 1, 2, 2), strict=True):
        np.testing.assert_allclose(whole, 2**power * half, rtol=1e-3)
    assert one.marker_sd.shape == (FRAMES, 4 * JOINTS)
    assert one.joint_sd.shape == one.rotation_variance.shape == (FRAMES, JOINTS)
    assert (one.joint_sd < SD).all()
