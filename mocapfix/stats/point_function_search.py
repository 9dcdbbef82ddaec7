"""Find points that are exact functions of other points: midpoints, weighted means, and places in a frame that three points span.

Programs compute joint centres and virtual markers from markers, to the last digit. A measured marker has noise of its own and
moves on the skin, so no function of others gives its position to a hundredth of a millimetre. The opposite is not true of
markers whose mutual distances are exact as well, as in takes that a program has solved. So a point is a function of its parents
only if their distances vary far more than its position misses the function.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, product

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.kernels.function_screening import measure_pair_sds, screen_mean, screen_pairs, screen_places
from mocapfix.stats.point_functions import MIN_FRAME_SINE, PointFunction, build_frame_axes
from mocapfix.stats.sequences import sample_evenly

# Numbers of frames, evenly spread: in which points are compared, and by which it is decided what is worth comparing.
MAX_FUNCTION_FRAMES = 240
MAX_SCREENED_FRAMES = 20
MAX_COMPARED_PAIRS = 2_000_000  # of more than 1,400 points, each is compared with those that are nearest to it
# Fraction of the frames in which a point and its parents must be visible, and number of them.
MIN_COMMON_FRAME_FRACTION = 0.2
MIN_COMMON_FRAMES = 10
# Largest median distance of a point from its function, in multiples of the resolution, and the least such limit in metres.
MAX_MISFIT_RESOLUTIONS = 3.0
MIN_MISFIT_LIMIT_M = 2e-6
EXACT_SCREENING_LIMITS = 5.0  # largest such distance in the screening by functions of the right form, in multiples of that limit
# Number of measured markers with which a point moves that is placed on their segment, and standard deviation of the distances.
MIN_CARRIERS = 3
MAX_CARRIER_SD_M = 0.002
SCREENED_CARRIER_SD_M = 0.004  # in the frames of the screening
MAX_EXACT_RESOLUTION_M = 5e-6  # coarsest resolution in metres at which exact distances differ from those of a rigid segment
MIN_TRAVEL_M = 0.01  # smallest median deviation of a coordinate in metres of a point that moves


@dataclass(frozen=True)
class PartnerDistances:
    """How steady the distances of each point to others are."""

    partner: Int[np.ndarray, "P K"]  # indices (P, K) of the points, rising, with which each of P points is compared
    # Robust standard deviations of the distances; infinite where two are rarely seen together and for one and itself.
    sd_m: Float[np.ndarray, "P K"]

    def get_group_sd(self, points: Float[np.ndarray, "T P 3"], group: Sequence[int] | Int[np.ndarray, " n"]) -> np.ndarray:
        """Return the standard deviations (n, n) within a group of the compared `points`."""
        if self.partner.shape[1] == len(self.partner):
            return self.sd_m[np.array(group)[:, None], group]
        return measure_distance_sd(points[:, group])


def compare_points(points: Float[np.ndarray, "T P 3"]) -> PartnerDistances:
    """Compare each point with all others or, of many points, with those that are nearest to it in its median position."""
    count = points.shape[1]
    if count * (count - 1) <= MAX_COMPARED_PAIRS:
        return PartnerDistances(np.broadcast_to(np.arange(count), (count, count)), measure_distance_sd(points))
    centre = compute_known_median(points)
    seen = np.flatnonzero(np.isfinite(centre[:, 0]))
    near = min(len(seen), MAX_COMPARED_PAIRS // count)
    partner = np.tile(np.arange(near), (count, 1))  # of points that are never seen: any
    partner[seen] = np.sort(seen[scipy.spatial.KDTree(centre[seen]).query(centre[seen], near)[1].reshape(-1, near)], axis=1)
    rows = np.repeat(np.arange(count), near)
    sd_m = measure_pair_distance_sd(points, rows, partner.ravel()).reshape(count, near)
    return PartnerDistances(partner, np.where(partner == np.arange(count)[:, None], np.inf, sd_m))


def find_exactly_rigid_points(
    points: Float[np.ndarray, "T P 3"], resolution_m: float, partners: PartnerDistances | None = None
) -> Bool[np.ndarray, " P"]:
    """Find the points that keep their distances to each other exactly, as the landmarks do that a program places on a segment.

    They are no parents of a function if they move with three or more other points. All are false if they are the majority: then
    the whole take was solved, and its markers are all alike.

    Args:
        resolution_m: Smallest difference that the coordinates resolve.
        partners: The points in few frames, compared by `compare_points`, by which pairs are screened.
    """
    is_visible = ~np.isnan(points[..., 0]).all(0)
    if resolution_m > MAX_EXACT_RESOLUTION_M or len(points) < MIN_COMMON_FRAMES:
        return np.zeros_like(is_visible)
    sampled = points[sample_evenly(len(points), MAX_FUNCTION_FRAMES)]
    partners = partners or compare_points(sampled[sample_evenly(len(sampled), MAX_SCREENED_FRAMES)])
    limit_m = max(MAX_MISFIT_RESOLUTIONS * resolution_m, MIN_MISFIT_LIMIT_M)
    is_exact = np.zeros_like(is_visible)
    row, column = np.nonzero(partners.sd_m <= EXACT_SCREENING_LIMITS * limit_m)
    one, other = row, partners.partner[row, column]
    exact_pair = measure_pair_distance_sd(sampled, one, other) <= limit_m
    is_exact[one[exact_pair]] = is_exact[other[exact_pair]] = True
    if not is_exact.any() or 2 * is_exact.sum() > is_visible.sum():
        return np.zeros_like(is_visible)
    row, column = np.nonzero(is_exact[:, None] & ~is_exact[partners.partner] & (partners.sd_m < SCREENED_CARRIER_SD_M))
    is_carrier = measure_pair_distance_sd(sampled, row, partners.partner[row, column]) < MAX_CARRIER_SD_M
    has_carriers = np.bincount(row[is_carrier], minlength=len(is_exact)) >= MIN_CARRIERS
    travel_m = compute_known_median(np.abs(sampled - compute_known_median(sampled))).max(1)
    return is_exact & has_carriers & np.isfinite(travel_m) & (travel_m > MIN_TRAVEL_M)


def measure_distance_sd(points: Float[np.ndarray, "T P 3"]) -> Float[np.ndarray, "P P"]:
    """Return a robust standard deviation of the distances between points; infinite where they are rarely seen together."""
    one, other = np.triu_indices(points.shape[1], 1)
    sd_m = np.full((points.shape[1], points.shape[1]), np.inf)
    sd_m[one, other] = sd_m[other, one] = measure_pair_distance_sd(points, one, other)
    return sd_m


def measure_pair_distance_sd(
    points: Float[np.ndarray, "T P 3"], one: Int[np.ndarray, " N"], other: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Return what `measure_distance_sd` does, for N pairs of points."""
    min_count = max(2, int(np.ceil(MIN_COMMON_FRAME_FRACTION * len(points))))
    return measure_pair_sds(np.ascontiguousarray(points.transpose(2, 1, 0), float), one, other, min_count)


def compute_known_median(values: Shaped[np.ndarray, "T ..."]) -> Shaped[np.ndarray, "..."]:
    """Return the medians over the first axis without NaN; infinite where nothing is known."""
    ordered = np.sort(values, axis=0)  # NaN sorts last
    count = (~np.isnan(ordered)).sum(0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.where(count > 0, middle, np.inf)


MAX_LINE_FRAMES = 5  # number of frames, evenly spread, that decide which points between two are worth a comparison in more frames
SCREENING_MISFIT_M = 2e-3  # largest such distance in the screening, in addition to that limit
# Smallest standard deviation of a distance between parents, in multiples of that limit, and the same in the screening.
MIN_PARENT_VARIATION = 10.0
SCREENED_PARENT_VARIATION = 5.0
# Fraction of the frames in which a function must hold, to within a multiple of the limit: parents and points may have faults.
MIN_VALID_FRACTION = 0.8
VALID_FRAME_LIMITS = 5.0
MAX_PARENT_CANDIDATES = 5  # number of the neighbours with the steadiest distances among which parents are searched
MAX_LINE_CANDIDATES = 60  # number of the same among which two points are searched between which a point lies
# Standard deviation of a steady distance, and its largest deviation in a frame without faults, both in metres.
MAX_STEADY_SD_M = 0.005
MAX_STEADY_DEVIATION_M = 0.04
# Number of rounds of reweighting, by which a fit ignores frames with faults.
REWEIGHTING_ROUNDS = 6
SCREENING_ROUNDS = 2
NEGLIGIBLE_WEIGHT = 1e-3  # a smaller weight is none
NEGLIGIBLE_OFFSET_M = 1e-4  # a shorter offset, in metres, is none
MAX_FULL_FITS = 8  # number of functions of one kind that are fitted to one point after the screening
# Number of fits that may fail in one search, after which what is left is not searched. Of the public takes none has more than
# 6; each takes about a millisecond.
MAX_FAILED_FITS = 300


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
    is_exact = find_exactly_rigid_points(points, resolution_m, search.partners)
    is_tried = [~is_exact, np.ones_like(is_exact)] if is_exact.any() else [~is_exact]
    for find, allowed in product((search.find_between_two, search.find_among_neighbours), is_tried):
        for point in np.flatnonzero(is_candidate).tolist():
            if point in functions or search.failed_fits >= MAX_FAILED_FITS:
                continue
            if function := find(point, is_parent & allowed):
                functions[point] = function
                is_parent[point] = False
    return {point: each for point, each in functions.items() if is_parent[list(each.parents)].all()}


class _FunctionSearch:
    """The search for functions in sampled frames.

    Attributes:
        points: Positions (T, P, 3) in the sampled frames.
        limit_m: Largest median distance of a point from its function.
        partners: The points compared in the frames of the screening.
        failed_fits: Number of functions that passed the screening and do not hold.
    """

    def __init__(self, points: Float[np.ndarray, "T P 3"], limit_m: float):
        self.points, self.limit_m, self.failed_fits = points, limit_m, 0
        self.screened = points[sample_evenly(len(points), MAX_SCREENED_FRAMES)]
        self.partners = compare_points(self.screened)

    def find_between_two(self, point: int, is_parent: Bool[np.ndarray, " P"]) -> PointFunction | None:
        """Return the function of a point that lies at a fixed ratio between two others."""
        others = self._list_others(point, is_parent, MAX_LINE_CANDIDATES, is_known=False)
        seen = np.flatnonzero(~np.isnan(self.points[:, point, 0]))
        if len(seen) < MIN_COMMON_FRAMES or len(others) < 2:
            return None
        pairs, misfit = self._screen_pairs(point, seen[sample_evenly(len(seen), MAX_LINE_FRAMES)], others)
        if not len(misfit):
            return None
        others = others[np.unique(pairs)]
        pairs, misfit = self._screen_pairs(point, seen[sample_evenly(len(seen), MAX_SCREENED_FRAMES)], others)
        sd_m = self.partners.get_group_sd(self.screened, others)[tuple(pairs)]
        varies = sd_m > SCREENED_PARENT_VARIATION * self.limit_m
        for one, other in pairs[:, varies][:, np.argsort(misfit[varies], kind="stable")[:MAX_FULL_FITS]].T:
            if function := self._fit_mean(point, (int(others[one]), int(others[other]))):
                return function
            self.failed_fits += 1
        return None

    def _screen_pairs(
        self, point: int, frames: Int[np.ndarray, " F"], others: Int[np.ndarray, " K"]
    ) -> tuple[Int[np.ndarray, "2 N"], Float[np.ndarray, " N"]]:
        """Return the pairs of other points between which a point is in some frames, and its median distance from their lines."""
        candidates = np.ascontiguousarray(self.points[frames[:, None], others].swapaxes(0, 1))
        limit_m = EXACT_SCREENING_LIMITS * self.limit_m
        misfit = screen_pairs(self.points[frames, point], candidates, limit_m, NEGLIGIBLE_WEIGHT / 2)
        pairs = np.array(np.nonzero(np.isfinite(misfit)))
        return pairs, misfit[tuple(pairs)]

    def find_among_neighbours(self, point: int, is_parent: Bool[np.ndarray, " P"]) -> PointFunction | None:
        """Return the function of a point that is a mean of its neighbours or has a place in a frame that they span."""
        others = self._list_others(point, is_parent, 2 * MAX_PARENT_CANDIDATES, is_known=True)
        distance_m = compute_known_median(np.linalg.norm(self.screened[:, others] - self.screened[:, [point]], axis=-1))
        near: list[int] = others[distance_m > self.limit_m][:MAX_PARENT_CANDIDATES].tolist()  # without copies of the point
        if len(near) < 3:
            return None
        group = [point, *near]
        seen = np.flatnonzero(~np.any(np.isnan(self.points[:, group, 0]), axis=1))
        if len(seen) < MIN_COMMON_FRAMES:
            return None
        frames = seen[sample_evenly(len(seen), MAX_SCREENED_FRAMES)]
        screened = self._select_sound(group, frames)
        own, others = np.ascontiguousarray(screened[:, 0]), np.ascontiguousarray(screened[:, 1:])
        if screen_mean(own, others, self.limit_m, REWEIGHTING_ROUNDS) < EXACT_SCREENING_LIMITS * self.limit_m:
            if function := self._fit_mean(point, tuple(near)):
                return function
            self.failed_fits += 1
        candidates = _list_corners(len(near))
        is_used = np.any(candidates != 0, axis=1)
        near_sd_m = self.partners.get_group_sd(self.screened, near)
        least_sd_m = np.where(is_used[:, :, None] & is_used[:, None], near_sd_m, np.inf).min((1, 2))
        candidates = candidates[least_sd_m > MIN_PARENT_VARIATION * self.limit_m]
        if not len(candidates):
            return None
        misfit = screen_places(own, others, candidates, True, MIN_FRAME_SINE, self.limit_m, SCREENING_ROUNDS)
        candidates = candidates[misfit <= SCREENING_MISFIT_M + self.limit_m]
        if not len(candidates):
            return None
        frames = np.einsum("acd,ndp->nacp", FRAME_ARRANGEMENTS, candidates).reshape(-1, 3, len(near))
        misfit = screen_places(own, others, frames, False, MIN_FRAME_SINE, self.limit_m, SCREENING_ROUNDS)
        for n in np.argsort(misfit, kind="stable")[:MAX_FULL_FITS].tolist():
            if misfit[n] >= EXACT_SCREENING_LIMITS * self.limit_m:
                break
            if function := self._fit_place(point, tuple(near), frames[n]):
                return function
            self.failed_fits += 1
        return None

    def _list_others(
        self, point: int, is_parent: Bool[np.ndarray, " P"], max_count: int, *, is_known: bool
    ) -> Int[np.ndarray, " K"]:
        """Return the possible parents of a point: all, by their indices, or those with the steadiest distances, these first.

        Args:
            is_parent: Which points may be parents.
            is_known: Only those whose distances are known, and these first even if they are no more than that.
        """
        partner, sd_m = self.partners.partner[point], self.partners.sd_m[point]
        is_other = is_parent[partner] & (partner != point)
        if is_known:
            is_other &= np.isfinite(sd_m)
        others, sd_m = partner[is_other], sd_m[is_other]
        if len(others) > max_count:
            kept = sd_m <= np.partition(sd_m, max_count - 1)[max_count - 1]
            others, sd_m = others[kept], sd_m[kept]
        elif not is_known:
            return others
        return others[np.argsort(sd_m, kind="stable")[:max_count]]

    def _select_sound(
        self, group: Sequence[int], frames: Int[np.ndarray, " F"] | slice = slice(None)
    ) -> Float[np.ndarray, "F n 3"]:
        """Return the positions of a group of points, NaN in frames in which its steady distances are far from the usual ones."""
        own = self.points[frames][:, group]
        distance = np.linalg.norm(own[:, :, None] - own[:, None], axis=-1)
        deviation = np.abs(distance - compute_known_median(distance))
        sd_m = self.partners.get_group_sd(self.screened, group)
        limit_m = np.where(sd_m < MAX_STEADY_SD_M, MAX_STEADY_DEVIATION_M, np.inf)
        return np.where(np.any(deviation > limit_m, axis=(1, 2))[:, None, None], np.nan, own)

    def _fit_mean(self, point: int, parents: tuple[int, ...]) -> PointFunction | None:
        """Return a point as a weighted mean of others, if it is one; parents without weight are left out."""
        if len(parents) == 2 and not self._vary(parents):
            return None
        sound = self._select_sound([point, *parents])
        own, first = sound[:, :1], sound[:, 1:2]
        # the weights of all parents but the first
        basis = (sound[:, 2:] - first).swapaxes(-1, -2)
        coefficients, misfit_m = self._regress((own - first)[:, 0], basis)
        if not self._holds(misfit_m):
            return None
        weights = np.r_[1 - coefficients.sum(), coefficients]
        used = np.flatnonzero(np.abs(weights) > NEGLIGIBLE_WEIGHT)
        if len(used) < len(parents):
            return self._fit_mean(point, tuple(parents[i] for i in used)) if len(used) > 1 else None
        # Of several points that follow from each other, that one is computed which lies between the others.
        if weights.min() < 0 or not self._vary(parents):
            return None
        return PointFunction(parents, weights, np.zeros(3))

    def _fit_place(self, point: int, near: tuple[int, ...], corner_weights: Float[np.ndarray, "3 n"]) -> PointFunction | None:
        """Return a point as one with a fixed place in a frame with the given corners, if it is one."""
        used = np.flatnonzero(corner_weights.any(0))
        parents, corner_weights = tuple(near[i] for i in used), corner_weights[:, used]
        if not self._vary(parents):
            return None
        sound = self._select_sound([point, *parents])
        # the weights of the second and third corner, and an offset
        corners = np.einsum("cp,tpx->tcx", corner_weights, sound[:, 1:])
        relative = (corners[:, 1:] - corners[:, :1]).swapaxes(-1, -2)
        basis = np.concatenate([relative, build_frame_axes(corners).swapaxes(-1, -2)], axis=-1)
        coefficients, misfit_m = self._regress(sound[:, 0] - corners[:, 0], basis)
        if not self._holds(misfit_m):
            return None
        second, third, *offset = coefficients.tolist()
        weights = np.array([1 - second - third, second, third]) @ corner_weights
        is_mean, is_copy = np.abs(offset).max() < NEGLIGIBLE_OFFSET_M, np.abs(weights - 1).min() < NEGLIGIBLE_WEIGHT
        if is_mean and (is_copy or weights.min() < -NEGLIGIBLE_WEIGHT):
            return None  # of a copy either may be the original, and a parent follows from its mean and the other parents
        return PointFunction(parents, weights, np.array(offset), corner_weights=corner_weights)

    def _regress(self, target: Float[np.ndarray, "T 3"], basis: Float[np.ndarray, "T 3 U"]) -> tuple[np.ndarray, np.ndarray]:
        """Fit a target as a combination of vectors, with little weight for the frames that do not agree with the others.

        Coefficients have a prior with the standard deviation 1 (a weight of 1, or an offset of one metre).
        """
        is_known = ~(np.any(np.isnan(target), axis=-1) | np.any(np.isnan(basis), axis=(-1, -2)))
        target, basis = np.where(is_known[:, None], target, 0.0), np.where(is_known[:, None, None], basis, 0.0)
        count = basis.shape[-1]
        rows, weight = basis.reshape(-1, count), np.ones(len(target))
        coefficients, misfit = np.zeros(count), np.zeros(len(target))
        for _ in range(REWEIGHTING_ROUNDS):
            weighted = (basis * weight[:, None, None]).reshape(rows.shape).T
            coefficients = np.linalg.solve(weighted @ rows + self.limit_m**2 * np.eye(count), weighted @ target.ravel())
            misfit = np.linalg.norm(target - (rows @ coefficients).reshape(target.shape), axis=-1)
            weight = self.limit_m / np.maximum(misfit, self.limit_m)
        return coefficients, np.where(is_known, misfit, np.nan)

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
