"""Inputs and layers of the twist network."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels.hybrik import compute_swing, compute_twist, evaluate_layer_frames
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.solve.hybrik import build_twist_spans, compute_span_directions
from tests.kernels import random_terms

seeds = st.integers(0, 2**32 - 1)
THIGH, SHIN = (load_cmu31_skeleton().find_joint(name) for name in ("LeftLeg", "LeftFoot"))
EYE = np.eye(3)[None]


def compute(positions, turns=EYE):
    """Return directions (P, 3), and what the swing before leaves of them (P, 3), of one frame"""
    return compute_span_directions(positions, turns).reshape(2, -1, 3)


def row(joint):
    return list(build_twist_spans().end).index(joint)


@given(seeds)
def test_directions_are_unit_vectors_in_the_roots_axes(seed):
    rng = np.random.default_rng(seed)
    positions, turn = rng.normal(size=(1, 31, 3)), random_terms.draw_rotations(rng, 1)
    away = (positions[0, build_twist_spans().end] - positions[0, build_twist_spans().start]) @ turn[0]
    np.testing.assert_allclose(compute(positions, turn)[0], away / np.linalg.norm(away, axis=1, keepdims=True), atol=1e-6)


@given(seeds, st.floats(-3, 3))
def test_swing_of_the_previous_bone_is_removed(seed, angle):
    rng = np.random.default_rng(seed)
    positions, rest = rng.normal(size=(1, 31, 3)), build_twist_spans().rest_vector
    bone, to = tuple(rest[row(THIGH)]), tuple(rest[row(THIGH)] + rng.normal(0, 0.2, 3))
    own = np.reshape(compute_twist(bone, np.cos(angle), np.sin(angle)), (3, 3))
    turn = np.reshape(compute_swing(bone, to), (3, 3)) @ own
    positions[0, THIGH] = positions[0, build_twist_spans().start[row(THIGH)]] + turn @ rest[row(THIGH)]
    positions[0, SHIN] = positions[0, THIGH] + turn @ rest[row(SHIN)]
    left = np.linalg.norm(rest[row(SHIN)]) * compute(positions)[1, row(SHIN)]
    np.testing.assert_allclose(left, own @ rest[row(SHIN)], atol=1e-6)


def test_directions_of_the_rest_pose():
    body = load_cmu31_skeleton()
    places = np.zeros((1, 31, 3))
    for j in range(1, 31):
        places[0, j] = places[0, body.parents[j]] + body.offsets[j]
    straight = build_twist_spans().rest_vector / np.linalg.norm(build_twist_spans().rest_vector, axis=1, keepdims=True)
    has = build_twist_spans().previous >= 0
    assert set(build_twist_spans().start[~has]) == {body.find_joint(name) for name in ("LHipJoint", "RHipJoint", "LowerBack")}
    np.testing.assert_allclose(compute(places)[0], straight, atol=1e-6)
    np.testing.assert_allclose(compute(places)[1], np.where(has[:, None], straight, 0), atol=1e-6)


def test_unknown_and_zero_length_bones_are_zero():
    positions = np.random.default_rng(0).normal(size=(1, 31, 3))
    whole = compute(positions)
    positions[0, SHIN] = np.nan
    lost = np.isin(build_twist_spans().start, SHIN) | np.isin(build_twist_spans().end, SHIN)
    after = lost | np.isin(build_twist_spans().previous, np.flatnonzero(lost))
    np.testing.assert_array_equal(compute(positions)[0], np.where(lost[:, None], 0, whole[0]))
    np.testing.assert_array_equal(compute(positions)[1], np.where(after[:, None], 0, whole[1]))
    positions[0, SHIN] = positions[0, THIGH]
    assert not compute(positions)[:, row(SHIN)].any()
    assert not compute(positions, np.full((1, 3, 3), np.nan)).any()


def test_opposite_bone_is_swung_by_a_half_turn():
    positions = np.random.default_rng(1).normal(size=(1, 31, 3))
    positions[0, THIGH] = positions[0, build_twist_spans().start[row(THIGH)]] - build_twist_spans().rest_vector[row(THIGH)]
    positions[0, SHIN] = 2 * positions[0, THIGH] - positions[0, build_twist_spans().start[row(THIGH)]]
    straight = build_twist_spans().rest_vector[row(THIGH)] / np.linalg.norm(build_twist_spans().rest_vector[row(THIGH)])
    np.testing.assert_allclose(compute(positions)[1, row(SHIN)], straight, atol=1e-6)


def test_directions_do_not_depend_on_the_roots_pose():
    rng = np.random.default_rng(2)
    positions, turn = rng.normal(size=(5, 31, 3)), Rotation.from_rotvec([0.3, 2.0, -0.4]).as_matrix()
    moved = positions @ turn.T + [3.0, -1.0, 8.0]
    expected = compute_span_directions(positions, np.tile(EYE, (5, 1, 1)))
    np.testing.assert_allclose(compute_span_directions(moved, np.tile(turn, (5, 1, 1))), expected, atol=1e-5)


@pytest.mark.parametrize("sizes", [(5, 7, 4, 6), (3, 2, 9, 2)])
def test_layers_are_matrix_products_with_rectified_units(sizes):
    rng = np.random.default_rng(0)
    weights = tuple(rng.normal(size=shape).astype(np.float32) for shape in pairwise(sizes))
    offsets = tuple(rng.normal(size=size).astype(np.float32) for size in sizes[1:])
    inputs = rng.normal(size=(20, sizes[0])).astype(np.float32)
    outputs = np.full((20, sizes[-1]), 9, np.float32)
    evaluate_layer_frames(weights, offsets, inputs, outputs, 3, 18)
    a, b, c = weights
    expected = np.maximum(np.maximum(inputs @ a + offsets[0], 0) @ b + offsets[1], 0) @ c + offsets[2]
    np.testing.assert_allclose(outputs[3:18], expected[3:18], atol=1e-5)
    assert (expected < 0).any()
    assert (outputs[[0, 1, 2, 18, 19]] == 9).all()
