from itertools import pairwise, product

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.keypoints import headings
from mocapfix.skeleton import load_cmu31_body


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_the_likeliest_course_is_the_best_of_all(seed, frames):
    rng = np.random.default_rng(seed)
    cost, step = rng.uniform(size=(frames, 3)), rng.uniform(size=(frames - 1, 3, 3))

    def total(path):
        return sum(cost[t, h] for t, h in enumerate(path)) + sum(step[t, a, b] for t, (a, b) in enumerate(pairwise(path)))

    best = min(product(range(3), repeat=frames), key=total)
    assert np.isclose(total(headings.find_cheapest_path(cost, step)), total(best))


def test_a_step_costs_what_joints_move_beside_the_root_the_less_the_slower():
    joints = np.zeros((2, 2, 4, 3))
    joints[1, :] += 5.0  # all together: the root's own way is free
    joints[1, 1, 3, 0] += 0.2
    step = headings.compute_transition_costs(joints, 30.0)
    assert step.shape == (1, 2, 2)
    np.testing.assert_array_equal(step[0, :, 0], 0)
    assert step[0, 0, 1] == step[0, 1, 1] > 0
    np.testing.assert_allclose(headings.compute_transition_costs(joints, 60.0), 4 * step)


def test_guesses_face_all_ways_and_differ_in_nothing_else():
    middle = np.tile(np.eye(3), (31, 1, 1))
    turned = headings.rotate_to_headings(middle)
    np.testing.assert_array_equal(turned[:, 1:], np.tile(middle[1:], (headings.HEADING_COUNT, 1, 1, 1)))
    ahead = turned[:, 0, :, 2]
    np.testing.assert_allclose(ahead[:, 1], 0, atol=1e-12)
    np.testing.assert_allclose(ahead.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(ahead[0], [0, 0, 1], atol=1e-12)
    assert len(turned[0]) == len(load_cmu31_body().skeleton.names)
