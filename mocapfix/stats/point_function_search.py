"""Find points that are exact functions of other points: midpoints, weighted means, and places in a frame that three points span.

Programs compute joint centres and virtual markers from markers, to the last digit. A measured marker has noise of its own and
moves on the skin, so no function of others gives its position to a hundredth of a millimetre. The opposite is not true of
markers whose mutual distances are exact as well, as in takes that a program has solved: there every marker is a function of
the others. So a point is a function of its parents only if their distances vary far more than its position misses the function.
"""

from collections.abc import Sequence
from functools import cache
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.stats.exact_distances import (
    MAX_FUNCTION_FRAMES,
    MAX_MISFIT_RESOLUTIONS,
    MIN_COMMON_FRAME_FRACTION,
    MIN_COMMON_FRAMES,
    MIN_MISFIT_LIMIT_M,
    compute_known_median,
    find_exactly_rigid_points,
    measure_distance_sd,
)
from mocapfix.stats.point_functions import PointFunction, build_frame_axes
from mocapfix.stats.sequences import sample_evenly

# Number of frames, evenly spread, that decide which functions, and which points between two, are worth a full estimate.
MAX_SCREENED_FRAMES = 20
MAX_LINE_FRAMES = 5
# Largest such distance in the screening by functions of nearly the right form, in addition to that limit.
SCREENING_MISFIT_M = 2e-3
# Largest such distance in the screening by functions of the right form, in multiples of that limit.
EXACT_SCREENING_LIMITS = 5.0
# Smallest standard deviation of a distance between parents, in multiples of that limit.
MIN_PARENT_VARIATION = 10.0
# Fraction of the frames in which a function must hold, to within a multiple of the limit: parents and points may have faults.
MIN_VALID_FRACTION = 0.8
VALID_FRAME_LIMITS = 5.0
# Number of the neighbours with the steadiest distances among which parents are searched.
MAX_PARENT_CANDIDATES = 5
# Number of the same among which two points are searched between which a point lies.
MAX_LINE_CANDIDATES = 60
# Standard deviation of a steady distance, and its largest deviation in a frame without faults, both in metres.
MAX_STEADY_SD_M = 0.005
MAX_STEADY_DEVIATION_M = 0.04
# Number of rounds of reweighting, by which a fit ignores frames with faults.
REWEIGHTING_ROUNDS = 6
SCREENING_ROUNDS = 2
# A smaller weight is none.
NEGLIGIBLE_WEIGHT = 1e-3
# A shorter offset, in metres, is none.
NEGLIGIBLE_OFFSET_M = 1e-4
# Number of frames that three points span which are tried for one point after the screening.
MAX_FULL_FITS = 8


def find_point_functions(
    points: Float[np.ndarray, "T P 3"],
    resolution_m: float,
    is_candidate: Bool[np.ndarray, " P"],
    is_parent: Bool[np.ndarray, " P"],
) -> dict[int, PointFunction]:
    """Find the candidates that are functions of other points.

    Points between two others are searched among all pairs; means of several points and places in frames among the neighbours
    with the steadiest distances, whose midpoints can be corners of the frame as well. A point that is a function is no parent.

    Args:
        points: Positions in metres, NaN where missing.
        resolution_m: Smallest difference that the coordinates resolve.
        is_candidate: Points that may be functions.
        is_parent: Points that may be parents. Those of them that keep exact distances to others are tried last.

    Returns:
        The function of each point that is one, by its index.
    """
    if len(points) < MIN_COMMON_FRAMES:
        return {}
    search = _FunctionSearch(
        points[sample_evenly(len(points), MAX_FUNCTION_FRAMES)], max(MAX_MISFIT_RESOLUTIONS * resolution_m, MIN_MISFIT_LIMIT_M)
    )
    is_parent, functions = is_parent.copy(), dict[int, PointFunction]()
    is_exact = find_exactly_rigid_points(points, resolution_m)
    is_tried = [~is_exact, np.ones_like(is_exact)] if is_exact.any() else [~is_exact]
    for find, allowed in product((search.find_between_two, search.find_among_neighbours), is_tried):
        for point in np.flatnonzero(is_candidate).tolist():
            if point in functions:
                continue
            others = is_parent & allowed
            others[point] = False
            if function := find(point, np.flatnonzero(others)):
                functions[point] = function
                is_parent[point] = False
    return {point: each for point, each in functions.items() if is_parent[list(each.parents)].all()}


class _Fit(NamedTuple):
    """Coefficients (N, U) of N regressions, and the distance (N, T) of the target in each frame, NaN where unknown."""

    coefficients: Float[np.ndarray, "N U"]
    misfit_m: Float[np.ndarray, "N T"]


class _FunctionSearch:
    """The search for functions in sampled frames.

    Attributes:
        points: Positions (T, P, 3) in the sampled frames.
        screened: Positions in the frames of the screening.
        limit_m: Largest median distance of a point from its function.
        distance_sd_m: Standard deviations (P, P) of the distances between points.
    """

    def __init__(self, points: Float[np.ndarray, "T P 3"], limit_m: float):
        self.points, self.limit_m = points, limit_m
        self.screened = points[sample_evenly(len(points), MAX_SCREENED_FRAMES)]
        self.distance_sd_m = measure_distance_sd(self.screened)

    def find_between_two(self, point: int, others: Int[np.ndarray, " K"]) -> PointFunction | None:
        """Return the function of a point that lies at a fixed ratio between two others."""
        if len(others) > MAX_LINE_CANDIDATES:
            others = others[np.argsort(self.distance_sd_m[point, others])[:MAX_LINE_CANDIDATES]]
        before, after = (others[index] for index in np.triu_indices(len(others), 1))
        seen = np.flatnonzero(~np.isnan(self.points[:, point, 0]))
        if len(seen) < MIN_COMMON_FRAMES:
            return None
        screened = self.points[seen[sample_evenly(len(seen), MAX_LINE_FRAMES)]]
        first, step = screened[:, before], screened[:, after] - screened[:, before]
        own = screened[:, point, None] - first
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = (own * step).sum(-1) / (step * step).sum(-1)
        weight = np.nan_to_num(compute_known_median(ratio), posinf=np.nan)
        misfit = compute_known_median(np.linalg.norm(own - weight[:, None] * step, axis=-1))
        near = np.flatnonzero((misfit < EXACT_SCREENING_LIMITS * self.limit_m) & (weight > 0) & (weight < 1))
        for n in near[np.argsort(misfit[near])].tolist():
            if function := self._fit_mean(point, (int(before[n]), int(after[n]))):
                return function
        return None

    def find_among_neighbours(self, point: int, others: Int[np.ndarray, " K"]) -> PointFunction | None:
        """Return the function of a point that is a mean of its neighbours or has a place in a frame that they span."""
        is_known = np.isfinite(self.distance_sd_m[point, others])
        near = others[is_known][np.argsort(self.distance_sd_m[point, others[is_known]])][:MAX_PARENT_CANDIDATES].tolist()
        if len(near) < 3:
            return None
        group = [point, *near]
        seen = np.flatnonzero(~np.any(np.isnan(self.points[:, group, 0]), axis=1))
        if len(seen) < MIN_COMMON_FRAMES:
            return None
        screened = self._remove_faulty_frames(self.points[seen[sample_evenly(len(seen), MAX_SCREENED_FRAMES)]], group)
        rough = self._fit_as_mean(screened, point, tuple(near))
        is_near = compute_known_median(rough.misfit_m[0]) < EXACT_SCREENING_LIMITS * self.limit_m
        if is_near and (function := self._fit_mean(point, tuple(near))):
            return function
        candidates = _list_corners(len(near))
        is_used = np.any(candidates != 0, axis=1)
        near_sd_m = self.distance_sd_m[np.ix_(near, near)]
        least_sd_m = np.where(is_used[:, :, None] & is_used[:, None], near_sd_m, np.inf).min((1, 2))
        candidates = candidates[least_sd_m > MIN_PARENT_VARIATION * self.limit_m]
        if not len(candidates):
            return None
        corners = np.einsum("ncp,tpx->ntcx", candidates, screened[:, near])
        own = screened[:, point] - corners[:, :, 0]
        misfit = compute_known_median(self._regress(own, _build_screening_basis(corners), SCREENING_ROUNDS).misfit_m.T)
        if misfit.min() > SCREENING_MISFIT_M + self.limit_m:
            return None
        frames = np.einsum("acd,ndp->nacp", FRAME_ARRANGEMENTS, candidates).reshape(-1, 3, len(near))
        fit = self._fit_in_frames(screened, point, tuple(near), frames, SCREENING_ROUNDS)
        misfit = compute_known_median(fit.misfit_m.T)
        for n in np.argsort(misfit)[:MAX_FULL_FITS].tolist():
            is_near = misfit[n] < EXACT_SCREENING_LIMITS * self.limit_m
            if is_near and (function := self._fit_place(point, tuple(near), frames[n])):
                return function
        return None

    def _remove_faulty_frames(self, points: Float[np.ndarray, "T P 3"], group: Sequence[int]) -> Float[np.ndarray, "T P 3"]:
        """Return positions without the frames in which steady distances within a group are far from the usual ones."""
        own = points[:, group]
        distance = np.linalg.norm(own[:, :, None] - own[:, None], axis=-1)
        deviation = np.abs(distance - compute_known_median(distance))
        sd_m = self.distance_sd_m[np.ix_(group, group)]
        limit_m = np.where(sd_m < MAX_STEADY_SD_M, MAX_STEADY_DEVIATION_M, np.inf)
        return np.where(np.any(deviation > limit_m, axis=(1, 2))[:, None, None], np.nan, points)

    def _fit_mean(self, point: int, parents: tuple[int, ...]) -> PointFunction | None:
        """Return a point as a weighted mean of others, if it is one; parents without weight are left out."""
        sound = self._remove_faulty_frames(self.points, [point, *parents])
        fit = self._fit_as_mean(sound, point, parents)
        if not self._holds(fit.misfit_m[0]):
            return None
        weights = np.r_[1 - fit.coefficients[0].sum(), fit.coefficients[0]]
        used = np.flatnonzero(np.abs(weights) > NEGLIGIBLE_WEIGHT)
        if len(used) < len(parents):
            return self._fit_mean(point, tuple(parents[i] for i in used)) if len(used) > 1 else None
        # Of several points that follow from each other, that one is computed which lies between the others.
        if weights.min() < 0 or not self._vary(parents):
            return None
        return PointFunction(parents, weights, np.zeros(3))

    def _fit_as_mean(self, points: Float[np.ndarray, "T P 3"], point: int, parents: tuple[int, ...]) -> _Fit:
        """Fit the weights of all parents but the first."""
        own = points[:, list(parents)]
        basis = (own[:, 1:] - own[:, :1]).swapaxes(-1, -2)
        return self._regress((points[:, point] - own[:, 0])[None], basis[None], REWEIGHTING_ROUNDS)

    def _fit_place(self, point: int, near: tuple[int, ...], corner_weights: Float[np.ndarray, "3 n"]) -> PointFunction | None:
        """Return a point as one with a fixed place in a frame with the given corners, if it is one."""
        used = np.flatnonzero(corner_weights.any(0))
        parents, corner_weights = tuple(near[i] for i in used), corner_weights[:, used]
        sound = self._remove_faulty_frames(self.points, [point, *parents])
        fit = self._fit_in_frames(sound, point, parents, corner_weights[None], REWEIGHTING_ROUNDS)
        if not self._holds(fit.misfit_m[0]) or not self._vary(parents):
            return None
        second, third, *offset = fit.coefficients[0].tolist()
        weights = np.array([1 - second - third, second, third]) @ corner_weights
        is_mean, is_copy = np.abs(offset).max() < NEGLIGIBLE_OFFSET_M, np.abs(weights - 1).min() < NEGLIGIBLE_WEIGHT
        if is_mean and (is_copy or weights.min() < -NEGLIGIBLE_WEIGHT):
            return None  # of a copy either may be the original, and a parent follows from its mean and the other parents
        return PointFunction(parents, weights, np.array(offset), corner_weights=corner_weights)

    def _fit_in_frames(
        self,
        points: Float[np.ndarray, "T P 3"],
        point: int,
        parents: tuple[int, ...],
        corner_weights: Float[np.ndarray, "N 3 n"],
        rounds: int,
    ) -> _Fit:
        """Fit the place of a point in N frames that its parents span: weights of the second and third corner, and an offset."""
        corners = np.einsum("ncp,tpx->ntcx", corner_weights, points[:, list(parents)])
        relative = (corners[:, :, 1:] - corners[:, :, :1]).swapaxes(-1, -2)
        basis = np.concatenate([relative, build_frame_axes(corners).swapaxes(-1, -2)], axis=-1)
        return self._regress(points[:, point] - corners[:, :, 0], basis, rounds)

    def _regress(self, target: Float[np.ndarray, "N T 3"], basis: Float[np.ndarray, "N T 3 U"], rounds: int) -> _Fit:
        """Fit targets as combinations of vectors, with little weight for the frames that do not agree with the others.

        Coefficients have a prior with the standard deviation 1 (a weight of 1, or an offset of one metre).
        """
        is_known = ~(np.any(np.isnan(target), axis=-1) | np.any(np.isnan(basis), axis=(-1, -2)))
        target, basis = np.where(is_known[..., None], target, 0.0), np.where(is_known[..., None, None], basis, 0.0)
        count = basis.shape[-1]
        rows = basis.reshape(len(basis), -1, count)
        weight = np.ones(is_known.shape)
        coefficients, misfit = np.zeros((len(target), count)), np.zeros(is_known.shape)
        for _ in range(rounds):
            weighted = (basis * weight[..., None, None]).reshape(rows.shape).swapaxes(1, 2)
            normal = weighted @ rows + self.limit_m**2 * np.eye(count)
            coefficients = np.linalg.solve(normal, weighted @ target.reshape(len(target), -1, 1))[..., 0]
            misfit = np.linalg.norm(target - (rows @ coefficients[..., None]).reshape(target.shape), axis=-1)
            weight = self.limit_m / np.maximum(misfit, self.limit_m)
        return _Fit(coefficients, np.where(is_known, misfit, np.nan))

    def _holds(self, misfit_m: Float[np.ndarray, " T"]) -> bool:
        """Return whether a function gives the position of its point."""
        known = misfit_m[~np.isnan(misfit_m)]
        if len(known) < max(MIN_COMMON_FRAMES, MIN_COMMON_FRAME_FRACTION * len(misfit_m)):
            return False
        is_valid = known <= VALID_FRAME_LIMITS * self.limit_m
        return bool(np.median(known) <= self.limit_m and is_valid.mean() >= MIN_VALID_FRACTION)

    def _vary(self, parents: tuple[int, ...]) -> bool:
        """Return whether the distances between parents vary far more than a function may miss its point."""
        sd_m = measure_distance_sd(self.points[:, list(parents)])
        sd_m = sd_m[np.isfinite(sd_m)]
        return len(sd_m) > 0 and bool(np.min(sd_m) > MIN_PARENT_VARIATION * self.limit_m)


# Which mean of the three corners is the origin, the end of the first axis, and a further point of the plane.
FRAME_ARRANGEMENTS = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
        [[0.5, 0.5, 0], [0, 0, 1], [1, 0, 0]],
        [[0.5, 0, 0.5], [0, 1, 0], [1, 0, 0]],
        [[0, 0.5, 0.5], [1, 0, 0], [0, 1, 0]],
    ]
)


@cache
def _list_corners(count: int) -> Float[np.ndarray, "N 3 count"]:
    """List the corners of frames among some points: three of them, or two and the midpoint of two others."""
    unit = np.eye(count)
    triples = [unit[list(three)] for three in combinations(range(count), 3)]
    for pair in combinations(range(count), 2):
        for ends in combinations([i for i in range(count) if i not in pair], 2):
            triples.append(np.array([unit[ends[0]], unit[ends[1]], (unit[pair[0]] + unit[pair[1]]) / 2]))  # noqa: PERF401
    return np.array(triples)


def _build_screening_basis(corners: Float[np.ndarray, "N T 3 3"]) -> Float[np.ndarray, "N T 3 5"]:
    """Return vectors that span the places in all frames with the same corners, if the frames deform little."""
    first, second = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    axes, others = build_frame_axes(corners), build_frame_axes(corners[:, :, [0, 2, 1]])
    return np.stack([first, second, axes[:, :, 0], others[:, :, 0], axes[:, :, 2]], axis=-1)
