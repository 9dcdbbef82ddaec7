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

from mocapfix.kernels.process import matern

SMOOTH, NOISE = 0.3, 1e-4  # seconds over which a course goes on as it does; variance of a sample, of the course's power
ANYWHERE = 100.0  # variance of a course's middle, likewise


class Undoing(NamedTuple):
    """One way of undoing: T samples of C numbers are fixed (T, C) + basis (T, C, P) times P unknowns, `free` of them telling."""

    fixed: np.ndarray
    basis: np.ndarray
    free: int


def of_turns(quaternions: np.ndarray, order: str) -> tuple[Undoing, ...]:
    """-> the ways of (T, 4) quaternions (x, y, z, w) that do not change sign, each times two: in the parent's axes, in the
    joint's own and in the middle angle of an `order` of intrinsic rotations such as "ZYX" (where it has three).
    """
    q, none, units = 2 * quaternions, np.zeros_like(quaternions), np.eye(4)
    parents, own = product(units[None], q[:, None]), product(q[:, None], units[None])
    ways = [Undoing(none, np.swapaxes(each, 1, 2), 3) for each in (parents, own)]
    if len(order) == 3:
        turns = Rotation.from_quat(quaternions)
        outer = Rotation.from_euler(order[0], turns.as_euler(order)[:, :1])
        inner = (outer.inv() * turns).as_quat()
        across = product(product(outer.as_quat(), units[None, "XYZ".index(order[1])]), inner)
        across *= np.sign((product(outer.as_quat(), inner) * q).sum(1))[:, None]
        ways.append(Undoing(none, np.stack([q, 2 * across], axis=2), 1))
    return tuple(ways)


def of_places(places: np.ndarray) -> tuple[Undoing, ...]:
    """-> the only way of places (T, 3)."""
    return (Undoing(places, np.broadcast_to(np.eye(3), (len(places), 3, 3)), 3),)


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """-> the product (..., 4) of quaternions (..., 4), the turn q followed by the turn p."""
    a, b = p[..., :3], q[..., :3]
    vector = p[..., 3:] * b + q[..., 3:] * a + np.cross(a, b)
    return np.concatenate([vector, p[..., 3:] * q[..., 3:] - (a * b).sum(-1, keepdims=True)], axis=-1)


def smoothest(
    known: np.ndarray, known_at: np.ndarray, ways: tuple[Undoing, ...], inside_at: np.ndarray, near: np.ndarray
) -> tuple[np.ndarray, float]:
    """-> the samples inside a span (n, C) that go on the smoothest from those known, by the likeliest of the ways, and the
    variance of what was undone, per axis.

    known (N, C) beside the span, at seconds known_at (N,); inside_at (n,) seconds; near: indices of the samples inside that are
    asked, for those far from both edges tell nothing

    A course is a Gaussian process (Matern-5/2) about an unknown middle; the likeliest way is told by its least squares and, as
    ways may have different numbers of unknowns, by Schwarz's criterion.
    """
    at = np.r_[known_at, inside_at[near]]
    among = ANYWHERE + matern(at[:, None] - at, SMOOTH) + NOISE * np.eye(len(at))
    factor = np.linalg.cholesky(among)
    best, answer = np.inf, (np.zeros((len(inside_at), known.shape[1])), np.inf)
    for way in ways:
        said = np.concatenate([known, way.fixed[near]])
        slopes = np.concatenate([np.zeros((len(known), *way.basis.shape[1:])), way.basis[near]])
        white = solve_triangular(factor, said, lower=True).ravel()
        tilted = solve_triangular(factor, slopes.reshape(len(at), -1), lower=True).reshape(len(white), -1)
        amounts = np.linalg.lstsq(tilted, -white, rcond=None)[0]
        left = float(((tilted @ amounts + white) ** 2).sum()) + 1e-12
        criterion = 3 * len(at) * np.log(left) + way.free * np.log(3 * len(at))
        if criterion < best:
            unsure = left / (3 * len(at)) * np.trace(np.linalg.pinv(tilted.T @ tilted)) / 3
            best, answer = criterion, (way.fixed + way.basis @ amounts, 4 * unsure if way.free < known.shape[1] else unsure)
    return answer
