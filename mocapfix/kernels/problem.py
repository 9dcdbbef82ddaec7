"""The pose problem of a whole take, bound together once: a body, what was seen of it, and what its poses are like."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix.kernels import plan
from mocapfix.kernels.levenberg import TAU, solve_frames
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Courses, Limits, Points, Targets, rows_of
from mocapfix.kernels.threads import over_frames
from mocapfix.kernels.uncertainty import uncertainties
from mocapfix.prior import JointLimits, Prior
from mocapfix.take import runs

COMPILED = "levenberg.solve_frames-*.nbi"  # the index that Numba keeps of the longest compilation
MOST = 20  # iterations of a frame at each robust scale


class Attached(NamedTuple):
    """The markers' places on the joints."""

    joints: np.ndarray  # (K,)
    places: np.ndarray  # (K, 3) metres


class Uncertainty(NamedTuple):
    """What the curvature at a pose leaves open, per axis."""

    markers: np.ndarray  # (T, K) metres, standard deviation of each marker as the body places it
    joints: np.ndarray  # (T, J) metres, standard deviation of each joint's place
    turns: np.ndarray  # (T, J) rad^2, variance of each joint's turn, [:, 0] of the root's
    root: np.ndarray  # (T,) m^2, variance of the root's place


def compiled() -> bool:
    """-> whether this machine has kept the compiled solve from an earlier run."""
    kept = solve_frames.stats.cache_path
    return kept is not None and any(Path(kept).glob(COMPILED))


def no_pull(joints: int) -> Courses:
    """-> a pull that pulls nothing."""
    return Courses(np.zeros((1, joints, 3, 3)), np.zeros((1, joints)), np.zeros((1, 3)), np.zeros(1))


def pull_to(prior: Prior) -> Targets:
    """-> a prior as the pull of every frame to its mean pose."""
    return Targets(prior.rotations[None], prior.information[None])


def within(limits: JointLimits, sd: float) -> Limits:
    """-> joint limits as soft walls; beyond them lies a standard deviation of `sd` radians."""
    return Limits(limits.rotations, limits.low, limits.high, sd**-2)


def no_limits(joints: int) -> Limits:
    """-> walls that no joint meets."""
    return Limits(np.zeros((joints, 3, 3)), np.full((joints, 3), -np.inf), np.full((joints, 3), np.inf), 0.0)


@dataclass(frozen=True)
class Problem:
    """Poses are solved in place: root (T, 3) metres, local rotations (T, J, 3, 3).

    markers    (T, K, 3) metres, the subject's markers, NaN where not believed
    listened   (T, K) bool: believed samples that the pose listens to
    marker_sd  metres, standard deviation per axis of a marker about its place
    prior      the pull of every frame to the mean pose
    limits     how far the joints turn
    """

    tree: Tree
    attached: Attached
    markers: np.ndarray
    listened: np.ndarray
    marker_sd: float
    prior: Targets
    limits: Limits

    @cached_property
    def points(self) -> Points:
        """The markers as a term."""
        seen = np.where(self.listened[..., None], self.markers, 0.0)
        return Points(self.attached.joints, self.attached.places, seen, self.listened / self.marker_sd**2)

    def terms(self, pull: Courses) -> tuple[Points, Courses, Targets, Limits]:
        """-> all that holds the poses, with this pull."""
        return self.points, pull, self.prior, self.limits

    def scales2(self, scales: tuple[float, ...]) -> np.ndarray:
        """-> robust scales in metres as the kernels want them: squared, in units of marker_sd."""
        return (np.array(scales) / self.marker_sd) ** 2

    def solve(self, root, local, pull: Courses, scales: tuple[float, ...], most: int = MOST) -> tuple[np.ndarray, np.ndarray]:
        """Move every frame's pose to where its cost is least, through the robust scales (metres). -> status, iterations

        A frame whose root is NaN has no pose yet and goes on from where the one before it ended; all others are for themselves.
        """
        order = plan.going_on(~np.isnan(root[:, 0]), local.shape[1])
        return self.follow(order, root, local, pull, scales, most)

    def track(self, root, local, pull: Courses, unsure: np.ndarray, scale: float) -> None:
        """Solve the frames with unsure joints (T, J) anew, each from its neighbour, from both ends of their runs inwards."""
        self.follow(plan.bridges(runs(np.any(unsure, axis=1)), unsure), root, local, pull, (scale,), MOST)

    def follow(self, order: plan.Plan, root, local, pull: Courses, scales: tuple[float, ...], most: int):
        """Solve frames as a plan says. -> status, iterations, 0 where a frame is not in the plan"""
        terms, status, iterations = self.terms(pull), np.zeros(len(root), int), np.zeros(len(root), int)
        over_frames(
            solve_frames, len(order.chains) - 1, self.tree, terms, order, self.scales2(scales), TAU, most,
            rows_of(terms), root, local, np.zeros((len(root), 0)), status, iterations,
        )  # fmt: skip
        return status, iterations

    def uncertainty(self, root, local, pull: Courses, scale: float) -> Uncertainty:
        """-> how sure the poses are, given a pull (metres: the robust scale)."""
        frames, joints = local.shape[:2]
        each, terms = (frames, joints), self.terms(pull)
        left = Uncertainty(np.zeros(self.listened.shape), np.zeros(each), np.zeros(each), np.zeros(frames))
        over_frames(
            uncertainties, frames, self.tree, terms, self.scales2((scale,))[0], rows_of(terms), root, local,
            np.zeros((frames, 0)), *left,
        )  # fmt: skip
        return left
