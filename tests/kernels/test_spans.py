"""What a network is told of a body: which way bones point, and what a swing of the bone before leaves of that."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.initialise.twist_regressor import build_twist_spans, compute_span_directions
from mocapfix.kernels.swing_twist import compute_swing, compute_twist
from mocapfix.skeleton import load_cmu31_skeleton
from tests.kernels import drawn

seeds = st.integers(0, 2**32 - 1)
THIGH, SHIN = (load_cmu31_skeleton().find_joint(name) for name in ("LeftLeg", "LeftFoot"))
EYE = np.eye(3)[None]


def told(positions, turns=EYE):
    """-> directions (P, 3), and what the swing before leaves of them (P, 3), of one frame"""
    return compute_span_directions(positions, turns).reshape(2, -1, 3)


def row(joint):
    return list(build_twist_spans().end).index(joint)


@given(seeds)
def test_directions_are_those_of_the_joints_at_length_one_in_the_roots_axes(seed):
    rng = np.random.default_rng(seed)
    positions, turn = rng.normal(size=(1, 31, 3)), drawn.rotations(rng, 1)
    away = (positions[0, build_twist_spans().end] - positions[0, build_twist_spans().start]) @ turn[0]
    np.testing.assert_allclose(told(positions, turn)[0], away / np.linalg.norm(away, axis=1, keepdims=True), atol=1e-6)


@given(seeds, st.floats(-3, 3))
def test_after_a_swing_and_a_twist_the_twist_is_left_of_the_next_bone(seed, angle):
    rng = np.random.default_rng(seed)
    positions, rest = rng.normal(size=(1, 31, 3)), build_twist_spans().rest_vector
    bone, to = tuple(rest[row(THIGH)]), tuple(rest[row(THIGH)] + rng.normal(0, 0.2, 3))
    own = np.reshape(compute_twist(bone, np.cos(angle), np.sin(angle)), (3, 3))
    turn = np.reshape(compute_swing(bone, to), (3, 3)) @ own
    positions[0, THIGH] = positions[0, build_twist_spans().start[row(THIGH)]] + turn @ rest[row(THIGH)]
    positions[0, SHIN] = positions[0, THIGH] + turn @ rest[row(SHIN)]
    left = np.linalg.norm(rest[row(SHIN)]) * told(positions)[1, row(SHIN)]
    np.testing.assert_allclose(left, own @ rest[row(SHIN)], atol=1e-6)


def test_at_rest_every_bone_points_as_it_rests_and_the_first_ones_have_none_before():
    body = load_cmu31_skeleton()
    places = np.zeros((1, 31, 3))
    for j in range(1, 31):
        places[0, j] = places[0, body.parents[j]] + body.offsets[j]
    straight = build_twist_spans().rest_vector / np.linalg.norm(build_twist_spans().rest_vector, axis=1, keepdims=True)
    has = build_twist_spans().previous >= 0
    assert set(build_twist_spans().start[~has]) == {body.find_joint(name) for name in ("LHipJoint", "RHipJoint", "LowerBack")}
    np.testing.assert_allclose(told(places)[0], straight, atol=1e-6)
    np.testing.assert_allclose(told(places)[1], np.where(has[:, None], straight, 0), atol=1e-6)


def test_what_is_not_known_or_has_no_length_is_nothing():
    positions = np.random.default_rng(0).normal(size=(1, 31, 3))
    whole = told(positions)
    positions[0, SHIN] = np.nan
    lost = np.isin(build_twist_spans().start, SHIN) | np.isin(build_twist_spans().end, SHIN)
    after = lost | np.isin(build_twist_spans().previous, np.flatnonzero(lost))
    np.testing.assert_array_equal(told(positions)[0], np.where(lost[:, None], 0, whole[0]))
    np.testing.assert_array_equal(told(positions)[1], np.where(after[:, None], 0, whole[1]))
    positions[0, SHIN] = positions[0, THIGH]
    assert not told(positions)[:, row(SHIN)].any()
    assert not told(positions, np.full((1, 3, 3), np.nan)).any()


def test_a_bone_that_points_right_back_is_swung_by_half_a_turn():
    positions = np.random.default_rng(1).normal(size=(1, 31, 3))
    positions[0, THIGH] = positions[0, build_twist_spans().start[row(THIGH)]] - build_twist_spans().rest_vector[row(THIGH)]
    positions[0, SHIN] = 2 * positions[0, THIGH] - positions[0, build_twist_spans().start[row(THIGH)]]
    straight = build_twist_spans().rest_vector[row(THIGH)] / np.linalg.norm(build_twist_spans().rest_vector[row(THIGH)])
    np.testing.assert_allclose(told(positions)[1, row(SHIN)], straight, atol=1e-6)


def test_the_world_does_not_matter_where_the_root_goes_with_it():
    rng = np.random.default_rng(2)
    positions, turn = rng.normal(size=(5, 31, 3)), Rotation.from_rotvec([0.3, 2.0, -0.4]).as_matrix()
    moved = positions @ turn.T + [3.0, -1.0, 8.0]
    expected = compute_span_directions(positions, np.tile(EYE, (5, 1, 1)))
    np.testing.assert_allclose(compute_span_directions(moved, np.tile(turn, (5, 1, 1))), expected, atol=1e-5)
