"""A body laid on some frames: where it would have the markers that are seen.

A person's own, where it is known, or the average body. Then nothing of the take is learnt but the size, so that a label that
is wrong all along cannot teach the body to expect it there.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix import prior
from mocapfix.kernels import kinematics
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.problem import Attached, Problem, no_pull, pull_to, within
from mocapfix.kernels.registration import poses
from mocapfix.marker_set import MarkerSet
from mocapfix.motion import Motion
from mocapfix.prior import JointLimits, Prior
from mocapfix.skeleton import Body, Skeleton, cmu31
from mocapfix.subject import Subject

MARKER_SD = 0.030  # metres per axis: a marker's place, people's proportions and skin together
LIMITS_SD = 0.1  # radians, beyond people's joint limits
SCALES = (0.4, 0.2, 0.1)  # metres (Geman-McClure)
MOST = 8  # iterations at each scale
SHORTEST = 0.12  # metres: nearer pairs say more of where markers were stuck than of the body's size


@dataclass(frozen=True)
class Figure:
    """A body that wears K markers, and what its poses are like."""

    body: Body
    subject: Subject
    prior: Prior
    limits: JointLimits

    def placed(self, markers: np.ndarray) -> np.ndarray:
        """-> (N, K, 3) metres: where the body has its K markers in N frames (N, K, 3), each laid for itself; NaN not seen."""
        start = poses(self.subject, self.body.free, self.prior, markers)
        tree = Tree(self.body.skeleton.parents, self.subject.skeleton.offsets, self.body.free)
        problem = Problem(
            tree, Attached(self.subject.joints, self.subject.places), markers, ~np.isnan(markers[..., 0]), MARKER_SD,
            pull_to(self.prior), within(self.limits, LIMITS_SD),
        )  # fmt: skip
        problem.solve(start.root, start.rotations, no_pull(len(self.body.free)), SCALES, MOST)
        return kinematics.placed(self.subject, start)[1]


def of(subject: Subject) -> Figure:
    """-> the body of a subject."""
    body = cmu31()
    return Figure(body, subject, prior.load("mean-pose", body.skeleton), prior.load_limits(body.skeleton))


def average(marker_set: MarkerSet, markers: np.ndarray) -> Figure:
    """-> the average body at the size that markers (N, K, 3) in metres, NaN where not seen, tell."""
    skeleton, ratio = cmu31().skeleton, size(marker_set, markers)
    grown = replace(skeleton, offsets=skeleton.offsets * ratio, ends=skeleton.ends * ratio)
    return of(wearing(marker_set, grown, marker_set.places * ratio))


def wearing(marker_set: MarkerSet, skeleton: Skeleton, places: np.ndarray) -> Subject:
    """-> somebody of these bones with the set's markers at places (K, 3) in metres."""
    return Subject(skeleton, marker_set.name, marker_set.labels, marker_set.joints, places, marker_set.spread)


def size(marker_set: MarkerSet, markers: np.ndarray) -> float:
    """-> the subject's size over the average body's: the median over the distances within segments, 1 where none is seen."""
    first, second = np.triu_indices(len(marker_set.joints), 1)
    nominal = np.linalg.norm(marker_set.places[first] - marker_set.places[second], axis=1)
    together = marker_set.joints[first] == marker_set.joints[second]
    seen = ~np.isnan(markers[..., 0])
    known = together & (nominal > SHORTEST) & (seen[:, first] & seen[:, second]).any(0)
    if not known.any():
        return 1.0
    real = np.nanmedian(np.linalg.norm(markers[:, first[known]] - markers[:, second[known]], axis=-1), axis=0)
    return float(np.median(real / nominal[known]))


def misfit(markers: np.ndarray, placed: np.ndarray) -> np.ndarray:
    """-> half a squared distance (...,) in standard deviations, robust (Geman & McClure 1987); 0 where not seen."""
    square = ((markers - placed) ** 2).sum(-1)
    return np.nan_to_num(0.5 * square / (1 + square / SCALES[-1] ** 2)) / MARKER_SD**2


def rest(marker_set: MarkerSet) -> np.ndarray:
    """-> (K, 3) metres: the set's markers on the average body as it rests."""
    skeleton = cmu31().skeleton
    still = np.tile(np.eye(3), (1, len(skeleton.names), 1, 1))
    nothing = np.zeros((1, 0))
    pose = Motion(np.zeros((1, 3)), still, np.zeros(1, int), np.zeros(1, int), nothing, nothing)
    return kinematics.placed(wearing(marker_set, skeleton, marker_set.places), pose)[1][0]
