"""Noise, jitter and spikes: deviations of a marker from its smooth path that its neighbours do not share.

A strike, a landing or a whirled limb bends the paths of all markers of a segment at once, and where the solved body is wrong,
the whole limb lies off it. A fault of the samples concerns one marker. So a deviation that several neighbours have in the same
direction is motion, or an error of the body. So is one in which a segment turns: its markers deviate in different directions
and keep their distances.

The noise of a sample is its deviation from the cubic through its four neighbours. That removes almost all of a body's motion.
The median over the take ignores spikes, bursts and gaps; the median over the shortest burst that counts ignores single samples.

A spike is a few samples that lie off the path, after which the marker returns to it. The path is the cheapest chain through the
marker's samples. Each bend of the chain that is sharper than a body's costs up to 1, the maximum, so that a permanent jump (two
swapped labels) remains affordable. Keeping an excursion costs three or four bends; omitting its samples costs less. The
cheapest chain is found exactly, by dynamic programming over the pairs of samples kept last (Viterbi's algorithm; the cost of a
bend is Blake and Zisserman's truncated quadratic). Hence neither a dense burst of spikes nor a gap next to one misleads it, as
they do local means and medians. An omitted sample is a spike only if it lies far from a local fit to the kept samples.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.viterbi import find_cheapest_chain
from mocapfix.model.faults import Fault, build_fault_mask
from mocapfix.model.take import Take
from mocapfix.stats.marker_distances import estimate_distances
from mocapfix.stats.sequences import find_runs, slide_windows

Result = TypeVar("Result")


class RoundMemory:
    """Results that were computed from the samples of one take, each with the samples that were used."""

    def __init__(self) -> None:
        self._results: dict[Hashable, tuple[np.ndarray, object]] = {}

    def recall(
        self, key: Hashable, is_used: Bool[np.ndarray, "T M"], compute: Callable[[int], Result], *, can_appear: bool = True
    ) -> list[Result]:
        """Return the result of each marker under `key`. It is computed unless it is known from the same samples.

        Args:
            key: Names the computation and everything else that the result depends on.
            compute: Computes the result of a marker from these samples. It must not depend on what is not named.
            can_appear: Whether fewer samples may give a result where more give none.
        """
        for marker, samples in enumerate(np.packbits(is_used, axis=0).T):
            known, result = self._results.get((key, marker), (None, None))
            is_none_left = known is not None and not (can_appear or result or (samples & ~known).any())
            if known is None or not (is_none_left or np.array_equal(samples, known)):
                self._results[key, marker] = samples.copy(), compute(marker)
        return [self._results[key, marker][1] for marker in range(is_used.shape[1])]  # pyright: ignore[reportReturnType]

    def recall_whole(self, key: Hashable, is_used: Bool[np.ndarray, "T M"], compute: Callable[[], Result]) -> Result:
        """Return the result of all markers together under `key`. It is computed unless it is known from the same samples."""
        known, result = self._results.get(key, (None, None))
        if known is None or not np.array_equal(known, is_used):
            known, result = self._results[key] = is_used, compute()
        return result  # pyright: ignore[reportReturnType]

    def find_partners(self, take: Take) -> Int[np.ndarray, "M K"]:
        """Find the markers with the steadiest distances to each marker, -1 where there are fewer."""
        return self.recall_whole("partners", take.visible, lambda: estimate_distances(take.markers).partner)


MIN_SHARED_COSINE = 0.8  # smallest cosine of the angle between two deviations that are alike
# Smallest and largest length of a neighbour's deviation, relative to the marker's own, of deviations that are alike.
MIN_SHARED_LENGTH_RATIO = 0.25
MAX_SHARED_LENGTH_RATIO = 4.0
MIN_SHARING_NEIGHBOURS = 2  # number of neighbours with deviations that are alike: a fault of one neighbour may agree by chance
MAX_EQUAL_DIFFERENCE_RATIO = 0.3  # of two deviations that are almost equal, relative to the marker's own deviation
MIN_COMPARED_NEIGHBOURS = 3  # with fewer neighbours visible, one with an almost equal deviation is sufficient
MAX_RIGID_CHANGE_M = 0.0015  # largest change of the distances between the markers of a rigid segment that is struck, in metres
MAX_EXPLAINING_NEIGHBOURS = 4  # number of neighbours by which the noise of a marker is explained
MIN_EXPLAINING_FRACTION = 0.8  # smallest fraction of the frames in which such a neighbour is visible


def find_shared_deviations(own: Float[np.ndarray, "N 3"], neighbours: Float[np.ndarray, "N K 3"]) -> Bool[np.ndarray, " N"]:
    """Find the deviations of a marker that its neighbours, NaN where unknown, share; in metres, at the same times."""
    own_length, length = np.linalg.norm(own, axis=-1)[:, None], np.linalg.norm(neighbours, axis=-1)
    product = np.einsum("nx,nkx->nk", own, neighbours)
    is_similar = (
        (product > MIN_SHARED_COSINE * own_length * length)
        & (length > MIN_SHARED_LENGTH_RATIO * own_length)
        & (length < MAX_SHARED_LENGTH_RATIO * own_length)
    )
    is_equal = np.linalg.norm(neighbours - own[:, None], axis=-1) < MAX_EQUAL_DIFFERENCE_RATIO * own_length
    has_few_neighbours = (~np.isnan(length)).sum(1) < MIN_COMPARED_NEIGHBOURS
    return (is_similar.sum(1) >= MIN_SHARING_NEIGHBOURS) | (has_few_neighbours & is_equal.any(1))


def find_rigid_deviations(
    own: Float[np.ndarray, "N 3 3"], neighbours: Float[np.ndarray, "N 3 K 3"], fraction: Float[np.ndarray, " N"]
) -> Bool[np.ndarray, " N"]:
    """Find the deviations of a marker in which a rigid segment moves with it: a struck hand turns as well.

    The markers of a turning segment deviate in different directions and keep their distances. That a neighbour deviates as well
    and three markers keep their distances is no coincidence of faults.

    Args:
        own: Positions of the marker in metres: before, at and after each deviation.
        neighbours: Positions of K neighbours in metres at the same times, NaN where missing.
        fraction: The time of the deviation as a fraction of the time from before to after.
    """
    own_length = np.linalg.norm(_measure_bend(own, fraction), axis=-1)
    length = np.linalg.norm(_measure_bend(neighbours, fraction), axis=-1)
    is_moved = length > MIN_SHARED_LENGTH_RATIO * own_length[:, None]
    distance = np.linalg.norm(neighbours - own[:, :, None], axis=-1)
    is_kept = np.abs(_measure_bend(distance, fraction)) < MAX_RIGID_CHANGE_M
    mutual = np.linalg.norm(neighbours[:, :, :, None] - neighbours[:, :, None], axis=-1)
    is_pair_kept = np.abs(_measure_bend(mutual, fraction)) < MAX_RIGID_CHANGE_M
    is_other = ~np.eye(neighbours.shape[2], dtype=bool)
    is_triangle = is_other & is_pair_kept & is_kept[:, :, None] & is_kept[:, None] & (is_moved[:, :, None] | is_moved[:, None])
    return np.any(is_triangle, axis=(1, 2))


def _measure_bend(values: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Return the difference (N, ...) of middle values from those interpolated between the first and the last (N, 3, ...)."""
    first, middle, last = values[:, 0], values[:, 1], values[:, 2]
    share = fraction.reshape(len(values), *[1] * (first.ndim - 1))
    return middle - (1 - share) * first - share * last


def compute_weighted_deviations(
    markers: Float[np.ndarray, "T M 3"],
    frames: Int[np.ndarray, " N"],
    fitted_frames: Int[np.ndarray, "N S"],
    weight: Float[np.ndarray, "N S"],
) -> Float[np.ndarray, "N M 3"]:
    """Return the deviations (m) of markers in some frames from means of their positions in S other frames, with weights of the
    sum 1; NaN where a sample with a weight is missing.
    """
    is_used = weight != 0
    around = np.where(is_used[..., None, None], markers[fitted_frames], 0.0)
    return markers[frames] - np.einsum("ns,nsmx->nmx", weight, around)


def remove_shared_noise(own: Float[np.ndarray, "N 3"], neighbours: Float[np.ndarray, "N K 3"]) -> Float[np.ndarray, "N 3"]:
    """Remove from a marker's residuals what is proportional to those of its neighbours (least squares).

    Those of the neighbours, in metres, come from the steadiest first, and are NaN where unknown.
    """
    is_known = ~np.isnan(neighbours[..., 0])
    columns = np.flatnonzero(is_known.mean(0) >= MIN_EXPLAINING_FRACTION)[:MAX_EXPLAINING_NEIGHBOURS]
    basis = np.nan_to_num(neighbours[:, columns]).transpose(0, 2, 1).reshape(own.size, len(columns))
    gain = np.linalg.lstsq(basis, own.ravel(), rcond=None)[0]
    return own - (basis @ gain).reshape(own.shape)


NEIGHBOUR_OFFSETS = (-2, -1, 1, 2)  # the neighbours of a sample through which the cubic goes
NEIGHBOUR_WEIGHTS = (-1 / 6, 2 / 3, 2 / 3, -1 / 6)  # of the neighbours in the cubic's value, where none is missing
MAX_STEP_VARIATION = 0.01  # samples whose times are this regular, relative to the time of a step, have no gap among them
MIN_NOISE_SAMPLES = 11  # number of samples from which a noise level is estimated: one outlier affects five of them
MEDIAN_NORM_SD = 1.538  # median norm of a vector of three independent standard normal numbers
# Smallest noise level of a noisy marker, relative to the median of the other markers and absolute.
MIN_NOISE_RATIO = 5.0
MIN_NOISE_M = 0.001
MIN_JITTER_RATIO = 6.0  # smallest noise in a burst of jitter, in multiples of the median over the take
MIN_JITTER_DURATION_S = 0.1  # duration of the shortest burst
MAX_BURST_PAUSE_S = 0.025  # between a burst and spikes that belong to it; measured in composed takes of training people
THIRD_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])  # the first of four samples relative to the parabola through the others
CUBIC_RESIDUAL_M_PER_S2 = 30.0  # part of a body's motion that the cubic may leave. It matters at low frame rates only.


def detect_noise(take: Take, memory: RoundMemory | None = None) -> list[Fault]:
    """Detect the markers that are much noisier than the others.

    Returns:
        One fault for each marker, from its first to its last visible frame. Its severity is the noise level in metres.
    """
    levels_m = estimate_noise_levels(take, memory)
    faults: list[Fault] = []
    for m in np.flatnonzero(levels_m > MIN_NOISE_M):
        others = np.delete(levels_m, m)
        usual_m = float(np.nanmedian(others)) if np.isfinite(others).any() else np.inf
        if levels_m[m] > MIN_NOISE_RATIO * usual_m:
            first, *_, last = np.flatnonzero(take.visible[:, m])
            level = f"has noise of {levels_m[m] * 1e3:.1f} mm throughout; the other markers have {usual_m * 1e3:.1f} mm."
            reason = f"{take.bare_labels[m]} {level}"
            faults.append(Fault("noise", int(m), int(first), int(last), float(levels_m[m]), reason))
    return faults


def estimate_noise_levels(take: Take, memory: RoundMemory | None = None) -> Float[np.ndarray, " M"]:
    """Estimate the standard deviation per axis, in metres, of each marker's noise; NaN if the marker is hardly visible."""
    usual_m = (memory or RoundMemory()).recall(
        "usual residual", take.visible, lambda m: _measure_noise(take, m, take.visible[:, m], np.inf)[0]
    )
    return np.array(usual_m) / MEDIAN_NORM_SD


def compute_cubic_residuals(times_s: Float[np.ndarray, " N"], points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Compute the distance in metres of each of at least 5 samples from the cubic through its neighbours.

    The cubic is evaluated with Lagrange weights at the samples' own times. The residual is scaled so that white noise keeps
    its standard deviation. The first and last two samples have their neighbours' residuals.
    """
    count, steps, path = len(times_s) - 4, np.diff(times_s), np.ascontiguousarray(points.T)

    def subtract_neighbours(weights: Sequence[float | np.ndarray], select: slice | np.ndarray) -> np.ndarray:
        residual = path[:, 2:-2][:, select].copy()
        for weight, offset in zip(weights, NEIGHBOUR_OFFSETS, strict=True):
            residual -= weight * path[:, 2 + offset : 2 + offset + count][:, select]
        x, y, z = residual
        return np.sqrt(x * x + y * y + z * z) / np.sqrt(1 + sum(weight**2 for weight in weights))

    residual_m = subtract_neighbours(NEIGHBOUR_WEIGHTS, slice(None))
    around = [steps[k : k + count] for k in range(4)]
    uneven = np.flatnonzero(np.maximum.reduce(around) - np.minimum.reduce(around) >= MAX_STEP_VARIATION * around[0])
    lag = [times_s[uneven + 2 + offset] - times_s[uneven + 2] for offset in NEIGHBOUR_OFFSETS]
    weights = [np.prod([far / (far - near) for far in lag if far is not near], axis=0) for near in lag]
    residual_m[uneven] = subtract_neighbours(weights, uneven)
    return residual_m[np.clip(np.arange(len(times_s)) - 2, 0, count - 1)]


def detect_jitter(
    take: Take,
    is_usable: Bool[np.ndarray, "T M"],
    min_amplitude_m: float,
    memory: RoundMemory | None = None,
    spikes: Sequence[Fault] = (),
) -> list[Fault]:
    """Detect the bursts in which a marker is much noisier than in the rest of the take, with the spikes at their ends.

    Args:
        is_usable: The samples without spikes.
        min_amplitude_m: Smallest noise in a burst, in metres.
        memory: What earlier rounds on the same positions found.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the noise in metres.
    """
    min_noise_m = min_amplitude_m + CUBIC_RESIDUAL_M_PER_S2 / take.rate**2
    faults, memory, is_spike = list[Fault](), memory or RoundMemory(), build_fault_mask(spikes, take.visible.shape)
    noise = memory.recall(("bursts", min_noise_m), is_usable, lambda m: _measure_noise(take, m, is_usable[:, m], min_noise_m))
    memory.recall("usual residual", is_usable, lambda m: noise[m][0])  # for `estimate_noise_levels`
    for m, (label, (usual_m, threshold_m, bursts)) in enumerate(zip(take.bare_labels, noise, strict=True)):
        for burst in bursts:
            partners = memory.find_partners(take)
            if _is_shared_burst(take, is_usable, [m, *partners[m][partners[m] >= 0].tolist()], burst, threshold_m):
                continue
            burst = _extend_burst(burst, take.markers[:, m], is_spike[:, m], MAX_BURST_PAUSE_S * take.rate, threshold_m)
            duration_s = (burst.last - burst.first + 1) / take.rate
            usual = f"its usual noise is {usual_m * 1e3:.1f} mm"
            reason = f"{label} has jitter of {burst.amplitude_m * 1e3:.0f} mm for {duration_s:.2f} s; {usual}."
            faults.append(Fault("jitter", m, burst.first, burst.last, burst.amplitude_m, reason))
    return faults


class _Burst(NamedTuple):
    """A burst of jitter over the frames first..last, inclusive, with its amplitude in metres."""

    first: int
    last: int
    amplitude_m: float


def _extend_burst(burst: _Burst, path: np.ndarray, is_spike: np.ndarray, reach: float, min_deviation_m: float) -> _Burst:
    """Return the burst with spikes (T,) up to `reach` frames farther on, and ends that are off the path (T, 3) in metres."""
    frames = np.union1d(np.flatnonzero(is_spike), np.arange(burst.first, burst.last + 1))
    part = np.cumsum(np.diff(frames, prepend=frames[:1]) > reach + 1)
    first, *_, last = frames[part == part[np.searchsorted(frames, burst.first)]].tolist()
    for _ in range(int(reach)):
        ends = path[max(first - 4, 0) : first][::-1], path[last + 1 : last + 5]
        before, after = (len(end) == 4 and np.linalg.norm(THIRD_DIFFERENCE @ end) > min_deviation_m for end in ends)
        first, last = first - int(before), last + int(after)
    return burst._replace(first=first, last=last)


def _measure_noise(take: Take, marker: int, is_usable: np.ndarray, min_noise_m: float) -> tuple[float, float, tuple[_Burst, ...]]:
    """Return the median noise of a marker in the frames `is_usable` (T,), the smallest of a burst of it, and the bursts."""
    frames = np.flatnonzero(is_usable)
    if len(frames) < MIN_NOISE_SAMPLES:
        return np.nan, np.nan, ()
    residual_m = compute_cubic_residuals(frames / take.rate, take.markers[frames, marker])
    usual_m = float(np.median(residual_m))
    threshold_m, min_frames = max(min_noise_m, MIN_JITTER_RATIO * usual_m), MIN_JITTER_DURATION_S * take.rate
    return usual_m, threshold_m, tuple(_find_bursts(frames, residual_m, threshold_m, min_frames))


def _find_bursts(frames: np.ndarray, residual_m: np.ndarray, min_residual_m: float, min_frames: float) -> Iterator[_Burst]:
    """Find the bursts among samples at `frames` (N,). A gap of `min_frames` or longer ends a burst."""
    if not (residual_m > min_residual_m).any():
        return
    window = max(MIN_NOISE_SAMPLES, round(min_frames)) | 1
    for stretch in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) > min_frames) + 1):
        is_noisy = _is_median_above(residual_m[stretch], window, min_residual_m)
        if not is_noisy.any():
            continue
        median_m = np.median(slide_windows(residual_m[stretch], window), axis=1)
        is_near = np.pad(slide_windows(is_noisy, window).any(1), window // 2)  # a short pause does not end a burst
        is_burst = is_noisy | np.lib.stride_tricks.sliding_window_view(is_near, window).all(1)
        for a, b in find_runs(is_burst):
            first, last = int(frames[stretch[a]]), int(frames[stretch[b]])
            if len(stretch) >= MIN_NOISE_SAMPLES and last - first + 1 >= min_frames:
                yield _Burst(first, last, float(median_m[a : b + 1].max()))


def _is_shared_burst(
    take: Take, is_usable: np.ndarray, markers_compared: list[int], burst: _Burst, min_residual_m: float
) -> bool:
    """Return whether the first marker has the noise of the others. `is_usable` (T, M) are samples without spikes."""
    reach = max(NEIGHBOUR_OFFSETS)
    start, stop = max(burst.first - reach, 0), min(burst.last + reach + 1, take.frame_count)
    usable = is_usable[start:stop, markers_compared, None]
    markers = np.where(usable, take.markers[start:stop, markers_compared], np.nan)
    frames = np.arange(reach, len(markers) - reach)
    around = frames[:, None] + np.array(NEIGHBOUR_OFFSETS)
    residual = compute_weighted_deviations(markers, frames, around, np.tile(NEIGHBOUR_WEIGHTS, (len(frames), 1)))
    residual = residual[~np.isnan(residual[:, 0, 0])]
    if len(residual) < MIN_NOISE_SAMPLES:
        return False
    unexplained_m = np.linalg.norm(remove_shared_noise(residual[:, 0], residual[:, 1:]), axis=-1)
    return bool(np.median(unexplained_m) / np.sqrt(1 + np.square(NEIGHBOUR_WEIGHTS).sum()) < min_residual_m)


def _is_median_above(values: np.ndarray, window: int, threshold: float) -> np.ndarray:
    """Return (N,) whether the median over an odd window around each sample exceeds a threshold, without computing it.

    The first and the last value continue beyond the ends, as those of `median_filter` with the mode "nearest".
    """
    is_above = np.pad(values > threshold, window // 2, mode="edge")
    count = np.r_[0, np.cumsum(is_above)]
    return count[window:] - count[:-window] > window // 2


FIT_NOISE_SD_M = 0.002  # measurement noise of the local fit, per axis
FIT_PRIOR_SD = np.array([10.0, 10.0, 100.0])  # of the local fit: position (m), velocity (m/s), acceleration (m/s2)
FIT_JERK_SD_M_PER_S3 = 5000.0  # jerk by which the path deviates from a parabola
FIT_SAMPLES_PER_SIDE = 3  # number of kept samples on either side to which a parabola is fitted
MIN_SPIKE_DEVIATION_SD = 4.0  # smallest distance of a spike from the fit, in standard deviations of the fit
MAX_BODY_ACCELERATION_M_PER_S2 = 3000.0  # a deviation that needs more is no motion, even if several markers share it


def detect_spikes(take: Take, min_distance_m: float, max_duration_s: float, memory: RoundMemory | None = None) -> list[Fault]:
    """Detect runs of samples more than `min_distance_m` off their path that last at most `max_duration_s`.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the largest distance from the path in metres.
    """
    faults, memory = list[Fault](), memory or RoundMemory()
    excursions = memory.recall(
        ("excursions", min_distance_m, max_duration_s),
        take.visible,
        lambda m: _find_excursions(take, m, min_distance_m, max_duration_s),
    )
    for m, (label, excursion) in enumerate(zip(take.bare_labels, excursions, strict=True)):
        if not len(excursion.frames):
            continue
        partners = memory.find_partners(take)
        is_spike = ~_find_shared_excursions(take, m, excursion, partners[m][partners[m] >= 0])
        distance_m = np.zeros(take.frame_count)
        distance_m[excursion.frames[is_spike]] = np.linalg.norm(excursion.deviation[is_spike], axis=-1)
        for first, last in find_runs(distance_m > 0):
            severity, count = float(distance_m[first : last + 1].max()), last - first + 1
            reason = f"{label} jumps {severity * 1e3:.0f} mm off its path for {count} frame{'s' * (count > 1)} and returns."
            faults.append(Fault("spike", m, first, last, severity, reason))
    return faults


class _Excursions(NamedTuple):
    """The samples of a marker that lie far off its path."""

    frames: np.ndarray  # frame indices (N,)
    deviation: np.ndarray  # deviations (N, 3) in metres from the path
    fitted_frames: np.ndarray  # indices (N, S) of the frames to which the path is fitted locally
    weight: np.ndarray  # weights (N, S) of the positions there, with the sum 1: their weighted mean is the position on the path


def _find_excursions(take: Take, marker: int, min_distance_m: float, max_duration_s: float) -> _Excursions:
    """Find the samples that lie more than `min_distance_m` off the cheapest chain, for at most `max_duration_s`."""
    frames, rate = np.flatnonzero(take.visible[:, marker]), take.rate
    points = np.ascontiguousarray(take.markers[frames, marker])
    is_kept = np.ones(len(frames), bool)
    if len(frames) >= 3:
        is_kept = find_cheapest_chain(frames, points, rate, max(1, round(max_duration_s * rate)))
    kept, omitted = np.flatnonzero(is_kept), np.flatnonzero(~is_kept)
    if not len(omitted):
        return _Excursions(omitted, np.empty((0, 3)), np.empty((0, 0), int), np.empty((0, 0)))
    samples, weight, sd_m = _fit_locally(frames[kept] / rate, frames[omitted] / rate)
    fitted = kept[samples]
    deviation = points[omitted] - np.einsum("ns,nsx->nx", weight, points[fitted])
    is_far = np.linalg.norm(deviation, axis=-1) > np.maximum(min_distance_m, MIN_SPIKE_DEVIATION_SD * sd_m)
    return _Excursions(frames[omitted][is_far], deviation[is_far], frames[fitted[is_far]], weight[is_far])


def _find_shared_excursions(take: Take, marker: int, excursion: _Excursions, partners: np.ndarray) -> np.ndarray:
    """Find (N,) the excursions that the marker's partners share and that a body can make."""
    before = excursion.frames - excursion.fitted_frames[:, FIT_SAMPLES_PER_SIDE - 1]
    after = excursion.fitted_frames[:, FIT_SAMPLES_PER_SIDE] - excursion.frames
    max_distance_m = MAX_BODY_ACCELERATION_M_PER_S2 * np.abs(before * after) / take.rate**2 / 2
    is_possible = np.linalg.norm(excursion.deviation, axis=-1) < max_distance_m
    count, samples = len(excursion.frames), np.concatenate([excursion.frames[:, None], excursion.fitted_frames], axis=1)
    needed, rows = np.unique(samples, return_inverse=True)
    rows = rows.reshape(count, -1)
    neighbours = take.markers[needed[:, None], partners]
    deviation = compute_weighted_deviations(neighbours, rows[:, 0], rows[:, 1:], excursion.weight)
    moments = np.stack([excursion.frames - before, excursion.frames, excursion.frames + after], axis=1)
    fraction = np.where((before > 0) & (after > 0), before / np.maximum(before + after, 1), np.nan)
    is_rigid = find_rigid_deviations(take.markers[moments, marker], take.markers[moments[:, :, None], partners], fraction)
    return is_possible & (find_shared_deviations(excursion.deviation, deviation) | is_rigid)


def _fit_locally(times_s: np.ndarray, query_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit parabolas through the nearest samples of each of N times.

    Return the indices (N, S) of these samples, their weights (N, S) in the fitted position, with the sum 1, and its standard
    deviation (N,) in metres per axis.

    Bayesian least squares: a sample weighs less the farther away in time it is, since a path is close to a parabola only for a
    moment. Where the samples are far away or few, the standard deviation is large and nothing is a spike.
    """
    near = np.searchsorted(times_s, query_s)[:, None] + np.arange(-FIT_SAMPLES_PER_SIDE, FIT_SAMPLES_PER_SIDE)
    exists = (near >= 0) & (near < len(times_s))
    near = near.clip(0, len(times_s) - 1)
    lag = times_s[near] - query_s[:, None]
    precision = exists / (FIT_NOISE_SD_M**2 + (FIT_JERK_SD_M_PER_S3 * lag**3 / 6) ** 2)
    basis = np.stack([np.ones_like(lag), lag, lag**2 / 2], -1)
    covariance = np.linalg.inv(np.einsum("nk,nka,nkb->nab", precision, basis, basis) + np.diag(FIT_PRIOR_SD**-2))
    weight = np.einsum("na,nka,nk->nk", covariance[:, 0], basis, precision)
    # The prior's mean is the position of the first sample that follows.
    weight[:, FIT_SAMPLES_PER_SIDE] += 1 - weight.sum(1)
    return near, weight, np.sqrt(covariance[:, 0, 0])
