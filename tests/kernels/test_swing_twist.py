"""The closed forms on numbers, compiled and on tensors: known answers, and where the papers' own formulas have none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from scipy.spatial.transform import Rotation

from mocapfix.kernels import hybrik
from tests.kernels import random_terms

torch = pytest.importorskip("torch")
seeds = st.integers(0, 2**32 - 1)
AXES = [(1.0, 0.0, 0.0), (0.0, -2.0, 0.0), (0.0, 0.0, 0.3), (1.0, 2.0, -3.0), (0.8, 0.6, 0.0)]


@njit
def compiled_swing(t, p):
    return hybrik.compute_swing(t, p)


@njit
def compiled_twist(t, cosine, sine):
    return hybrik.compute_twist(t, cosine, sine)


@njit
def compiled_between(a, b, c, upper, lower):
    return hybrik.solve_two_bone_joint(a, b, c, upper, lower)


def swung(t, p) -> np.ndarray:
    return np.reshape(hybrik.compute_swing(tuple(map(float, t)), tuple(map(float, p))), (3, 3))


@given(seeds)
def test_swing_is_the_shortest_rotation_between_directions(seed):
    rng = np.random.default_rng(seed)
    t, p = rng.normal(size=(2, 3)) * rng.uniform(0.01, 10, (2, 1))
    turn = swung(t, p)
    assert np.allclose(turn @ t / np.linalg.norm(t), p / np.linalg.norm(p), atol=1e-9)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    angle = np.arctan2(np.linalg.norm(np.cross(t, p)), t @ p)
    assert Rotation.from_matrix(turn).magnitude() == pytest.approx(angle, abs=1e-7)


@pytest.mark.parametrize("t", AXES)
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-5])
def test_nearly_opposite_directions_swing_by_a_half_turn(t, angle):
    away = -Rotation.from_rotvec(angle * np.array(hybrik.compute_perpendicular(hybrik.normalise_vector(t)))).apply(t)
    turn = swung(t, away)
    assert np.linalg.det(turn) == pytest.approx(1)
    assert np.allclose(turn @ t, away, atol=3e-6)
    assert np.trace(turn) == pytest.approx(-1, abs=1e-9)


@pytest.mark.parametrize("t", AXES)
def test_parallel_and_zero_vectors_give_no_swing(t):
    assert np.allclose(swung(t, np.multiply(3, t)), np.eye(3), atol=1e-12)
    assert np.allclose(swung(t, (0, 0, 0)), np.eye(3), atol=1e-12)


@given(seeds, st.floats(-3.1, 3.1), st.floats(1e-6, 1e6))
def test_twist_does_not_depend_on_the_evidences_length(seed, angle, length):
    t = np.random.default_rng(seed).normal(size=3)
    turn = np.reshape(hybrik.compute_twist(tuple(t), length * np.cos(angle), length * np.sin(angle)), (3, 3))
    assert np.allclose(turn, Rotation.from_rotvec(angle * t / np.linalg.norm(t)).as_matrix(), atol=1e-12)


@given(seeds)
def test_twist_evidence_gives_the_least_squares_angle(seed):
    rng = np.random.default_rng(seed)
    t, points, seen = rng.normal(size=3), rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    evidence = np.sum(
        [hybrik.compute_twist_evidence(tuple(t), tuple(m), tuple(s)) for m, s in zip(points, seen, strict=True)], axis=0
    )

    def off(angle):
        return np.sum((Rotation.from_rotvec(angle * t / np.linalg.norm(t)).apply(points) - seen) ** 2)

    best = np.arctan2(evidence[1], evidence[0])
    assert all(off(best) <= off(best + change) + 1e-9 for change in np.linspace(-np.pi, np.pi, 37))


@given(seeds)
def test_two_bone_joint_keeps_both_lengths_and_is_nearest(seed):
    rng = np.random.default_rng(seed)
    a, c, b = rng.normal(size=(3, 3))
    upper, reach = rng.uniform(0.1, 2), np.linalg.norm(c - a)
    lower = rng.uniform(abs(upper - reach), upper + reach)
    place, missed = hybrik.solve_two_bone_joint(tuple(a), tuple(b), tuple(c), upper, lower)
    assert missed == pytest.approx(0, abs=1e-12)
    assert np.linalg.norm(place - a) == pytest.approx(upper)
    assert np.linalg.norm(place - c) == pytest.approx(lower)
    axis = (c - a) / reach
    around = [a + Rotation.from_rotvec(angle * axis).apply(place - a) for angle in np.linspace(0, 2 * np.pi, 25)]
    assert all(np.linalg.norm(place - b) <= np.linalg.norm(other - b) + 1e-9 for other in around)


@pytest.mark.parametrize(
    ("end", "upper", "lower", "place", "missed"),
    [
        ((0.9, 0, 0), 0.3, 0.3, (0.3, 0, 0), 0.3),  # out of reach
        ((0.05, 0, 0), 0.3, 0.2, (0.3, 0, 0), -0.05),  # too near: beyond it
        ((0.05, 0, 0), 0.2, 0.3, (-0.2, 0, 0), -0.05),  # too near: on the other side
        ((0, 0, 0), 0.3, 0.2, (0.0, 0.3, 0), -0.1),  # one on the other, lengths that do not allow it
    ],
)
def test_unreachable_two_bone_joint_is_in_line_with_its_reach_error(end, upper, lower, place, missed):
    found, by = hybrik.solve_two_bone_joint((0.0, 0.0, 0.0), (0.1, 0.2, 0.0), tuple(map(float, end)), upper, lower)
    assert by == pytest.approx(missed)
    assert np.linalg.norm(found) == pytest.approx(upper)
    if any(end):
        assert np.allclose(found, place, atol=1e-9)


@pytest.mark.parametrize("b", [(0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (9.0, 0.0, 0.0)])
def test_guess_in_line_with_both_ends_keeps_both_lengths(b):
    place, _ = hybrik.solve_two_bone_joint((0.0, 0.0, 0.0), b, (0.5, 0.0, 0.0), 0.3, 0.4)
    assert np.linalg.norm(place) == pytest.approx(0.3)
    assert np.linalg.norm(np.subtract(place, (0.5, 0, 0))) == pytest.approx(0.4)


def test_kernels_and_tensors_agree():
    rng = np.random.default_rng(0)
    a, b, c = random_terms.draw_units(rng, 3, 200)
    b[:3], c[3:6] = -a[:3], 0.0  # opposite, and nowhere
    upper, lower = rng.uniform(0.1, 1.5, (2, 200))
    x, y, z = (tuple(torch.tensor(each).T) for each in (a, b, c))
    together = [
        torch.stack(hybrik.compute_swing(x, y)).T,
        torch.stack(hybrik.compute_swing(x, z)).T,
        torch.stack(hybrik.compute_twist(x, torch.tensor(upper), torch.tensor(lower))).T,
        torch.stack(hybrik.solve_two_bone_joint(x, y, z, torch.tensor(upper), torch.tensor(lower))[0]).T,
    ]
    for i in range(200):
        k, m, n = (tuple(each[i]) for each in (a, b, c))
        turns = compiled_swing(k, m), compiled_swing(k, n), compiled_twist(k, upper[i], lower[i])
        one = [*turns, compiled_between(k, m, n, upper[i], lower[i])[0]]
        for tensor, number in zip(together, one, strict=True):
            assert np.allclose(tensor[i].numpy(), number, rtol=0, atol=1e-10)


def test_gradients_are_correct_and_finite_at_singularities():
    rng = np.random.default_rng(1)
    t, p, c = (torch.tensor(each.T.copy(), requires_grad=True) for each in rng.normal(size=(3, 5, 3)))
    assert torch.autograd.gradcheck(lambda t, p: torch.stack(hybrik.compute_swing(tuple(t), tuple(p))), (t, p))
    assert torch.autograd.gradcheck(
        lambda t, p, c: torch.stack(hybrik.solve_two_bone_joint(tuple(t), tuple(p), tuple(c), 1.5, 1.2)[0]), (t, p, c)
    )
    for a, b in [((1.0, 0, 0), (-1.0, 0, 0)), ((1.0, 0, 0), (0.0, 0, 0)), ((1.0, 0, 0), (2.0, 0, 0))]:
        corner = torch.tensor([[*a], [*b]], dtype=torch.float64, requires_grad=True)
        torch.stack(hybrik.compute_swing(tuple(corner[0]), tuple(corner[1]))).sum().backward()
        assert corner.grad is not None
        assert torch.isfinite(corner.grad).all()
