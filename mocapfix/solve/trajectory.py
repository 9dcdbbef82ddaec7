"""The poses of all frames at once: a cubic spline of least cost, by Levenberg-Marquardt over its control points.

The unknowns of a frame (`kernels.hinged_tree`) are a uniform cubic B-spline over time, whose control points are a few frames
apart. A frame depends on four of them, so that the curvature is a band, and a step takes time in proportion to the frames. Limits
of positions bound the control points, those of speeds are costs of their differences: a spline exceeds a limit by no more than
those do.

The whole take decides every frame, the first one too. The cost may count every n-th frame only while the poses are still far.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solveh_banded

from mocapfix.kernels.hinged_tree import ROOT_UNKNOWNS as ROOT_UNKNOWNS
from mocapfix.kernels.hinged_tree import BalanceTerm as BalanceTerm
from mocapfix.kernels.hinged_tree import CollisionTerm as CollisionTerm
from mocapfix.kernels.hinged_tree import FloorTerm as FloorTerm
from mocapfix.kernels.hinged_tree import (
    HingedTerms,
    HingedTree,
    add_models_to_spline,
    linearise_hinged_frames,
    place_points_of_frames,
)
from mocapfix.kernels.hinged_tree import LineTerm as LineTerm
from mocapfix.kernels.hinged_tree import LinkRotationTerm as LinkRotationTerm
from mocapfix.kernels.hinged_tree import PlaceTerm as PlaceTerm

FAR_START_DAMPING = 0.1  # of the diagonal of the curvature, for a far start
MIN_CURVATURE = 1e-6  # of a control point that nothing determines
HELD_STIFFNESS = 1e6  # over the curvature, of coordinates that are held at limits
SECOND_DIFFERENCE, THIRD_DIFFERENCE = (1.0, -2.0, 1.0), (-1.0, 3.0, -3.0, 1.0)


@dataclass(frozen=True)
class SplineBasis:
    """A uniform cubic B-spline over T frames, of K control points."""

    interval: int  # frames between control points
    rate: float  # frames per second
    segments: Int[np.ndarray, " T"]  # first of the four control points on which a frame depends
    weights: Float[np.ndarray, "T 4"]  # by which it does

    @property
    def point_count(self) -> int:
        """The number of control points."""
        return int(self.segments[-1]) + 4

    @property
    def interval_s(self) -> float:
        """Seconds between control points."""
        return self.interval / self.rate

    def evaluate(self, points: Float[np.ndarray, "K D"]) -> Float[np.ndarray, "T D"]:
        """Return the spline at the frames."""
        return np.ascontiguousarray(sum(self.weights[:, k, None] * points[self.segments + k] for k in range(4)))

    def fit(self, values: Float[np.ndarray, "T D"]) -> Float[np.ndarray, "K D"]:
        """Return the control points of the spline nearest to values, by least squares."""
        band = np.zeros((4, self.point_count))
        target = np.zeros((self.point_count, values.shape[1]))
        for a in range(4):
            np.add.at(target, self.segments + a, self.weights[:, a, None] * values)
            for b in range(a + 1):
                np.add.at(band[a - b], self.segments + b, self.weights[:, a] * self.weights[:, b])
        band[0] += MIN_CURVATURE
        return solveh_banded(band, target, lower=True)


def build_spline_basis(frame_count: int, rate: float, interval: int) -> SplineBasis:
    """Return a spline whose control points are `interval` frames apart."""
    segments, share = np.arange(frame_count) // interval, (np.arange(frame_count) % interval) / interval
    weights = ((1 - share) ** 3, 3 * share**3 - 6 * share**2 + 4, -3 * share**3 + 3 * share**2 + 3 * share + 1, share**3)
    return SplineBasis(interval, rate, segments, np.stack(weights, axis=1) / 6)


@dataclass(frozen=True)
class ControlCosts:
    """What a control point costs for each frame that it stands for, over D unknowns, of which U are joint positions.

    Attributes:
        limits: Of joint positions, (U, 2), never exceeded.
        speed_limits: Of joint positions per second, (U,), and the standard deviation of an excess.
        rest: Joint positions to which nothing else pulls, (U,), and the standard deviation from them.
        acceleration_sd: Of the unknowns, per square second, (D,).
        jerk_sd: Per cubic second, (D,).
    """

    limits: Float[np.ndarray, "U 2"]
    speed_limits: Float[np.ndarray, " U"]
    speed_sd: float
    rest: Float[np.ndarray, " U"]
    rest_sd: float
    acceleration_sd: Float[np.ndarray, " D"]
    jerk_sd: Float[np.ndarray, " D"]

    def add(
        self,
        basis: SplineBasis,
        points: Float[np.ndarray, "K D"],
        band: Float[np.ndarray, "N W"],
        gradient: Float[np.ndarray, "K D"],
    ) -> float:
        """Add the model at control points to that of the spline, as `add_models_to_spline` does. Return the cost."""
        count, size, cost = *points.shape, 0.0
        curvature = band.reshape(count, size, band.shape[1])
        own = slice(ROOT_UNKNOWNS, None)
        joints, weight = points[:, own], float(basis.interval)
        error, stiffness = joints - self.rest, weight / self.rest_sd**2
        cost += 0.5 * stiffness * float((error**2).sum())
        gradient[:, own] += stiffness * error
        curvature[:, own, 0] += stiffness
        speed = np.diff(joints, axis=0) / basis.interval_s
        excess = speed - np.clip(speed, -self.speed_limits, self.speed_limits)
        slope = weight / (self.speed_sd**2 * basis.interval_s)
        cost += 0.5 * weight * float((excess**2).sum()) / self.speed_sd**2
        gradient[1:, own] += slope * excess
        gradient[:-1, own] -= slope * excess
        stiffness = slope / basis.interval_s * (excess != 0)
        curvature[1:, own, 0] += stiffness
        curvature[:-1, own, 0] += stiffness
        curvature[:-1, own, size] -= stiffness
        for difference, sd in ((SECOND_DIFFERENCE, self.acceleration_sd), (THIRD_DIFFERENCE, self.jerk_sd)):
            order = len(difference) - 1
            stop = count - order
            value = sum(factor * points[k : k + stop] for k, factor in enumerate(difference))
            stiffness = weight * basis.interval_s ** (-2 * order) / sd**2
            cost += 0.5 * float((stiffness * value**2).sum())
            for a, factor in enumerate(difference):
                gradient[a : a + stop] += stiffness * factor * value
                for b, other in enumerate(difference[: a + 1]):
                    curvature[b : b + stop, :, (a - b) * size] += stiffness * factor * other
        return cost


@dataclass(frozen=True)
class Trajectory:
    """The poses of T frames as the control points of a spline."""

    basis: SplineBasis
    references: Float[np.ndarray, "T 3 3"]  # rotations of the root for zero rotation vectors
    points: Float[np.ndarray, "K D"]

    @property
    def unknowns(self) -> Float[np.ndarray, "T D"]:
        """The unknowns of the frames."""
        return self.basis.evaluate(self.points)

    def limit_speeds(self, speeds: Float[np.ndarray, " U"]) -> "Trajectory":
        """Return the trajectory with joints that are nowhere faster than their speeds, and unchanged where they are not.

        Control points are the middle of the largest slow enough series below and the smallest above them.
        """
        joints = self.points[:, ROOT_UNKNOWNS:]
        ramp = np.arange(len(joints))[:, None] * speeds * self.basis.interval_s

        def find_below(values: Float[np.ndarray, "K U"]) -> Float[np.ndarray, "K U"]:
            forward = np.minimum.accumulate(values - ramp) + ramp
            return np.minimum(forward, np.minimum.accumulate((values + ramp)[::-1])[::-1] - ramp)

        slow = 0.5 * (find_below(joints) - find_below(-joints))
        return replace(self, points=np.hstack([self.points[:, :ROOT_UNKNOWNS], slow]))

    def select_points(self, first: int, stop: int) -> "Trajectory":
        """Return the part of the trajectory between the control points `first` and `stop` - 3."""
        interval = self.basis.interval
        frames = slice(first * interval, min((stop - 3) * interval, len(self.references)))
        basis = build_spline_basis(frames.stop - frames.start, self.basis.rate, interval)
        return Trajectory(basis, self.references[frames], self.points[first:stop])


def place_points(
    tree: HingedTree,
    references: Float[np.ndarray, "T 3 3"],
    unknowns: Float[np.ndarray, "T D"],
    links: Int[np.ndarray, " P"],
    offsets: Float[np.ndarray, "P 3"],
) -> tuple[Float[np.ndarray, "T P 3"], Float[np.ndarray, "T P 3 3"]]:
    """Return where points of links are, in metres, and the rotations of these links."""
    places, rotations = np.empty((len(unknowns), len(links), 3)), np.empty((len(unknowns), len(links), 3, 3))
    place_points_of_frames(tree, references, unknowns, links, np.ascontiguousarray(offsets), places, rotations)
    return places, rotations


def compute_hinged_costs(
    tree: HingedTree, terms: HingedTerms, references: Float[np.ndarray, "T 3 3"], unknowns: Float[np.ndarray, "T D"]
) -> Float[np.ndarray, " T"]:
    """Return the cost of each frame under terms."""
    curvature, gradient = np.empty((1, *unknowns.shape[1:], *unknowns.shape[1:])), np.empty((1, unknowns.shape[1]))
    return np.array(
        [
            linearise_hinged_frames(tree, terms, np.array([frame]), references, unknowns, False, curvature, gradient)
            for frame in range(len(unknowns))
        ]
    )


def minimise_trajectory(
    tree: HingedTree,
    terms: HingedTerms,
    costs: ControlCosts,
    start: Trajectory,
    *,
    frame_step: int = 1,
    max_iterations: int,
    min_decrease: float,
    damping: float = FAR_START_DAMPING,
) -> tuple[Trajectory, float]:
    """Return the trajectory of least cost, and this cost.

    Damping and acceptance are those of `kernels.levenberg_marquardt`, with the diagonal of the curvature (Marquardt 1963). Steps
    are projected (Bertsekas 1982): coordinates that the gradient pushes beyond their limits are held there, and in a second solve
    those that the step takes beyond them.

    Args:
        tree: The links and joints.
        terms: The terms of the T frames.
        costs: Those of control points.
        start: Where to start.
        frame_step: Every so many frames count, each for as many.
        max_iterations: Steps tried.
        min_decrease: Relative decrease of the cost at which the search ends.
        damping: At the start.
    """
    basis, (count, size) = start.basis, start.points.shape
    frames = np.arange(0, len(basis.segments), frame_step)
    curvatures, gradients = np.empty((len(frames), size, size)), np.empty((len(frames), size))

    def linearise(points: Float[np.ndarray, "K D"]) -> tuple[float, Float[np.ndarray, " N"], Float[np.ndarray, "N W"]]:
        band, gradient = np.zeros((count * size, 4 * size)), np.zeros(count * size)
        unknowns = basis.evaluate(points)
        cost = linearise_hinged_frames(tree, terms, frames, start.references, unknowns, True, curvatures, gradients)
        add_models_to_spline(frames, basis.segments, basis.weights, curvatures, gradients, float(frame_step), band, gradient)
        return frame_step * cost + costs.add(basis, points, band, gradient.reshape(count, size)), gradient, band

    low, high = np.vstack([np.tile([-np.inf, np.inf], (ROOT_UNKNOWNS, 1)), costs.limits]).T
    points, growth = np.clip(start.points, low, high), 2.0
    cost, gradient, band = linearise(points)
    for _ in range(max_iterations):
        slope, diagonal = gradient.reshape(count, size), band[:, 0].copy()
        is_held = (((points <= low) & (slope > 0.0)) | ((points >= high) & (slope < 0.0))).ravel()
        wanted, is_first = np.zeros(count * size), True
        while True:
            damped, stiffness = band.copy(), HELD_STIFFNESS * diagonal * is_held
            damped[:, 0] += damping * diagonal + MIN_CURVATURE + stiffness
            pull = stiffness * wanted - gradient
            step = solveh_banded(damped.T, pull, overwrite_ab=True, lower=True, check_finite=False)
            moved = points + step.reshape(count, size)
            trial = np.clip(moved, low, high)
            is_outside = (trial != moved).ravel() & ~is_held
            if not is_first or not is_outside.any():
                break
            is_held, wanted, is_first = is_held | is_outside, (trial - points).ravel(), False
        predicted = 0.5 * float(step @ (damping * diagonal * step + stiffness * step - pull)) - float(gradient @ step)
        trial_model = linearise(trial)
        decrease = cost - trial_model[0]
        if decrease > 0.0:
            is_last = decrease < min_decrease * cost
            points, (cost, gradient, band) = trial, trial_model
            damping, growth = damping * max(0.1, 1.0 - (2.0 * decrease / predicted - 1.0) ** 3), 2.0
            if is_last:
                break
        else:
            damping, growth = max(damping * growth, MIN_CURVATURE), 2.0 * growth
    return replace(start, points=points), cost
