"""The pose solve: known poses found again, wild markers withstood, frames that say little survived, errors foretold."""

import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels.levenberg import CONVERGED, RAN_OUT, Pull, solve_frames, uncertainties
from mocapfix.kernels.threads import over_frames
from tests.kernels import dense

PLAIN = np.array([np.inf])


def solved(problem, seen, weight, scales2, target, prior, root, local, most=50):
    """-> root (T, 3), local (T, J, 3, 3), status (T,), iterations (T,) from one start for all, or one for each frame"""
    frames = len(seen)
    root = np.ascontiguousarray(np.broadcast_to(root, (frames, 3)))
    local = np.ascontiguousarray(np.broadcast_to(local, (frames, *local.shape[-3:])))
    root, local, status, iterations = root.copy(), local.copy(), np.full(frames, -1), np.full(frames, -1)
    over_frames(
        solve_frames, frames, problem.tree, problem.attached, seen, weight, scales2, target, prior, root, local, most, status,
        iterations,
    )  # fmt: skip
    return root, local, status, iterations


def foretold(problem, seen, weight, target, prior, root, local):
    """-> standard deviation of markers (T, K) and joints (T, J), variance of joints' turns (T, J) and the root's place (T,)"""
    frames = len(seen)
    marker_sd, root_var = np.empty(weight.shape), np.empty(frames)
    joint_sd, joint_var = np.empty(local.shape[:2]), np.empty(local.shape[:2])
    over_frames(
        uncertainties, frames, problem.tree, problem.attached, seen, weight, np.inf, target, prior, root, local, marker_sd,
        joint_sd, joint_var, root_var,
    )  # fmt: skip
    return marker_sd, joint_sd, joint_var, root_var


def placed(problem, root, local):
    """-> (T, K, 3) where poses put the markers"""
    poses = zip(root, local, strict=True)
    return np.stack([dense.markers(problem.attached, *dense.forward(problem.tree, *pose)) for pose in poses])


def loose(joints):
    """-> a pull to the rest pose that only breaks ties"""
    return dense.no_pull(joints)._replace(information=np.tile(np.eye(3) / 9, (1, joints, 1, 1)))


def near(rng, problem, far):
    """-> a pose each of whose unknowns is about `far` off the problem's"""
    return dense.moved(problem.tree, problem.root, problem.local, rng.normal(0, far, dense.unknowns(problem.tree)))


@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_exact_markers_bring_a_pose_back(seed, joints):
    rng = np.random.default_rng(seed)
    problem = dense.frame(rng, joints, markers_each=4, noise=0.0)
    weight = np.full((1, len(problem.seen)), 1e12)  # a micrometre, so that the last of it is worth a step
    none = dense.no_pull(joints)
    root, local, status, _ = solved(problem, problem.seen[None], weight, PLAIN, none, none, *near(rng, problem, 0.1))
    assert status[0] == CONVERGED
    np.testing.assert_allclose(root[0], problem.root, atol=1e-6)
    np.testing.assert_allclose(local[0], problem.local, atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_where_it_ends_nothing_pulls_any_more(seed):
    problem = dense.frame(np.random.default_rng(seed), 6)
    pull, none = dense.one(problem.pull), dense.no_pull(6)
    both = [solved(problem, problem.seen[None], problem.weight[None], PLAIN, *pulls, problem.root, problem.local)
            for pulls in ((pull, none), (none, pull))]  # fmt: skip
    root, local, status, _ = both[0]
    assert status[0] == CONVERGED
    residual = dense.pose_residuals(problem._replace(root=root[0], local=local[0]))
    slope = dense.jacobian(residual, dense.unknowns(problem.tree))
    gradient = slope.T @ residual(np.zeros(slope.shape[1]))
    assert gradient @ np.linalg.solve(slope.T @ slope, gradient) < 1e-3  # what another step would bring, in squared sd
    np.testing.assert_allclose(both[1][1], local, atol=1e-12)


def test_a_wild_marker_is_withstood_by_the_robust_solve_alone():
    rng = np.random.default_rng(3)
    problem = dense.frame(rng, 6, markers_each=6, noise=0.0)
    seen, weight, none = problem.seen[None].copy(), np.full((1, len(problem.seen)), 1e4), dense.no_pull(6)
    seen[0, 8] += [0.3, -0.4, 0.2]
    start = near(rng, problem, 0.05)
    scales2 = (np.array([0.2, 0.1, 0.05]) * 100) ** 2
    worst = [
        np.abs(placed(problem, *solved(problem, seen, weight, scales, none, none, *start)[:2])[0] - problem.seen).max()
        for scales in (scales2, PLAIN)
    ]
    assert worst[0] < 0.001
    assert worst[1] > 0.03


@pytest.mark.parametrize("held", [True, False], ids=["loosely held", "held by nothing"])
@pytest.mark.parametrize("scales2", [PLAIN, np.array([400.0, 25.0])], ids=["infinite scale", "robust"])
def test_frames_that_say_little_end_in_a_status_and_a_finite_pose(held, scales2):
    rng = np.random.default_rng(4)
    problem = dense.frame(rng, 8)
    count, none = len(problem.seen), dense.no_pull(8)
    seen, weight = np.tile(problem.seen, (6, 1, 1)), np.full((6, count), 1e4)
    weight[0] = 0.0  # no marker, and whatever in its place
    seen[0] = np.nan
    weight[1, 1:] = 0.0  # one marker
    seen[2] = [0.3, 1.0, -2.0]  # all at one point
    seen[3] = 0.0
    weight[4, 2:] = 0.0  # two
    seen[5] += 100.0  # all far off
    prior = loose(8) if held else none
    root, local, status, iterations = solved(problem, seen, weight, scales2, none, prior, problem.root, problem.local, most=12)
    assert np.isin(status, [CONVERGED, RAN_OUT]).all()
    assert ((iterations >= 1) & (iterations <= 12 * len(scales2))).all()
    assert np.isfinite(root).all()
    np.testing.assert_allclose(local @ np.swapaxes(local, 2, 3), np.tile(np.eye(3), (6, 8, 1, 1)), atol=1e-12)
    fixed = ~problem.tree.free
    np.testing.assert_array_equal(local[:, fixed], np.tile(problem.local[fixed], (6, 1, 1, 1)))
    if not held:
        np.testing.assert_array_equal(local[0], problem.local)
        np.testing.assert_array_equal(root[0], problem.root)
    found = foretold(problem, seen, weight, none, loose(8), root, local)
    assert all(np.isfinite(each).all() for each in found)
    assert (found[0] >= 0).all()
    assert found[3][0] > 1e6  # without a marker the root may be anywhere


def test_rotations_stay_rotations_over_thousands_of_steps_down_a_deep_tree():
    """Each frame starts from the last one's pose; rounding must not gather from joint to joint."""
    rng, joints = np.random.default_rng(8), 10
    body = dense.Tree(np.arange(-1, joints - 1), rng.normal(0, 0.3, (joints, 3)), np.ones(joints, bool))
    problem = dense.frame(rng, joints, markers_each=0)._replace(tree=body)
    pull, none = dense.one(problem.pull), dense.no_pull(joints)
    nothing, unheard = np.zeros((1, 0, 3)), np.zeros((1, 0))
    local = problem.local
    for _ in range(400):
        wanted = pull._replace(rotations=(dense.rotations(rng, joints, 0.5) @ problem.local)[None])
        _, (local,), _, iterations = solved(problem, nothing, unheard, PLAIN, wanted, none, problem.root, local)
        assert iterations[0] > 1
    np.testing.assert_allclose(local @ np.swapaxes(local, 1, 2), np.tile(np.eye(3), (joints, 1, 1)), atol=1e-12)


def test_the_result_does_not_depend_on_the_number_of_threads(monkeypatch):
    rng = np.random.default_rng(5)
    problem = dense.frame(rng, 8)
    seen = problem.seen + rng.normal(0, 0.05, (37, *problem.seen.shape))
    weight = np.full(seen.shape[:2], 1e4)
    results = []
    for cores in (1, 2, 5):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=cores: set(range(cores)), raising=False)
        pulls = dense.one(problem.pull), loose(8)
        results.append(solved(problem, seen, weight, PLAIN, *pulls, problem.root, problem.local, most=8))
    for other in results[1:]:
        for found, expected in zip(other, results[0], strict=True):
            np.testing.assert_array_equal(found, expected)
    assert len(np.unique(results[0][0], axis=0)) == 37


@pytest.mark.parametrize("frames", [1, 2, 7, 8, 9, 100])
@pytest.mark.parametrize("cores", [1, 2, 3])
def test_blocks_make_up_all_frames_once(monkeypatch, frames, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    visits = np.zeros(frames, int)

    def visit(first, stop):
        visits[first:stop] += 1

    over_frames(visit, frames)
    np.testing.assert_array_equal(visits, 1)


def test_an_error_in_a_thread_is_not_lost():
    def fail(first, stop):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        over_frames(fail, 3)


def test_errors_are_as_large_as_foretold():
    """Poses drawn from the prior, their markers with noise and some of them hidden: the solve's errors have its own spread."""
    rng, frames, joints = np.random.default_rng(6), 500, 7
    problem = dense.frame(rng, joints, noise=0.0)
    joint_sd, root_sd, noise = 0.05, 0.02, 0.004
    vectors, shifts = rng.normal(0, joint_sd, (frames, joints, 3)), rng.normal(0, root_sd, (frames, 3))
    vectors[:, ~problem.tree.free] = 0.0
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, joints, 3, 3) @ problem.local
    root = problem.root + shifts
    truth = placed(problem, root, local)
    seen = truth + rng.normal(0, noise, truth.shape)
    weight = np.full(seen.shape[:2], noise**-2)
    hidden = np.r_[0, 4, 5, np.arange(9, 15)]  # two joints' markers altogether
    weight[:, hidden] = 0.0
    information = np.tile(np.eye(3) / joint_sd**2, (1, joints, 1, 1))
    prior = Pull(problem.local[None], information, problem.root[None], np.array([root_sd**-2]))
    none = dense.no_pull(joints)
    root_found, found, status, _ = solved(problem, seen, weight, PLAIN, none, prior, problem.root, problem.local)
    assert (status == CONVERGED).all()
    marker_sd, foretold_joint_sd, joint_var, root_var = foretold(problem, seen, weight, none, prior, root_found, found)

    def points(root, local):
        return np.stack([dense.forward(problem.tree, *pose)[0] for pose in zip(root, local, strict=True)])

    def agree(errors, foretold_sd):
        np.testing.assert_allclose(np.sqrt((errors**2).mean((0, -1))), np.sqrt((foretold_sd**2).mean(0)), rtol=0.15)

    agree(placed(problem, root_found, found) - truth, marker_sd)
    agree(points(root_found, found) - points(root, local), foretold_joint_sd)
    agree(root_found - root, np.sqrt(root_var))
    below = np.flatnonzero(problem.tree.free)
    relative = (found @ np.swapaxes(local, 2, 3)).reshape(-1, 3, 3)
    agree(Rotation.from_matrix(relative).as_rotvec().reshape(frames, joints, 3)[:, below], np.sqrt(joint_var[:, below]))
    assert marker_sd[:, 9:15].mean() > 2 * marker_sd[:, 20].mean()
