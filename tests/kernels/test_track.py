"""Frames solved one after the other: where each begins is seen best where nothing, or nothing but a pull, moves it on."""

import numpy as np
import pytest

from mocapfix.kernels.levenberg import CONVERGED, TAU, UNHELD
from mocapfix.kernels.track import bridge_runs, follow_windows
from tests.kernels import drawn

PLAIN = np.array([np.inf])


def trio(joints, frames, **said):
    """-> terms as the product's own solve has them, so that nothing more is compiled: points, a pull and another, no rows"""
    every = drawn.nothing(joints, frames) | said
    return every["points"], every["targets"], drawn.nothing(joints)["targets"]


def followed(tree, terms, root, local, windows):
    """-> status (T,), iterations (T,)"""
    frames = len(root)
    status, iterations = np.full(frames, -1), np.full(frames, -1)
    follow_windows(
        tree, terms, PLAIN, TAU, 50, 0, root, local, np.zeros((frames, 0)), status, iterations,
        np.array(windows), 0, len(windows),
    )  # fmt: skip
    return status, iterations


def still(frames, joints):
    """-> a body, terms that say nothing, and a different pose in every frame"""
    rng = np.random.default_rng(frames)
    local = np.stack([drawn.rotations(rng, joints) for _ in range(frames)])
    return drawn.tree(rng, joints), trio(joints, frames), rng.normal(size=(frames, 3)), local


def test_every_window_goes_on_from_its_own_first_frame():
    tree, terms, root, local = still(7, 4)
    start = root.copy(), local.copy()
    status, _ = followed(tree, terms, root, local, [(0, 2), (4, 6)])
    assert status.tolist() == [UNHELD] * 3 + [-1] + [UNHELD] * 3
    for found, given in zip((root, local), start, strict=True):
        np.testing.assert_array_equal(found, given[[0, 0, 0, 3, 4, 4, 4]])


def test_rotations_stay_rotations_over_thousands_of_steps_down_a_deep_tree():
    """Each frame starts from the last one's pose; rounding must not gather from joint to joint."""
    rng, joints, frames = np.random.default_rng(8), 10, 400
    tree = drawn.Tree(np.arange(-1, joints - 1), rng.normal(0, 0.3, (joints, 3)), np.ones(joints, bool))
    rest = drawn.rotations(rng, joints)
    wanted = np.stack([drawn.rotations(rng, joints, 0.5) @ rest for _ in range(frames)])
    information = np.tile(1e4 * np.eye(3), (frames, joints, 1, 1))
    pull = drawn.Targets(wanted, information, np.zeros((frames, 3)), np.full(frames, 1e4))
    root, local = np.zeros((frames, 3)), np.tile(rest, (frames, 1, 1, 1))
    status, iterations = followed(tree, trio(joints, frames, targets=pull), root, local, [(0, frames - 1)])
    assert (status == CONVERGED).all()
    assert (iterations > 1).all()
    np.testing.assert_allclose(local, wanted, atol=1e-3)
    np.testing.assert_allclose(local[-1] @ np.swapaxes(local[-1], 1, 2), np.tile(np.eye(3), (joints, 1, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("run", "sources"),
    [
        ((2, 5), [0, 1, 1, 1, 6, 6, 6, 7]),  # from both sides, turn and turn about
        ((2, 4), [0, 1, 1, 1, 5, 5, 6, 7]),
        ((0, 2), [3, 3, 3, 3, 4, 5, 6, 7]),  # from behind alone
        ((5, 7), [0, 1, 2, 3, 4, 4, 4, 4]),  # from before alone
        ((0, 7), [0, 0, 0, 0, 0, 0, 0, 0]),  # no frame is sure: on from the first
    ],
)
def test_a_run_is_bridged_from_its_sure_neighbours(run, sources):
    tree, terms, root, local = still(8, 4)
    start, unsure = local.copy(), np.zeros((8, 4), bool)
    unsure[run[0] : run[1] + 1, [0, 2]] = True
    place = root.copy()
    bridge_runs(tree, terms, PLAIN, TAU, 12, 0, root, local, np.zeros((8, 0)), unsure, np.array([run]), 0, 1)
    np.testing.assert_array_equal(local[:, 2], start[sources, 2])
    np.testing.assert_array_equal(local[:, [0, 1, 3]], start[:, [0, 1, 3]])  # the root starts where it is, as sure joints do
    np.testing.assert_array_equal(root, place)
