"""Detection on the trajectories of 3-D keypoints: exchanged sides, outliers and noise, in place of the detectors of markers.

A keypoint is a program's estimate in one frame, with an error of one or a few centimetres that changes from frame to frame.
What the detectors of markers compare with millimetres would be found everywhere. A smooth trajectory, of the acceleration that
the point itself shows, has an error of a few millimetres; samples far from it are outliers, and weigh less (iteratively
reweighted least squares).

Detectors confuse the sides of people. Each pair of mirrored points is judged by itself: in frames that show both, they are
straight or exchanged, and the cheapest sequence of these states is found exactly (Viterbi's algorithm). A step costs the
squared distances, in variances of noise and motion, between the samples that it takes to be of one point. A state costs the
deviation of the distance to the nearest joint of the same side from its usual length: joints are judged from the trunk
outwards. Being exchanged costs a little at all times, so that the smaller part of a take is the exchanged one.
"""

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.detect import gaps
from mocapfix.hands.finger_markers import SIDES, find_finger_markers
from mocapfix.labels.label_swaps import undo_label_exchanges
from mocapfix.model.changes import compute_editable_mask
from mocapfix.model.detected import Detected
from mocapfix.model.faults import Fault, FaultKind, FaultReview, Faults
from mocapfix.model.marker_set import LIMB_JOINT_NAMES, MarkerSet
from mocapfix.model.skeleton import BODY_SECTIONS, list_path, load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.solve.smoothing import MIN_ACCELERATION_POWER, MIN_POWER_SHARE, average_acceleration_power
from mocapfix.stats.sequences import MAX_SAMPLE_VARIANCE, find_cheapest_states, find_runs, smooth_path

THIRD_DIFFERENCE_VARIANCE = 20.0  # variance of the third difference of white noise, relative to that of the noise
CHI_SQUARED_1_MEDIAN = 0.455  # median of the square of a standard normal variable
MIN_NOISE_SD_M = 1e-4  # smallest noise that is estimated: positions in files are rounded
# Steps of the second difference from which the acceleration is estimated, and the window of its mean.
KEYPOINT_ACCELERATION_STEP_S = 0.1
KEYPOINT_POWER_WINDOW_S = 1.0
MIN_SMOOTHED_SAMPLES = 20  # fewer measured samples are not smoothed
MAX_JOINED_GAP_S = 1.0  # a gap in which the trajectory is smoothed separately on both sides
# Distance from the trajectory, in standard deviations per axis, beyond which a sample has less weight, and is an outlier.
MIN_DOWNWEIGHTED_DISTANCE_SD = 3.0
MIN_KEYPOINT_OUTLIER_SD = 5.0
# Smallest standard deviation with which an outlier is compared, relative to that of the set: a filtered file has little noise.
MIN_OUTLIER_NOISE_RATIO = 0.5
SMOOTHING_ROUNDS = 5


def estimate_noise_sd(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, " M"]:
    """Return the standard deviation per axis, in metres, of the noise of each point, from its third differences."""
    if len(markers) <= MIN_SMOOTHED_SAMPLES:
        return np.full(markers.shape[1], MIN_NOISE_SD_M)
    square = np.diff(markers, 3, axis=0) ** 2
    noise_sd_m = np.full(markers.shape[1], MIN_NOISE_SD_M)
    for m in range(markers.shape[1]):
        known = square[~np.isnan(square[:, m, 0]), m]
        if len(known) >= MIN_SMOOTHED_SAMPLES:
            variance = np.median(known, axis=0).mean() / CHI_SQUARED_1_MEDIAN / THIRD_DIFFERENCE_VARIANCE
            noise_sd_m[m] = max(MIN_NOISE_SD_M, float(np.sqrt(variance)))
    return noise_sd_m


def smooth_point(
    path: Float[np.ndarray, "T 3"], noise_sd_m: float, rate: float, point_sd_m: float
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
    """Return the trajectory of one keypoint without noise, NaN where it was not measured, and the samples far away from it.

    Args:
        noise_sd_m: Standard deviation of the noise per axis.
        point_sd_m: Standard deviation per axis that the marker set states.
    """
    is_known, smooth, is_outlier = ~np.isnan(path[:, 0]), path.copy(), np.zeros(len(path), bool)
    is_joined = is_known.copy()
    for first, last in find_runs(~is_known):
        is_joined[first : last + 1] = first > 0 and last < len(path) - 1 and last - first + 1 <= MAX_JOINED_GAP_S * rate
    for first, last in find_runs(is_joined):
        frames = slice(first, last + 1)
        if is_known[frames].sum() >= MIN_SMOOTHED_SAMPLES:
            smooth[frames], is_outlier[frames] = _smooth_run(path[frames], is_known[frames], noise_sd_m, rate, point_sd_m)
    smooth[~is_known] = np.nan
    return smooth, is_outlier & is_known


def _smooth_run(
    path: Float[np.ndarray, "T 3"], is_known: Bool[np.ndarray, " T"], noise_sd_m: float, rate: float, point_sd_m: float
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
    """Return the smooth path of one run, and its outliers."""
    measured, frames, weight = np.nan_to_num(path), np.arange(len(path)), np.ones(len(path))
    compared_sd_m = max(noise_sd_m, MIN_OUTLIER_NOISE_RATIO * point_sd_m)
    smooth = np.stack([np.interp(frames, frames[is_known], path[is_known, axis]) for axis in range(3)], axis=-1)
    noise_variance, distance_sd = noise_sd_m**2, np.zeros(len(path))
    for round_number in range(SMOOTHING_ROUNDS):
        is_sound = is_known & (weight > MIN_DOWNWEIGHTED_DISTANCE_SD / MIN_KEYPOINT_OUTLIER_SD)
        power = _estimate_power(smooth, is_sound, rate, noise_variance if round_number == 0 else 0.0)
        variance = np.where(is_known, noise_variance / weight**2, MAX_SAMPLE_VARIANCE)
        smooth = smooth_path(measured, variance, power, rate)
        distance_sd = np.where(is_known, np.linalg.norm(measured - smooth, axis=1), 0.0) / compared_sd_m
        weight = np.minimum(1.0, MIN_DOWNWEIGHTED_DISTANCE_SD / np.maximum(distance_sd, MIN_DOWNWEIGHTED_DISTANCE_SD))
        weight = np.where(distance_sd > MIN_KEYPOINT_OUTLIER_SD, weight**2, weight)
    return smooth, distance_sd > MIN_KEYPOINT_OUTLIER_SD


def _estimate_power(
    path: Float[np.ndarray, "T 3"], is_sound: Bool[np.ndarray, " T"], rate: float, noise_variance: float
) -> Float[np.ndarray, " T"]:
    """Return the power of the random acceleration of a path about each frame, less what noise contributes.

    The second difference of an integrated random acceleration over steps of h has the variance 2/3 power h^3, that of noise 6
    times its own.
    """
    h = max(1, round(KEYPOINT_ACCELERATION_STEP_S * rate))
    if len(path) < 4 * h:
        return np.ones(len(path))
    is_used = is_sound[2 * h :] & is_sound[h:-h] & is_sound[: -2 * h]
    if not is_used.any():
        return np.ones(len(path))
    window = max(1, round(KEYPOINT_POWER_WINDOW_S * rate))
    usable, power, _ = average_acceleration_power(path, is_used, rate, h, window, 1 / window)
    power = np.maximum(power - 6 * noise_variance / (2 / 3 * (h / rate) ** 3), 0.0)
    smallest = max(MIN_ACCELERATION_POWER, MIN_POWER_SHARE * float(power.mean()))
    return np.maximum(np.interp(np.arange(len(path)), usable + h, power), smallest)


KEYPOINT_SPEED_SD_M_PER_S = 1.5  # standard deviation per axis of the speed of a keypoint between frames
MAX_STEP_COST = 40.0  # largest cost of a step: an outlier says nothing about the sides
EXCHANGED_COST_PER_S = 10.0  # cost of being exchanged for a second: without evidence, labels are assumed to be correct
STATE_CHANGE_COST = 4.0  # cost of a change between straight and exchanged
# Smallest distance between the points of a pair, median over the take, in standard deviations of the noise: nearer ones, as the
# eyes, change places within their noise.
MIN_SEPARATION_SD = 6.0
MAX_SEGMENT_DEVIATION_M = 0.03  # of the distance of two joints (median) at which they are ends of one segment
SEGMENT_LENGTH_SD_M = 0.02  # standard deviation of the length of a segment between keypoints, besides their noise
MAX_LENGTH_COST = 8.0  # largest cost of the length of a segment in a frame
HAND_CENTRE_SD_M = 0.02  # standard deviation per axis of the mean of the points of a hand that a detector finds
MAX_MIRROR_MISFIT_M = 1e-9  # between a point's place and its twin's mirrored place


def detect_keypoint_swaps(take: Take, marker_set: MarkerSet, noise_sd_m: Float[np.ndarray, " M"]) -> list[Fault]:
    """Detect exchanged left and right keypoints; `noise_sd_m` per axis of the noise of each point.

    Hands with fingers are judged as a whole, by the means of their points and the wrists of the body.
    """
    faults, hands = list[Fault](), find_hand_columns(take, marker_set)
    names, columns = load_cmu31_body().skeleton.names, marker_set.find_columns(take.labels)
    section_of_joint = {joint: section for section, joints in BODY_SECTIONS.items() for joint in joints}
    section_of_column = {int(column): section_of_joint[names[j]] for column, j in zip(columns, marker_set.joints, strict=True)}
    markers, judged = take.markers.copy(), list[tuple[int, int]]()
    for left, right in (pair for pair in find_mirrored_columns(take, marker_set) if not np.isin(pair, hands).any()):
        sd_m = float(max(noise_sd_m[left], noise_sd_m[right], marker_set.point_sd / 2))
        separation_m = np.linalg.norm(markers[:, left] - markers[:, right], axis=-1)
        if np.isnan(separation_m).all() or np.nanmedian(separation_m) < MIN_SEPARATION_SD * sd_m:
            continue
        length_cost = np.zeros(len(markers))
        if section_of_column[left] in LIMB_JOINT_NAMES:
            length_cost = compute_length_cost(markers, (left, right), judged, sd_m)
        is_exchanged = find_exchanged_frames(markers[:, left], markers[:, right], sd_m, take.rate, length_cost)
        faults += [_build_swap_fault(take, left, right, first, last) for first, last in find_runs(is_exchanged)]
        exchanged = markers[is_exchanged, left].copy()
        markers[is_exchanged, left] = markers[is_exchanged, right]
        markers[is_exchanged, right] = exchanged
        if section_of_column[left] != "head":
            judged.append((left, right))
    if not hands:
        return faults
    own = markers[:, np.array(hands).T]
    with np.errstate(invalid="ignore"):  # frames without a hand
        left, right = (np.nansum(own, axis=2) / (~np.isnan(own)).sum(2)).swapaxes(0, 1)
    with_hands = np.concatenate([markers, left[:, None], right[:, None]], axis=1)
    length_cost = compute_length_cost(with_hands, (-2, -1), judged, HAND_CENTRE_SD_M)
    is_exchanged = find_exchanged_frames(left, right, HAND_CENTRE_SD_M, take.rate, length_cost)
    return [*faults, *(_build_swap_fault(take, *pair, *run) for run in find_runs(is_exchanged) for pair in hands)]


def find_hand_columns(take: Take, marker_set: MarkerSet) -> list[tuple[int, int]]:
    """Return the columns in the take of each pair of points of hands, the left one first; none if fingers of one are shown."""
    hands = find_finger_markers(marker_set.name, take.labels)
    columns = [dict(zip(each.markers.labels, each.columns.tolist(), strict=True)) for each in hands]
    twins = {label: label.replace("left", "right", 1) for label in columns[0]} if len(hands) == len(SIDES) else {}
    return [(columns[0][label], columns[1][twin]) for label, twin in twins.items() if twin in columns[1]]


def compute_length_cost(
    markers: Float[np.ndarray, "T M 3"], pair: tuple[int, int], judged: list[tuple[int, int]], noise_sd_m: float
) -> Float[np.ndarray, " T"]:
    """Return the cost of the exchanged state of a pair less that of the straight one, by the lengths of segments.

    Args:
        judged: Pairs of points whose sides are corrected already; the one at the steadiest distance is used.
    """
    cost, least_deviation_m = np.zeros(len(markers)), MAX_SEGMENT_DEVIATION_M
    for other in judged:
        straight = [np.linalg.norm(markers[:, a] - markers[:, b], axis=-1) for a, b in zip(pair, other, strict=True)]
        known = np.concatenate([each[~np.isnan(each)] for each in straight])
        if not len(known):
            continue
        length = float(np.median(known))
        deviation_m = float(np.median(np.abs(known - length)))
        if deviation_m >= least_deviation_m:
            continue
        crossed = [np.linalg.norm(markers[:, a] - markers[:, b], axis=-1) for a, b in zip(pair, other[::-1], strict=True)]
        variance = 2 * noise_sd_m**2 + SEGMENT_LENGTH_SD_M**2
        deviations = np.stack([*crossed, *straight]) - length
        costs = np.minimum(np.nan_to_num(deviations**2 / (2 * variance)), MAX_LENGTH_COST)
        cost, least_deviation_m = costs[:2].sum(axis=0) - costs[2:].sum(axis=0), deviation_m
    return cost


def find_mirrored_columns(take: Take, marker_set: MarkerSet) -> list[tuple[int, int]]:
    """Return the columns in the take of each pair of points with mirrored places, the left one first, from the trunk outwards."""
    skeleton, columns = load_cmu31_body().skeleton, marker_set.find_columns(take.labels).tolist()
    names, offsets = [skeleton.names[joint] for joint in marker_set.joints], marker_set.marker_offsets
    pairs = dict[int, int]()  # left of right, among the set's points: of two at one place, one each
    for left, (name, offset) in enumerate(zip(names, offsets, strict=True)):
        is_left = name.startswith("Left") or (not name.startswith("Right") and offset[0] > 0)
        misfit = np.abs(offset * [-1, 1, 1] - offsets).max(1)
        is_twin = [is_left and other == name.replace("Left", "Right") for other in names] & (misfit <= MAX_MIRROR_MISFIT_M)
        if free := [right for right in np.flatnonzero(is_twin).tolist() if right not in pairs]:
            pairs[free[0]] = left
    depths = {left: len(list_path(int(marker_set.joints[left]), -1, skeleton.parents)) for left in pairs.values()}
    shown = [(left, right) for right, left in pairs.items() if columns[left] >= 0 and columns[right] >= 0]
    return [(columns[left], columns[right]) for left, right in sorted(shown, key=lambda pair: depths[pair[0]])]


def find_exchanged_frames(
    left: Float[np.ndarray, "T 3"],
    right: Float[np.ndarray, "T 3"],
    noise_sd_m: float,
    rate: float,
    length_cost: Float[np.ndarray, " T"],
) -> Bool[np.ndarray, " T"]:
    """Return the frames with exchanged samples of two points; `length_cost` of exchanged less straight, by other points."""
    is_exchanged = np.zeros(len(left), bool)
    frames = np.flatnonzero(~np.isnan(left[:, 0]) & ~np.isnan(right[:, 0]))
    if len(frames) < 2:
        return is_exchanged
    elapsed_s = np.diff(frames) / rate
    variance = 2 * noise_sd_m**2 + (KEYPOINT_SPEED_SD_M_PER_S * elapsed_s) ** 2
    a, b = left[frames], right[frames]

    def compute_step_cost(after: np.ndarray, before: np.ndarray) -> Float[np.ndarray, " N"]:
        return np.minimum(((after[1:] - before[:-1]) ** 2).sum(axis=1) / (2 * variance), MAX_STEP_COST)

    same = compute_step_cost(a, a) + compute_step_cost(b, b)
    crossed = compute_step_cost(a, b) + compute_step_cost(b, a) + STATE_CHANGE_COST
    step_cost = np.stack([np.stack([same, crossed], axis=-1), np.stack([crossed, same], axis=-1)], axis=-1)
    state_cost = np.zeros((len(frames), 2))
    state_cost[:, 1] = EXCHANGED_COST_PER_S / rate + length_cost[frames]
    is_exchanged[frames] = find_cheapest_states(step_cost, state_cost) == 1
    return _add_single_samples(left, right, is_exchanged, noise_sd_m, rate, length_cost)


def _add_single_samples(
    left: Float[np.ndarray, "T 3"],
    right: Float[np.ndarray, "T 3"],
    is_exchanged: Bool[np.ndarray, " T"],
    sd_m: float,
    rate: float,
    length_cost: Float[np.ndarray, " T"],
) -> Bool[np.ndarray, " T"]:
    """Return the exchanged frames with those that show one of the two points only, where the other one is expected."""
    swap = is_exchanged[:, None]
    true_left, true_right = np.where(swap, right, left), np.where(swap, left, right)
    frames, is_exchanged = np.arange(len(left)), is_exchanged.copy()
    is_paired = ~np.isnan(left[:, 0]) & ~np.isnan(right[:, 0])
    known = np.flatnonzero(is_paired)
    paths = [np.stack([np.interp(frames, known, path[known, axis]) for axis in range(3)], -1) for path in (true_left, true_right)]
    after = known[np.minimum(np.searchsorted(known, frames), len(known) - 1)]
    before = known[np.maximum(np.searchsorted(known, frames, side="right") - 1, 0)]
    elapsed_s = np.minimum(np.abs(after - frames), np.abs(frames - before)) / rate
    variance = 2 * sd_m**2 + (KEYPOINT_SPEED_SD_M_PER_S * elapsed_s) ** 2
    for own, expected, other in ((left, paths[0], paths[1]), (right, paths[1], paths[0])):
        alone = np.flatnonzero(~is_paired & ~np.isnan(own[:, 0]))
        gain = ((own[alone] - expected[alone]) ** 2).sum(axis=1) - ((own[alone] - other[alone]) ** 2).sum(axis=1)
        is_exchanged[alone[gain / (2 * variance[alone]) - length_cost[alone] > 2 * STATE_CHANGE_COST]] = True
    return is_exchanged


def _build_swap_fault(take: Take, left: int, right: int, first: int, last: int) -> Fault:
    frames = slice(first, last + 1)
    distance_m = np.linalg.norm(take.markers[frames, left] - take.markers[frames, right], axis=-1)
    severity = float(np.nanmedian(distance_m)) if np.isfinite(distance_m).any() else float("nan")
    count, labels = last - first + 1, take.bare_labels
    time = f"{count / take.rate:.2f} s ({count} frame{'s' * (count > 1)})"
    reason = f"{labels[left]} and {labels[right]} are exchanged for {time}: each continues the path of the other."
    return Fault("swap", left, first, last, severity, reason, 1.0, (right,))


KEYPOINT_NOTE = (
    "The points are keypoints, not markers: the body was fitted to their smooth paths, less {noise_mm:.0f} mm of noise per axis "
    "(median over the points)."
)


def detect_on_keypoints(take: Take, marker_set: MarkerSet, review: FaultReview, options: CleanOptions) -> Detected:
    """Correct exchanged sides, find outliers, and remove the noise of a take."""
    is_editable, noise_sd_m = compute_editable_mask(take, options.fill), estimate_noise_sd(take.markers)
    swaps = review.select(detect_keypoint_swaps(take, marker_set, noise_sd_m))
    take = undo_label_exchanges(take, swaps)
    markers = take.markers.copy()
    outliers: list[Fault] = []
    for m in range(len(take.labels)):
        path, is_outlier = smooth_point(take.markers[:, m], float(noise_sd_m[m]), take.rate, marker_set.point_sd)
        found = [
            _build_outlier_fault(take, m, first, last, path, options.detect.max_spike_duration_s)
            for first, last in find_runs(is_outlier)
        ]
        outliers += review.select(found)
        is_smoothed = is_editable[:, m] & take.measured[:, m] & ~is_outlier
        markers[is_smoothed, m] = path[is_smoothed]
    take = take.replace_markers(markers)
    missing = review.select([*gaps.detect_gaps(take), *gaps.detect_lost_segments(take, marker_set)])
    faults = Faults().add_faults([*missing, *outliers])
    note = KEYPOINT_NOTE.format(noise_mm=float(np.median(noise_sd_m)) * 1e3)
    return Detected(take, tuple(swaps), faults, notes=(note,))


def _build_outlier_fault(take: Take, marker: int, first: int, last: int, path: np.ndarray, max_spike_duration_s: float) -> Fault:
    distance_m = float(np.linalg.norm(take.markers[first : last + 1, marker] - path[first : last + 1], axis=-1).max())
    count = last - first + 1
    kind: FaultKind = "spike" if count <= max(1, max_spike_duration_s * take.rate) else "ghost"
    where = f"{take.bare_labels[marker]} lies {distance_m * 1e3:.0f} mm off its path"
    reason = f"{where} for {count} frame{'s' * (count > 1)}, more than its noise explains."
    return Fault(kind, marker, first, last, distance_m, reason)
