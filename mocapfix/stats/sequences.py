"""Statistics of sequences: runs, evenly spaced samples, rows that differ most, cheapest and smoothest paths, resolution."""

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.kernels.small_matrices import solve_banded
from mocapfix.kernels.viterbi import find_cheapest_states as find_cheapest_states


def find_runs(mask: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """Return the runs of True in `mask` as (first, last) indices, both inclusive."""
    padded = np.zeros(len(mask) + 2, bool)
    padded[1:-1] = mask
    edges: list[int] = np.flatnonzero(padded[1:] != padded[:-1]).tolist()
    return [(a, b - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def slide_windows(values: Shaped[np.ndarray, "T ..."], length: int) -> Shaped[np.ndarray, "T ... length"]:
    """Return the `length` (odd) values about each value; beyond the ends these stay (`scipy.ndimage` is slow to import)."""
    padded = np.pad(values, [(length // 2, length // 2), *[(0, 0)] * (values.ndim - 1)], mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, length, axis=0)


def smooth_values(values: Float[np.ndarray, "T ..."], sd: float, reach_sd: float = 4.0) -> Float[np.ndarray, "T ..."]:
    """Return averages of a sequence by weights of a normal distribution of `sd` samples, as far as `reach_sd` times this."""
    reach = int(reach_sd * sd + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sd) ** 2)
    return slide_windows(values, 2 * reach + 1) @ (weights / weights.sum())


DENSE_TRAINING_MARGIN_S = 0.6  # beside a gap; within it training frames are dense
TRAINING_STEP_S = 1 / 30  # between training frames within the margin
MAX_TRAINING_FRAMES = 200


def sample_evenly(count: int, max_count: int) -> Int[np.ndarray, " N"]:
    """Return at most `max_count` of the indices 0..count - 1, rising and evenly spaced; all of them if there are no more."""
    if count <= max_count:
        return np.arange(count)
    indices = (np.arange(max_count) * ((count - 1) / max(max_count - 1, 1))).astype(int)
    indices[1:][-1:] = count - 1  # whatever the rounding
    return indices


def group_gaps(missing: Bool[np.ndarray, "T J"]) -> dict[tuple[int, int], Int[np.ndarray, " lost"]]:
    """Return, for each gap (first, last), the columns of `missing` (T, J) that have exactly this gap."""
    columns: dict[tuple[int, int], list[int]] = {}
    for j in np.flatnonzero(missing.any(axis=0)):
        for gap in find_runs(missing[:, j]):
            columns.setdefault(gap, []).append(int(j))
    return {gap: np.array(lost) for gap, lost in columns.items()}


def select_training_frames(is_known: Bool[np.ndarray, " T"], first: int, last: int, rate: float) -> Int[np.ndarray, " N"]:
    """Return indices, rising, of the frames to train on for a gap first..last.

    These are the frames `is_known` (T,) within the dense margin beside the gap, one each training step, and others evenly
    spaced, up to the largest number of training frames.
    """
    frames = np.flatnonzero(is_known)
    distance = np.where(frames < first, first - 1 - frames, frames - last - 1)  # frames from the gap's edge
    step = max(1, round(TRAINING_STEP_S * rate))
    in_margin = distance < DENSE_TRAINING_MARGIN_S * rate
    near, far = frames[in_margin & (distance % step == 0)], frames[~in_margin]
    count = min(MAX_TRAINING_FRAMES - len(near), len(far))
    spaced = far[sample_evenly(len(far), count)] if count > 0 else far[:0]
    return np.sort(np.r_[near, spaced])


def select_farthest_rows(values: Float[np.ndarray, "N D"], count: int, first: int | None = None, apart: int = 1) -> list[int]:
    """Return the indices of rows that differ most: a first one, then each that is farthest from those before it.

    Args:
        count: At least one is returned, and at most N are different.
        first: The first one, by default the one nearest to the mean.
        apart: Least difference of two indices, as far as possible.
    """
    chosen = [int(np.linalg.norm(values - values.mean(0), axis=1).argmin()) if first is None else first]
    nearest = np.full(len(values), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(values - values[chosen[-1]], axis=1))
        # never selected again, even if all other distances are 0
        nearest[max(chosen[-1] - apart + 1, 0) : chosen[-1] + apart] = -1.0
        chosen.append(int(nearest.argmax()))
    return chosen


FOUND_COST_SHARE = 0.95  # share of the largest cost below which a point counts as assigned


def assign_points(costs: Float[np.ndarray, "V K"], max_cost: float) -> tuple[Int[np.ndarray, " V"], Float[np.ndarray, " N"]]:
    """Assign points one-to-one to places (Kuhn 1955); those that cost about `max_cost` or more stay alone, and count with it.

    Returns the place of each point, -1 for none, and the costs of the points or places, whichever are fewer.
    """
    capped = np.minimum(costs, max_cost)
    rows, columns = scipy.optimize.linear_sum_assignment(capped)
    found, indices = capped[rows, columns], np.full(len(costs), -1)
    is_near = found < FOUND_COST_SHARE * max_cost
    indices[rows[is_near]] = columns[is_near]
    return indices, found


def compute_known_medians(values: Float[np.ndarray, "T ..."]) -> Float[np.ndarray, "..."]:
    """Return what `np.nanmedian` does over the first axis, which takes ten times as long for few values and warns of NaN."""
    ordered = np.sort(values, axis=0)  # NaN sorts last
    count = np.asarray((~np.isnan(ordered)).sum(0))
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2])
    return np.asarray(np.take_along_axis(ordered, middle, axis=0).mean(0))


FLOAT32_RESOLUTION = 2.0**-23  # relative resolution of the 32-bit floats in which files store coordinates
MAX_SAMPLED_STEPS = 50_000  # number of steps, evenly spread, from which a common divisor of the coordinates is estimated
STEP_QUANTILES = (2e-4, 2e-3, 1e-2)  # quantiles of the steps that may equal the common divisor once
# Fraction of the steps that must be close to a multiple of the divisor (by chance: one in five), and how close, as a part of it.
MIN_MULTIPLE_FRACTION = 0.9
MULTIPLE_TOLERANCE = 0.1


def estimate_resolution(markers: Float[np.ndarray, "T M 3"]) -> float:
    """Estimate the smallest difference in metres that the coordinates of the markers resolve.

    A file of integers stores multiples of its scale, and so does a file that was converted from one, whatever its header says.
    """
    resolution = compute_float_resolution(markers)
    steps = np.abs(np.diff(markers, axis=0)).ravel()
    steps = steps[steps > resolution]
    if len(steps) == 0:
        return resolution
    steps = steps[np.linspace(0, len(steps) - 1, min(MAX_SAMPLED_STEPS, len(steps))).astype(int)]
    for divisor in np.quantile(steps, STEP_QUANTILES):
        remainder = np.abs(steps / divisor - np.rint(steps / divisor))
        if (remainder < MULTIPLE_TOLERANCE).mean() > MIN_MULTIPLE_FRACTION:
            return float(divisor)
    return resolution


def compute_float_resolution(markers: Float[np.ndarray, "T M 3"]) -> float:
    """Compute the resolution in metres of a 32-bit float at the largest coordinate of the markers."""
    return FLOAT32_RESOLUTION * float(np.nanmax(np.abs(markers), initial=0.0))


MAX_SAMPLE_VARIANCE = 1e4  # rad^2 or m^2, of a frame without information; more would make the system singular
# Largest stiffness of a smooth path relative to what the samples tell about a straight line: more would make the system
# numerically singular, at thousands of frames a second. Such a path is straight already.
MAX_STIFFNESS_RATIO = 1e13


def smooth_path(
    path: Float[np.ndarray, "T C"], variance: Float[np.ndarray, " T"], acceleration_power: Float[np.ndarray, " T"], rate: float
) -> Float[np.ndarray, "T C"]:
    """Return the x that minimises sum |x_t - path_t|^2 / variance_t + integral |x''|^2 / power.

    Args:
        variance: Per component.
        acceleration_power: In squared units of the path / s^3.
    """
    if len(path) < 3:
        return path
    information = 1 / np.minimum(variance, MAX_SAMPLE_VARIANCE)
    places = np.linspace(-1, 1, len(path))
    line = np.stack([np.full(len(path), len(path) ** -0.5), places / np.linalg.norm(places)])
    least = np.linalg.eigvalsh((line * information) @ line.T)[0]  # what the samples tell about a straight line
    stiffness = np.minimum(rate**3 / acceleration_power[1:-1], MAX_STIFFNESS_RATIO * max(least, 0.0))
    return minimise_acceleration(information[:, None, None], (information[:, None] * path)[:, None], stiffness)[:, 0]


def interpolate_rows(
    rows: Float[np.ndarray, "N ..."], frames: Int[np.ndarray, " N"], wanted: Int[np.ndarray, " T"]
) -> Float[np.ndarray, "T ..."]:
    """Return the rows of wanted frames, linearly interpolated between those of other frames, which rise."""
    place = np.interp(wanted, frames, np.arange(len(frames)))
    below, above, share = np.floor(place).astype(int), np.ceil(place).astype(int), place % 1
    return rows[below] + share.reshape(-1, *[1] * (rows.ndim - 1)) * (rows[above] - rows[below])


def average_windows(values: Float[np.ndarray, "T ..."], window: int) -> Float[np.ndarray, "T ..."]:
    """Return the means over the samples in windows about each sample; the first and the last one continue beyond the ends."""
    parts = [np.zeros_like(values[:1]), *[values[:1]] * (window // 2), values, *[values[-1:]] * ((window - 1) // 2)]
    sums = np.cumsum(np.concatenate(parts), axis=0)
    return (sums[window:] - sums[:-window]) / window


def minimise_acceleration(
    curvature: Float[np.ndarray, "T M M"],
    pull: Float[np.ndarray, "T M *R"],
    stiffness: float | Float[np.ndarray, " inner"],
    speed_weight: float | Float[np.ndarray, "steps M"] = 0.0,
) -> Float[np.ndarray, "T M *R"]:
    """Return the path x of M coordinates that minimises a quadratic cost of its places, its steps and its second differences.

    The cost is half of sum x_t A_t x_t - 2 b_t x_t + sum w_t (x_t+1 - x_t)^2 + sum k_t |x_t-1 - 2 x_t + x_t+1|^2. Its matrix is
    banded: a frame is coupled to the two before it.

    Args:
        curvature: A, symmetric.
        pull: b, for each of R paths of their own, or of one.
        stiffness: k, of the second difference about each frame but the first and the last.
        speed_weight: w, of the step from each frame to the next.
    """
    frames, size = pull.shape[:2]
    if not frames:
        return pull
    band = np.zeros((2 * size + 1, frames, size))  # row 2 M - d has the elements that are d above the diagonal
    for above in range(size):
        band[-1 - above, :, above:] = np.diagonal(curvature, above, 1, 2)
    steps, inner = frames - 1, max(frames - 2, 0)
    bend = np.reshape(stiffness, (-1, 1))
    for frame, coefficient in enumerate((1.0, -2.0, 1.0)):
        band[-1, frame : frame + inner] += coefficient**2 * bend
    for frame in (0, 1):
        band[-1, frame : frame + steps] += speed_weight
        band[size, 1 + frame : 1 + frame + inner] -= 2.0 * bend
    band[size, 1:] -= speed_weight
    band[0, 2:] += bend
    path = np.array(pull, float, order="C")
    solve_banded(band.reshape(len(band), -1), path.reshape(frames * size, -1))
    return path
