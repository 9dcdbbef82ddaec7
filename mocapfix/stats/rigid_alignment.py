"""Rigid alignment of point clouds over a take: cross-covariances, rotations, Procrustes alignment."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import gap_estimates, lie, rigid_registration

interpolate_stretches = gap_estimates.interpolate_stretches
regress_without, combine_estimates = gap_estimates.regress_without, gap_estimates.combine_estimates
MIN_MARKER_SD_M = 0.002  # about the common shape, added to each marker's, so that no marker alone decides the alignment
MIN_ALIGNMENT_MARKERS = 3  # with fewer a frame has no orientation
MIN_DIRECTION_M = 1e-9  # shorter vectors have no direction
ALIGNMENT_ROUNDS = 6  # in which poses and shape are estimated in turn


def compute_cross_covariance(
    points: Float[np.ndarray, "T K 3"], model: Float[np.ndarray, "K 3"], weight: Float[np.ndarray, "T K"]
) -> tuple[Float[np.ndarray, "T 3 3"], Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Return cross-covariances of points (NaN if of weight 0) and a model about their weighted means, and these means."""
    frames = len(points)
    cross, mean_points, mean_model = np.empty((frames, 3, 3)), np.empty((frames, 3)), np.empty((frames, 3))
    rigid_registration.compute_cross_covariance_frames(
        _make_contiguous(points), _make_contiguous(model), _make_contiguous(weight), cross, mean_points, mean_model
    )
    return cross, mean_points, mean_model


def fit_rotations(cross: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Return the rotations R that maximise trace(R' cross), never a reflection; `cross` sums products measured by model."""
    rotation = np.empty(cross.shape)
    rigid_registration.fit_rotation_frames(_make_contiguous(cross), rotation)
    return rotation


def transform_to_body_axes(
    points: Float[np.ndarray, "T K 3"], origin: Float[np.ndarray, "T 3"], rotation: Float[np.ndarray, "T 3 3"]
) -> Float[np.ndarray, "T K 3"]:
    """Return world points in the axes `rotation` about `origin`; NaN stays NaN."""
    transformed = np.empty(points.shape)
    arguments = (_make_contiguous(each) for each in (points, origin, rotation))
    rigid_registration.transform_point_frames(*arguments, transformed)
    return transformed


def align_cluster(
    markers: Float[np.ndarray, "T M 3"],
    frames: Int[np.ndarray, " N"],
    cluster: Int[np.ndarray, " K"],
    weight: Float[np.ndarray, " K"],
) -> tuple[Float[np.ndarray, "N K 3"], Float[np.ndarray, "N 3 3"], Float[np.ndarray, "N 3"]]:
    """Return a cluster of markers in some frames, all of which show it, in axes that follow its mean shape.

    And these axes in the world: rotations, and centres in metres. No copy is made of markers whose paths lie together.
    """
    aligned = np.empty((len(frames), len(cluster), 3)), np.empty((len(frames), 3, 3)), np.empty((len(frames), 3))
    by_marker = _make_contiguous(markers.swapaxes(0, 1))
    rigid_registration.align_cluster_frames(by_marker, frames, cluster, _make_contiguous(weight), *aligned)
    return aligned


def _make_contiguous(array: np.ndarray) -> np.ndarray:
    """Return the array as contiguous floats, so that each kernel is compiled once."""
    return np.ascontiguousarray(array, float)


def compute_rotation_vectors(rotations: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return the rotation vectors of rotations in radians, at most half a turn long."""
    vectors = np.empty(rotations.shape[:-1])
    lie.store_rotation_vectors(_make_contiguous(rotations).reshape(-1, 3, 3), vectors.reshape(-1, 3))
    return vectors


def compute_rotations(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotations of rotation vectors in radians."""
    rotations = np.empty((*vectors.shape, 3))
    lie.store_vector_rotations(_make_contiguous(vectors).reshape(-1, 3), rotations.reshape(-1, 3, 3))
    return rotations


def compute_shortest_rotation(before: Float[np.ndarray, "3"], after: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation from the direction of `before` to that of `after`, which may have any length.

    For opposite directions it is a half turn about an axis perpendicular to them; if either is zero, it is the identity.
    """
    if not (np.linalg.norm(before) > 0 and np.linalg.norm(after) > 0):
        return np.eye(3)
    return scipy.spatial.transform.Rotation.align_vectors(after[None], before[None])[0].as_matrix()


def compute_shortest_rotations(before: Float[np.ndarray, "T 3"], after: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Return the smallest rotations from the directions of `before` to those of `after`; opposite directions are left."""
    a, b = (each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), MIN_DIRECTION_M) for each in (before, after))
    quaternion = np.column_stack([np.cross(a, b), 1.0 + np.einsum("ti,ti->t", a, b)])
    quaternion[quaternion[:, 3] < MIN_DIRECTION_M] = [0.0, 0.0, 0.0, 1.0]
    return scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix()


def build_cross_matrices(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the matrices whose products with other vectors are the cross products."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)


def scale_rotations(rotations: Float[np.ndarray, "*batch 3 3"], share: float | np.ndarray) -> Float[np.ndarray, "*batch 3 3"]:
    """Return rotations about the same axes by a share of the angles, NaN where the rotations are."""
    return compute_rotations(compute_rotation_vectors(rotations) * share)


def multiply_quaternions(p: Float[np.ndarray, "*#batch 4"], q: Float[np.ndarray, "*#batch 4"]) -> np.ndarray:
    """Return the products (..., 4) of quaternions (x, y, z, w), the rotation q followed by the rotation p."""
    (ax, ay, az, aw), (bx, by, bz, bw) = np.moveaxis(p, -1, 0), np.moveaxis(q, -1, 0)
    x, y, z = aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw
    return np.stack([x, y, z, aw * bw - ax * bx - ay * by - az * bz], axis=-1)


class CommonShape(NamedTuple):
    """The mean positions (M, 3) of markers in axes fixed to all of them, in metres, and their variances per axis (M,)."""

    positions: np.ndarray
    variance: np.ndarray


def fit_common_shape(markers: Float[np.ndarray, "T M 3"]) -> CommonShape:
    """Return the common shape of markers in metres, NaN where missing; a marker that no frame shows is NaN.

    No skeleton is used. Each marker is weighted by the inverse of its variance about the common shape, so the trunk dominates
    (Theobald & Wuttke 2006, PNAS 103, the maximum-likelihood form of Procrustes alignment).
    """
    is_visible = ~np.isnan(markers[..., 0])
    if not is_visible.any():
        return CommonShape(np.full(markers.shape[1:], np.nan), np.ones(markers.shape[1]))
    positions = markers[np.argmax(is_visible.sum(1))]
    shape = CommonShape(positions - np.nanmean(positions, 0), np.ones(markers.shape[1]))
    for _ in range(ALIGNMENT_ROUNDS - 1):
        rotation, origin, is_aligned = align_to_shape(markers, is_visible, shape)
        if not is_aligned.any():
            break
        local, is_used = transform_to_body_axes(markers, origin, rotation), is_visible & is_aligned[:, None]
        local[~is_used] = 0.0
        count = np.where(is_used.any(0), is_used.sum(0), np.nan)[:, None]
        positions = local.sum(0) / count
        local -= positions
        local[~is_used] = 0.0
        variance = np.nan_to_num(np.einsum("tma,tma->ma", local, local) / count).mean(1)
        shape = CommonShape(positions - np.nanmean(positions, 0), variance)
    return shape


def align_to_shape(
    markers: Float[np.ndarray, "T M 3"], is_visible: Bool[np.ndarray, "T M"], shape: CommonShape
) -> tuple[Float[np.ndarray, "T 3 3"], Float[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
    """Return rotations and origins that align a shape with the markers, and whether a frame has enough markers."""
    weight = is_visible * ~np.isnan(shape.positions[:, 0]) / (MIN_MARKER_SD_M**2 + shape.variance)
    is_aligned = (weight > 0).sum(1) >= MIN_ALIGNMENT_MARKERS
    cross, mean_markers, mean_shape = compute_cross_covariance(markers, np.nan_to_num(shape.positions), weight)
    rotation = fit_rotations(cross)
    return rotation, mean_markers - np.einsum("tab,tb->ta", rotation, mean_shape), is_aligned


def compute_lengths(vectors: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
    """Return the lengths of vectors, as `np.linalg.norm` does, which along so short an axis takes several times as long."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.sqrt(x * x + y * y + z * z)


def split_along_line(
    points: Float[np.ndarray, "*points 3"], start: Float[np.ndarray, "*lines 3"], end: Float[np.ndarray, "*lines 3"]
) -> tuple[Float[np.ndarray, "*shape"], Float[np.ndarray, "*shape 3"]]:
    """Return how far along a line points are, in lengths of the line also beyond its ends, and their vectors across the line."""
    axis = end - start
    share = np.asarray(((points - start) * axis).sum(-1) / np.maximum((axis * axis).sum(-1), MIN_DIRECTION_M**2))
    return share, points - start - share[..., None] * axis


def find_nearest_points(
    points: Float[np.ndarray, "*points 3"], start: Float[np.ndarray, "*lines 3"], end: Float[np.ndarray, "*lines 3"]
) -> tuple[Float[np.ndarray, "*shape"], Float[np.ndarray, "*shape 3"]]:
    """Return the shares of the way along a line of the points on it that are nearest, from 0 to 1, and the vectors from there."""
    share = np.asarray(np.clip(split_along_line(points, start, end)[0], 0.0, 1.0))
    return share, points - start - share[..., None] * (end - start)
