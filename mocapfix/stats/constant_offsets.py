"""Removal of an offset that is constant over a span of frames, so that the signal continues as smoothly as possible.

A rotation can have a constant offset in the parent's axes (d R), in the joint's own (R d) or in the middle one of its three
angles. In each case the corrected quaternion is linear in the correction: q = B(q') c, with c the conjugate of d where B has
four columns, and (cos, sin) of half the angle where it has two. A position has an offset vector: p = p' + c. So the correction
that makes the signal smoothest is a linear least squares problem.
"""

from typing import NamedTuple
from warnings import catch_warnings

import numpy as np
import scipy
from jaxtyping import Float, Int

from mocapfix.stats.gaussian_process import compute_matern_52

OFFSET_TIME_SCALE_S = 0.3  # of the signal's correlation
OFFSET_NOISE_VARIANCE_RATIO = 1e-4  # variance of a sample's noise, relative to the signal's power
OFFSET_MEAN_VARIANCE_RATIO = 100.0  # variance of the signal's unknown mean, likewise
MIN_RESIDUAL_SQUARE = 1e-12  # added to a sum of squares, so that its logarithm is finite


class OffsetModel(NamedTuple):
    """A linear model of a correction: T samples of C numbers are fixed + basis times P unknowns."""

    fixed: Float[np.ndarray, "T C"]
    basis: Float[np.ndarray, "T C P"]
    dof: int  # degrees of freedom of the unknowns


def build_rotation_offset_models(quaternions: Float[np.ndarray, "T 4"], order: str) -> tuple[OffsetModel, ...]:
    """Return the models of quaternions (x, y, z, w) without sign changes, each times two.

    They are an offset in the parent's axes, in the joint's own and, if the joint has three axes, in the middle angle of an
    `order` of intrinsic rotations such as "ZYX".
    """
    q, zeros, units = 2 * quaternions, np.zeros_like(quaternions), np.eye(4)
    products = multiply_quaternions(units[:, None], units)
    in_parent, in_joint = (np.swapaxes(np.tensordot(q, products, (1, axis)), 1, 2) for axis in (1, 0))
    models = [OffsetModel(zeros, basis, 3) for basis in (in_parent, in_joint)]
    if len(order) == 3:
        rotations = scipy.spatial.transform.Rotation.from_quat(quaternions)
        with catch_warnings(action="ignore"):  # in gimbal lock, where any outer angle is right
            outer = scipy.spatial.transform.Rotation.from_euler(order[0], rotations.as_euler(order)[:, :1])
        axis = outer.apply(np.eye(3)["XYZ".index(order[1])])
        derivative = multiply_quaternions(np.pad(axis, ((0, 0), (0, 1))), q)
        models.append(OffsetModel(zeros, np.stack([q, derivative], axis=2), 1))
    return tuple(models)


def build_position_offset_models(positions: Float[np.ndarray, "T 3"]) -> tuple[OffsetModel, ...]:
    """Return the only model of positions: an offset vector."""
    return (OffsetModel(positions, np.broadcast_to(np.eye(3), (len(positions), 3, 3)), 3),)


def multiply_quaternions(p: Float[np.ndarray, "*#batch 4"], q: Float[np.ndarray, "*#batch 4"]) -> np.ndarray:
    """Return the products (..., 4) of quaternions (x, y, z, w), the rotation q followed by the rotation p."""
    (ax, ay, az, aw), (bx, by, bz, bw) = np.moveaxis(p, -1, 0), np.moveaxis(q, -1, 0)
    x, y, z = aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw
    return np.stack([x, y, z, aw * bw - ax * bx - ay * by - az * bz], axis=-1)


def fit_smoothest_offset(
    known: Float[np.ndarray, "N C"],
    known_times_s: Float[np.ndarray, " N"],
    models: tuple[OffsetModel, ...],
    span_times_s: Float[np.ndarray, " n"],
    used_samples: Int[np.ndarray, " U"],
) -> tuple[Float[np.ndarray, "n C"], float]:
    """Return the corrected samples inside a span that continue the known samples most smoothly, and the correction's variance per
    axis.

    The signal is a Gaussian process (Matern-5/2) about an unknown mean. Models are compared by their least squares and, as they
    differ in the number of unknowns, by Schwarz's criterion.

    Args:
        known: Samples beside the span, at `known_times_s`.
        models: Of the span's samples, at `span_times_s`; the most likely one is used.
        used_samples: Indices of the span's samples that are fitted: samples far from both edges contain no information.
    """
    times_s = np.r_[known_times_s, span_times_s[used_samples]]
    covariance = OFFSET_MEAN_VARIANCE_RATIO + compute_matern_52(times_s[:, None] - times_s, OFFSET_TIME_SCALE_S)
    factor = np.linalg.cholesky(covariance + OFFSET_NOISE_VARIANCE_RATIO * np.eye(len(times_s)))
    best_criterion, best = np.inf, (np.zeros((len(span_times_s), known.shape[1])), np.inf)
    for model in models:
        values = np.concatenate([known, model.fixed[used_samples]])
        slopes = np.concatenate([np.zeros((len(known), *model.basis.shape[1:])), model.basis[used_samples]])
        white_values = scipy.linalg.solve_triangular(factor, values, lower=True).ravel()
        white_slopes = scipy.linalg.solve_triangular(factor, slopes.reshape(len(times_s), -1), lower=True)
        white_slopes = white_slopes.reshape(len(white_values), -1)
        unknowns = np.linalg.lstsq(white_slopes, -white_values, rcond=None)[0]
        square = float(((white_slopes @ unknowns + white_values) ** 2).sum()) + MIN_RESIDUAL_SQUARE
        criterion = 3 * len(times_s) * np.log(square) + model.dof * np.log(3 * len(times_s))
        if criterion < best_criterion:
            variance = square / (3 * len(times_s)) * np.trace(np.linalg.pinv(white_slopes.T @ white_slopes)) / 3
            is_rotation = model.dof < known.shape[1]  # a variance of quaternions, a quarter of the rotation vectors'
            best_criterion, best = criterion, (model.fixed + model.basis @ unknowns, 4 * variance if is_rotation else variance)
    return best
