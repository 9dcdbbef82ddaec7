"""The markers of a labelled take as a model of the person, where no body is known: each marker moves with those around it.

A marker is predicted from its neighbours, those whose distances from it vary least. Frames of the labelled take in which the
neighbours have about the same distances from each other show where the marker is among them (nearest neighbours in the space of
poses; each frame is aligned rigidly, so that a mirror image does not fit).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from mocapfix.stats.rigid_alignment import compute_cross_covariance, fit_rotations
from mocapfix.stats.rigid_groups import measure_distance_spread
from mocapfix.stats.sequences import sample_evenly

MAX_REFERENCE_CANDIDATES = 150
"""Frames of the labelled take among which those with different poses are chosen."""
MAX_POSES = 12
"""Poses of the labelled take that are kept."""
MAX_NEIGHBOURS = 8
"""Neighbours from which a marker is predicted."""
MIN_NEIGHBOURS = 3
"""Neighbours that must be visible."""
MIN_REFERENCE_DISTANCE_SD_M = 0.008
"""Smallest standard deviation of a distance between markers."""
RELATIVE_REFERENCE_SD = 0.03
"""Standard deviation of a distance that did not vary in the take, as a share of it: the person may have moved little."""
BODY_ROTATION_WEIGHT_M = 0.03
"""Arm of the points that hold the neighbours' rotation at that of all markers, where they are nearly on a line."""
MIN_POSE_RESIDUAL_M = 0.004
"""Residual of the neighbours up to which poses fit equally."""


@dataclass(frozen=True)
class ReferenceMarkers:
    """K markers of a labelled take.

    Attributes:
        labels: Their labels.
        poses: Their positions in E frames of the take, metres, NaN where missing.
        distance_sd_m: Standard deviations of the distances of pairs; infinite for markers that were never visible together.
    """

    labels: tuple[str, ...]
    poses: Float[np.ndarray, "E K 3"]
    distance_sd_m: Float[np.ndarray, "K K"]

    @cached_property
    def neighbours(self) -> Int[np.ndarray, "K N"]:
        """Indices of the neighbours of each marker."""
        return np.argsort(self.distance_sd_m, axis=1, kind="stable")[:, :MAX_NEIGHBOURS]

    @cached_property
    def weights(self) -> Float[np.ndarray, "K N"]:
        """Weights of the neighbours in 1/m2; 0 for those that were never visible with the marker."""
        return 1 / np.take_along_axis(self.distance_sd_m, self.neighbours, axis=1) ** 2

    def select_markers(self, markers: Int[np.ndarray, " L"]) -> "ReferenceMarkers":
        """Return some of the markers, with the neighbours that they have among each other."""
        labels = tuple(self.labels[marker] for marker in markers)
        return ReferenceMarkers(labels, self.poses[:, markers], self.distance_sd_m[np.ix_(markers, markers)])

    def predict(self, positions: Float[np.ndarray, "S K 3"]) -> Float[np.ndarray, "S K 3"]:
        """Return where each marker is by its neighbours, in metres; NaN where fewer than three of them are visible.

        Poses in which the neighbours fit about equally well are averaged.
        """
        body_rotations = np.stack([self.align(positions, pose)[0] for pose in self.poses], axis=1)
        predicted = np.full(positions.shape, np.nan)
        for k in range(len(self.labels)):
            points, squared = self.predict_marker(positions, k, self.poses, body_rotations)
            least = np.where(np.isfinite(squared.min(1)), squared.min(1), 0.0)[:, None]
            weight = np.exp(-0.5 * (squared - least) / np.maximum(least, MIN_POSE_RESIDUAL_M**2))
            total = weight.sum(1)[:, None]
            average = (weight[..., None] * np.where(weight[..., None] > 0, points, 0.0)).sum(1) / np.maximum(total, 1e-12)
            predicted[:, k] = np.where(total > 0, average, np.nan)
        return predicted

    def align(
        self, positions: Float[np.ndarray, "S K 3"], pose: Float[np.ndarray, "K 3"]
    ) -> tuple[Float[np.ndarray, "S 3 3"], Float[np.ndarray, "S K 3"]]:
        """Return the rotations of a pose to the positions of all markers, and the pose rotated and moved there."""
        weight = (~np.isnan(positions[..., 0]) & ~np.isnan(pose[:, 0])).astype(float)
        cross, mean, mean_pose = compute_cross_covariance(positions, pose, weight)
        rotations = fit_rotations(cross)
        return rotations, mean[:, None] + np.einsum("sij,skj->ski", rotations, pose - mean_pose[:, None])

    def predict_marker(
        self,
        positions: Float[np.ndarray, "S K 3"],
        k: int,
        poses: Float[np.ndarray, "E K 3"],
        body_rotations: Float[np.ndarray, "S E 3 3"],
    ) -> tuple[Float[np.ndarray, "S E 3"], Float[np.ndarray, "S E"]]:
        """Return where each pose has a marker among its neighbours, and their mean squared residual in m2 (infinite: unknown)."""
        neighbours = self.neighbours[k]
        is_visible, is_in_pose = ~np.isnan(positions[:, neighbours, 0]), ~np.isnan(poses[:, neighbours, 0]).T
        weight = self.weights[k] * is_visible
        own = np.where(is_visible[..., None], positions[:, neighbours], 0.0)
        model = np.where(is_in_pose[..., None], poses[:, neighbours].swapaxes(0, 1), 0.0)  # (N, E, 3)
        total = np.maximum(weight @ is_in_pose, 1e-9)
        weighted = own * weight[..., None]
        mean = np.einsum("sni,ne->sei", weighted, is_in_pose) / total[..., None]
        mean_model = np.einsum("sn,nej->sej", weight, model) / total[..., None]
        frames, count = len(positions), len(poses)
        products = weighted.swapaxes(1, 2).reshape(-1, len(neighbours)) @ model.reshape(len(neighbours), -1)
        cross = products.reshape(frames, 3, count, 3).swapaxes(1, 2) - total[..., None, None] * (
            mean[..., :, None] * mean_model[..., None, :]
        )
        held = cross + BODY_ROTATION_WEIGHT_M**2 * total[..., None, None] * body_rotations
        rotations = fit_rotations(held.reshape(-1, 3, 3)).reshape(frames, count, 3, 3)
        squared = ((own**2).sum(-1) * weight) @ is_in_pose + weight @ (model**2).sum(-1)
        squared -= total * ((mean**2).sum(-1) + (mean_model**2).sum(-1)) + 2 * (rotations * cross).sum((-2, -1))
        points = mean + (rotations @ (poses[:, k] - mean_model)[..., None])[..., 0]
        is_known = ((weight > 0).astype(float) @ is_in_pose >= MIN_NEIGHBOURS) & ~np.isnan(poses[:, k, 0])
        return points, np.where(is_known, np.maximum(squared / total, 0.0), np.inf)


def build_reference_markers(markers: Float[np.ndarray, "T K 3"], labels: tuple[str, ...]) -> ReferenceMarkers:
    """Return the model of a labelled take's markers, in metres, NaN where missing."""
    poses = _choose_poses(markers)
    distances = _measure_distances(poses)
    count = (~np.isnan(distances)).sum(axis=0)
    mean_distance = np.divide(np.nansum(distances, axis=0), count, out=np.full(count.shape, np.inf), where=count > 0)
    spread = np.hypot(measure_distance_spread(markers), RELATIVE_REFERENCE_SD * mean_distance)
    spread = np.hypot(spread, MIN_REFERENCE_DISTANCE_SD_M)
    np.fill_diagonal(spread, np.inf)
    return ReferenceMarkers(labels, poses, spread)


def _choose_poses(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "E K 3"]:
    """Return frames with many markers and with poses as different as possible."""
    visible = (~np.isnan(markers[..., 0])).sum(1)
    full = np.flatnonzero(visible >= np.quantile(visible, 0.5))
    candidates = markers[full[sample_evenly(len(full), MAX_REFERENCE_CANDIDATES)]]
    distances = np.nan_to_num(_measure_distances(candidates).reshape(len(candidates), -1))
    chosen = [int(np.argmax((~np.isnan(candidates[..., 0])).sum(1)))]
    nearest = np.linalg.norm(distances - distances[chosen[0]], axis=1)
    while len(chosen) < min(MAX_POSES, len(candidates)) and nearest.max() > 0:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(distances - distances[chosen[-1]], axis=1))
    return candidates[chosen]


def _measure_distances(positions: Float[np.ndarray, "S K 3"]) -> Float[np.ndarray, "S K K"]:
    return np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
