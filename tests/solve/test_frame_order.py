"""The order in which frames are solved, and the poses from which they start."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.model.motion import FrameStatus
from mocapfix.solve import parallel
from mocapfix.stats.sequences import find_runs
from tests.kernels import random_terms
from tests.kernels.solver_runs import solve_in_order

PLAIN = np.array([np.inf])


def list_chains(order):
    """Return the chains of an order, each a list of (frame, start frame)."""
    turns = list(zip(order.frames.tolist(), order.start_frame.tolist(), strict=True))
    return [turns[a:b] for a, b in zip(order.chain_starts[:-1], order.chain_starts[1:], strict=True)]


def build_uncertain_joints(frames, lost):
    """Return (T, 3) bool: the root and the last joint of three are uncertain in the gaps `lost` (first, last)."""
    found = np.zeros((frames, 3), bool)
    for first, last in lost:
        found[first : last + 1, [0, 2]] = True
    return found


def order_windows(frames, window, joints):
    """Return the order in which the first frame of each window has a pose, from which the others continue."""
    every = np.arange(frames)
    start_frame = np.where(every % window == 0, -1, every - 1)
    return parallel.SolveOrder(every, start_frame, np.ones((1, joints), bool), np.r_[every[::window], frames])


def test_independent_frames_start_from_their_own_poses():
    order = parallel.order_independently(np.arange(3), 4)
    assert list_chains(order) == [[(0, -1)], [(1, -1)], [(2, -1)]]
    assert not order.copied_joints.any()


@pytest.mark.parametrize(
    ("run", "chains"),
    [
        ((2, 5), [[(2, 1), (3, 2)], [(5, 6), (4, 5)]]),  # from both sides
        ((2, 4), [[(2, 1), (3, 2)], [(4, 5)]]),
        ((3, 3), [[(3, 2)]]),
        ((0, 2), [[(2, 3), (1, 2), (0, 1)]]),  # from behind alone
        ((0, 0), [[(0, 1)]]),
        ((5, 7), [[(5, 4), (6, 5), (7, 6)]]),  # from before alone
        ((0, 7), [[(t, t - 1) for t in range(1, 8)]]),  # all frames: from the first
    ],
)
def test_gap_is_solved_from_its_neighbours(run, chains):
    assert list_chains(parallel.order_from_gap_ends([run], build_uncertain_joints(8, [run]))) == chains


def test_only_uncertain_joints_are_copied_and_never_the_root():
    given_ = build_uncertain_joints(8, [(2, 3)])
    before = given_.copy()
    np.testing.assert_array_equal(parallel.order_from_gap_ends([(2, 3)], given_).copied_joints, before & [False, True, True])
    np.testing.assert_array_equal(given_, before)


def test_no_gap_gives_an_empty_order():
    order = parallel.order_from_gap_ends([], build_uncertain_joints(4, []))
    assert list_chains(order) == []
    assert order.frames.dtype == order.start_frame.dtype == order.chain_starts.dtype == np.int64


@given(st.integers(1, 30).flatmap(lambda n: st.lists(st.booleans(), min_size=n, max_size=n)))
def test_gap_frames_start_from_certain_or_solved_frames(lost):
    """Every uncertain frame is solved once, except the first frame of a take without certain frames; no chain needs another."""
    inside = find_runs(np.array(lost))
    chains = list_chains(parallel.order_from_gap_ends(inside, build_uncertain_joints(len(lost), inside)))
    certain = {0} if all(lost) else {t for t, missing in enumerate(lost) if not missing}
    assert sorted(t for chain in chains for t, _ in chain) == [t for t in range(len(lost)) if t not in certain]
    for chain in chains:
        solved = set(certain)
        for t, source in chain:
            assert abs(t - source) == 1
            assert source in solved
            solved.add(t)


# solved


def still(frames, joints):
    """Return a body, terms that say nothing, and a different pose in every frame: root (T, 3), local (T, J, 3, 3)"""
    rng = np.random.default_rng(frames)
    local = np.stack([random_terms.draw_rotations(rng, joints) for _ in range(frames)])
    return random_terms.draw_tree(rng, joints), random_terms.build_terms(joints, frames), rng.normal(size=(frames, 3)), local


def test_copied_joints_come_from_the_start_frame():
    tree, terms, root, local = still(8, 4)
    place, start, lost = root.copy(), local.copy(), np.zeros((8, 4), bool)
    lost[2:6, [0, 2]] = True
    order = parallel.order_from_gap_ends([(2, 5)], lost)
    status, iterations = solve_in_order(order, tree, terms, PLAIN, root, local, np.zeros((8, 0)))
    assert status.tolist() == [
        -1,
        -1,
        FrameStatus.UNCONSTRAINED,
        FrameStatus.UNCONSTRAINED,
        FrameStatus.UNCONSTRAINED,
        FrameStatus.UNCONSTRAINED,
        -1,
        -1,
    ]
    assert iterations[2:6].tolist() == [0] * 4
    np.testing.assert_array_equal(local[:, 2], start[[0, 1, 1, 1, 6, 6, 6, 7], 2])
    np.testing.assert_array_equal(local[:, [0, 1, 3]], start[:, [0, 1, 3]])
    np.testing.assert_array_equal(root, place)


def test_windows_copy_whole_poses():
    tree, terms, root, local = still(7, 4)
    shared = np.arange(7.0)[:, None]
    start = root.copy(), local.copy(), shared.copy()
    status, _ = solve_in_order(order_windows(7, 3, 4), tree, terms, PLAIN, root, local, shared)
    assert (status == FrameStatus.UNCONSTRAINED).all()
    for found, given_ in zip((root, local, shared), start, strict=True):
        np.testing.assert_array_equal(found, given_[[0, 0, 0, 3, 3, 3, 6]])


def test_rotations_stay_orthonormal_over_thousands_of_steps():
    """Each frame starts from the last one's pose; rounding must not gather from joint to joint."""
    rng, joints, frames = np.random.default_rng(8), 10, 400
    tree = random_terms.KinematicTree(np.arange(-1, joints - 1), rng.normal(0, 0.3, (joints, 3)), np.ones(joints, bool))
    rest = random_terms.draw_rotations(rng, joints)
    wanted = np.stack([random_terms.draw_rotations(rng, joints, 0.5) @ rest for _ in range(frames)])
    tracking = random_terms.TrackingTerm(wanted, np.full((frames, joints), 1e4), np.zeros((frames, 3)), np.full(frames, 1e4))
    root, local = np.zeros((frames, 3)), np.tile(rest, (frames, 1, 1, 1))
    terms, order = (
        random_terms.build_terms(joints, frames, tracking=tracking),
        order_windows(frames, frames, joints),
    )
    status, iterations = solve_in_order(order, tree, terms, PLAIN, root, local, np.zeros((frames, 0)))
    assert (status == FrameStatus.CONVERGED).all()
    assert (iterations > 1).all()
    np.testing.assert_allclose(local, wanted, atol=1e-3)
    np.testing.assert_allclose(local[-1] @ np.swapaxes(local[-1], 1, 2), np.tile(np.eye(3), (joints, 1, 1)), atol=1e-12)
