"""Functional joints: the point that is fixed in two rigid groups of markers while both move.

The two-sided method fits a place in the axes of each group such that both are at the same point in all frames (Ehrig et al. 2006,
"A survey of formal methods for determining the centre of rotation of ball joints"). A hinge fixes this point only across its
axis; along it, the point is taken that is nearest to both groups.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mocapfix.stats.rigid_alignment import align_to_common_shape

JOINT_SAMPLE_SD_M = 0.01
"""Distance between the two places in one frame by which a fit is weighted: markers move with the skin."""
JOINT_PRIOR_SD_M = 0.2
"""Standard deviation per axis of a joint about the point between its groups; it matters along the axis of a hinge."""
INDEPENDENT_JOINT_POSES = 20.0
"""Effective number of independent frames of a take."""
MIN_FUNCTIONAL_JOINT_FRAMES = 30
"""Frames in which the poses of both groups must be known, or a third of the frames of a short take."""


class MovingGroup(NamedTuple):
    """The poses of a rigid group of markers in N frames.

    markers   their indices
    rotation  (N, 3, 3) of the group's axes in the world
    origin    (N, 3) m
    places    (K, 3) m: mean places of the markers in these axes
    is_known  (N,) whether a frame shows enough of the markers
    """

    markers: tuple[int, ...]
    rotation: Float[np.ndarray, "N 3 3"]
    origin: Float[np.ndarray, "N 3"]
    places: Float[np.ndarray, "K 3"]
    is_known: Bool[np.ndarray, " N"]

    @property
    def centroid(self) -> Float[np.ndarray, "3"]:
        """The mean of the places."""
        return self.places.mean(0)

    def move(self, place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "N 3"]:
        """Return a place in the group's axes in the world."""
        return self.rotation @ place + self.origin


class FunctionalJoint(NamedTuple):
    """The joint between two groups.

    places      (2, 3) m: in the axes of the first and of the second group
    residual_m  root mean square distance between the two in a frame
    range_rad   root mean square angle by which the groups turn against each other
    """

    places: Float[np.ndarray, "2 3"]
    residual_m: float
    range_rad: float


def build_moving_group(markers: Float[np.ndarray, "N M 3"], columns: tuple[int, ...]) -> MovingGroup:
    """Return the poses of some markers, in metres, that keep their distances; without those that no such frame shows."""
    rotation, origin, is_known = align_to_common_shape(markers[:, list(columns)])
    shown = [m for m in columns if not np.isnan(markers[is_known, m, 0]).all()]
    local = np.einsum("tba,tkb->tka", rotation[is_known], markers[is_known][:, shown] - origin[is_known, None])
    return MovingGroup(tuple(shown), rotation, origin, np.nanmean(local, axis=0), is_known)


def estimate_functional_joint(first: MovingGroup, second: MovingGroup) -> FunctionalJoint | None:
    """Return the joint between two groups, None if too few frames show both."""
    is_known = first.is_known & second.is_known
    count = int(is_known.sum())
    if count < min(MIN_FUNCTIONAL_JOINT_FRAMES, len(is_known) // 3 + 2):
        return None
    a, b = first.rotation[is_known], second.rotation[is_known]
    between = (first.move(first.centroid) + second.move(second.centroid))[is_known] / 2
    prior = np.concatenate(
        [
            np.einsum("tba,tb->ta", rotation, between - group.origin[is_known]).mean(0)
            for group, rotation in ((first, a), (second, b))
        ]
    )
    design = np.concatenate([a, -b], axis=2).reshape(-1, 6)
    gap = (second.origin - first.origin)[is_known].ravel()
    precision = INDEPENDENT_JOINT_POSES / count / JOINT_SAMPLE_SD_M**2
    normal = precision * design.T @ design + np.eye(6) / JOINT_PRIOR_SD_M**2
    places = prior + np.linalg.solve(normal, precision * design.T @ (gap - design @ prior))
    residual = (design @ places - gap).reshape(-1, 3)
    relative = Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b)
    angles = (relative.mean().inv() * relative).magnitude()
    return FunctionalJoint(places.reshape(2, 3), float(np.sqrt((residual**2).sum(1).mean())), float(np.sqrt((angles**2).mean())))
