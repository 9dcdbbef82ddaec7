"""What is off by the same amount over a span of frames: what it would be without.

A turn can be off by the same in the parent's axes (d R), in the joint's own (R d) or in the middle one of its three angles. In
each case the right quaternion is linear in what undoes that: q = B(q') c, with c the conjugate of d where B is of four columns,
and (cos, sin) of half the angle where it is of two. A place is off by a vector: p = p' + c. So the amount that lets a course go
on the smoothest is a linear least squares problem.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from mocapfix.stats.gaussian_process import compute_matern_52

OFFSET_TIME_SCALE_S, OFFSET_NOISE_VARIANCE_RATIO = (
    0.3,
    1e-4,
)  # seconds over which a course goes on as it does; variance of a sample, of the course's power
OFFSET_MEAN_VARIANCE_RATIO = 100.0  # variance of a course's middle, likewise


class OffsetModel(NamedTuple):
    """One way of undoing: T samples of C numbers are fixed (T, C) + basis (T, C, P) times P unknowns, `free` of them telling."""

    fixed: np.ndarray
    basis: np.ndarray
    dof: int


def build_rotation_offset_models(quaternions: np.ndarray, order: str) -> tuple[OffsetModel, ...]:
    """-> the ways of (T, 4) quaternions (x, y, z, w) that do not change sign, each times two: in the parent's axes, in the
    joint's own and in the middle angle of an `order` of intrinsic rotations such as "ZYX" (where it has three).
    """
    q, none, units = 2 * quaternions, np.zeros_like(quaternions), np.eye(4)
    parents, own = multiply_quaternions(units[None], q[:, None]), multiply_quaternions(q[:, None], units[None])
    ways = [OffsetModel(none, np.swapaxes(each, 1, 2), 3) for each in (parents, own)]
    if len(order) == 3:
        turns = Rotation.from_quat(quaternions)
        outer = Rotation.from_euler(order[0], turns.as_euler(order)[:, :1])
        inner = (outer.inv() * turns).as_quat()
        across = multiply_quaternions(multiply_quaternions(outer.as_quat(), units[None, "XYZ".index(order[1])]), inner)
        across *= np.sign((multiply_quaternions(outer.as_quat(), inner) * q).sum(1))[:, None]
        ways.append(OffsetModel(none, np.stack([q, 2 * across], axis=2), 1))
    return tuple(ways)


def build_position_offset_models(positions: np.ndarray) -> tuple[OffsetModel, ...]:
    """-> the only way of places (T, 3)."""
    return (OffsetModel(positions, np.broadcast_to(np.eye(3), (len(positions), 3, 3)), 3),)


def multiply_quaternions(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """-> the product (..., 4) of quaternions (..., 4), the turn q followed by the turn p."""
    a, b = p[..., :3], q[..., :3]
    vector = p[..., 3:] * b + q[..., 3:] * a + np.cross(a, b)
    return np.concatenate([vector, p[..., 3:] * q[..., 3:] - (a * b).sum(-1, keepdims=True)], axis=-1)


def fit_smoothest_offset(
    known: np.ndarray,
    known_times_s: np.ndarray,
    models: tuple[OffsetModel, ...],
    span_times_s: np.ndarray,
    used_samples: np.ndarray,
) -> tuple[np.ndarray, float]:
    """-> the samples inside a span (n, C) that go on the smoothest from those known, by the likeliest of the ways, and the
    variance of what was undone, per axis.

    known (N, C) beside the span, at seconds known_at (N,); inside_at (n,) seconds; near: indices of the samples inside that are
    asked, for those far from both edges tell nothing

    A course is a Gaussian process (Matern-5/2) about an unknown middle; the likeliest way is told by its least squares and, as
    ways may have different numbers of unknowns, by Schwarz's criterion.
    """
    at = np.r_[known_times_s, span_times_s[used_samples]]
    among = (
        OFFSET_MEAN_VARIANCE_RATIO
        + compute_matern_52(at[:, None] - at, OFFSET_TIME_SCALE_S)
        + OFFSET_NOISE_VARIANCE_RATIO * np.eye(len(at))
    )
    factor = np.linalg.cholesky(among)
    best, answer = np.inf, (np.zeros((len(span_times_s), known.shape[1])), np.inf)
    for way in models:
        said = np.concatenate([known, way.fixed[used_samples]])
        slopes = np.concatenate([np.zeros((len(known), *way.basis.shape[1:])), way.basis[used_samples]])
        white = solve_triangular(factor, said, lower=True).ravel()
        tilted = solve_triangular(factor, slopes.reshape(len(at), -1), lower=True).reshape(len(white), -1)
        amounts = np.linalg.lstsq(tilted, -white, rcond=None)[0]
        left = float(((tilted @ amounts + white) ** 2).sum()) + 1e-12
        criterion = 3 * len(at) * np.log(left) + way.dof * np.log(3 * len(at))
        if criterion < best:
            unsure = left / (3 * len(at)) * np.trace(np.linalg.pinv(tilted.T @ tilted)) / 3
            best, answer = criterion, (way.fixed + way.basis @ amounts, 4 * unsure if way.dof < known.shape[1] else unsure)
    return answer
