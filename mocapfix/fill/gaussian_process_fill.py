"""Filling from the rest of the body: what the take shows of the missing markers at moments alike, and at those around.

A Gaussian over the whole marker set, given the markers seen (Gloersen & Federolf 2016, "Predicting missing marker trajectories
in human motion data using marker intercorrelations", PLoS ONE 11), as a process over the take's moments, which knows time and
what comes again, too (see `kernels.process`). Places are those in the axes that the whole marker set makes, trunk first. How
sure it is, it has tried: stretches as long as the gap are struck out elsewhere, and what it misses there it will miss here.

The numbers of the likeness make the smallest error on lost limbs of captures and of CMU's training subjects.
"""

import numpy as np

from mocapfix.stats.gaussian_process import (
    GaussianProcess,
    StateCovariance,
    fit_gaussian_process,
    group_gaps,
    select_training_frames,
)
from mocapfix.stats.rigid_alignment import align_to_common_shape, transform_to_body_axes

MAX_SETTLED_SD_M = 0.01  # metres: a gap that is known better all through is no matter for so wide a view
MAX_INPUT_SD_M = 0.03  # metres: what another way has filled so surely tells of others as though it were seen
MIN_VISIBLE_SHARE = 0.05  # a marker seen in a smaller part of the frames is hardly known
MIN_PROCESS_TRAINING_FRAMES, MIN_INPUT_MARKERS = (
    8,
    4,
)  # moments to learn from, and markers told, without which there is nothing to go by
MIN_SHARED_FRAME_SHARE = 0.5  # of the moments that show what is lost: with fewer left to learn from, a marker told is no help
MIN_GAP_PIECE_S = 0.1  # seconds: no shorter piece of a gap is asked by itself
FEATURE_MARKER_COUNT = 36  # markers that say together what the units below are made for
MARKER_VELOCITY_HALF_SPAN_S = 0.067  # seconds before and after, over which speeds are measured
MARKER_POSITION_UNIT_M, MARKER_SPEED_UNIT_M_S = (
    0.9,
    20.0,
)  # metres, metres a second: the differences that count as one, all markers taken together
TRUNK_UP_UNIT, TRUNK_HEIGHT_UNIT_M = 0.5, 0.5  # likewise of the up vector; metres
TRUNK_SPEED_UNIT_M_S, TRUNK_SPIN_UNIT_RAD_S = 5.0, 20.0  # metres a second, radians a second, of the trunk
MARKER_FILL_KERNEL = StateCovariance(
    time_scale_s=0.25, similarity_rate=1.2, time_power=0.02, recurrence_power=2.0, linear_power=1.2, noise_power=3e-5
)
PROCESS_SAMPLE_NOISE_M = 0.001  # metres: what a single sample cannot tell


def fill_from_gaussian_process(
    markers: np.ndarray, other_positions: np.ndarray, other_sd: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, M, 3) in metres at missing samples, NaN elsewhere, and their standard deviation per axis (T, M).

    NaN where other ways know enough, and where too little is seen all through a gap.

    markers  (T, M, 3) metres, Y up, NaN where not believed; rate in Hz
    others   (T, M, 3) what other ways say of the missing samples, and `sure` (T, M) their deviation, NaN where they say nothing
    """
    seen = ~np.isnan(markers[..., 0])
    filled, deviation = np.full(markers.shape, np.nan), np.full(seen.shape, np.nan)
    common = seen.sum(0) > MIN_VISIBLE_SHARE * len(seen)
    gaps = {
        gap: poor for gap, lost in group_gaps(~seen & common).items() if len(poor := find_uncertain_markers(other_sd, *gap, lost))
    }
    if not gaps:
        return filled, deviation
    known = common & (seen | (other_sd < MAX_INPUT_SD_M))
    turn, origin, placed = align_to_common_shape(
        np.where(known[..., None], np.where(seen[..., None], markers, other_positions), np.nan)
    )
    own = transform_to_body_axes(np.where(seen[..., None], markers, other_positions), origin, turn)
    asked = list(gaps.items())
    while asked:
        (first, last), lost = asked.pop()
        shown = placed & seen[:, lost].all(1)
        told = select_input_markers(known[shown], np.setdiff1d(np.flatnonzero(known[first : last + 1].all(0)), lost))
        learn = select_training_frames(shown & known[:, told].all(1), first, last, rate)
        gap = np.flatnonzero(placed[first : last + 1]) + first
        if (
            len(told) < MIN_INPUT_MARKERS and last - first > MIN_GAP_PIECE_S * rate
        ):  # too many are lost at some time of a long gap
            half = (first + last) // 2
            asked += [((first, half), lost), ((half + 1, last), lost)]
            continue
        if len(learn) < MIN_PROCESS_TRAINING_FRAMES or len(told) < MIN_INPUT_MARKERS or not len(gap):
            continue
        course = fit_marker_process(own, told, lost, turn, origin, learn, rate)
        place, left = course.predict(compute_marker_state_features(own[:, told], turn, origin, gap, rate), gap / rate)
        power = np.fmax(course.cross_validate_gaps((last - first + 1) / rate), course.signal_power).reshape(-1, 3).mean(1)
        at = np.ix_(gap, lost)
        filled[at] = np.einsum("tab,tmb->tma", turn[gap], place.reshape(len(gap), -1, 3)) + origin[gap, None]
        deviation[at] = np.sqrt(left[:, None] * power + PROCESS_SAMPLE_NOISE_M**2)
    return filled, deviation


def find_uncertain_markers(other_sd: np.ndarray, first: int, last: int, lost_markers: np.ndarray) -> np.ndarray:
    """-> of the markers `lost` over first..last, those that are not known well enough (T, M) all through."""
    return lost_markers[~(other_sd[first : last + 1, lost_markers] < MAX_SETTLED_SD_M).all(0)]


def select_input_markers(is_known: np.ndarray, candidate_markers: np.ndarray) -> np.ndarray:
    """-> as many of the markers `told` as are known (N, M) all together in ENOUGH of the frames, those known most often first."""
    often = candidate_markers[np.argsort(-is_known[:, candidate_markers].sum(0), kind="stable")]
    together = np.logical_and.accumulate(is_known[:, often], axis=1).sum(0)
    return np.sort(often[together >= MIN_SHARED_FRAME_SHARE * len(is_known)])


def fit_marker_process(
    own: np.ndarray,
    input_markers: np.ndarray,
    lost_markers: np.ndarray,
    body_rotations: np.ndarray,
    body_positions: np.ndarray,
    training_frames: np.ndarray,
    rate: float,
) -> GaussianProcess:
    """-> the courses of the `lost` markers in the body's axes (T, M, 3), by the circumstances that those `told` make."""
    places = own[np.ix_(training_frames, lost_markers)].reshape(len(training_frames), -1)
    noise = np.full(len(training_frames), PROCESS_SAMPLE_NOISE_M**2)
    return fit_gaussian_process(
        places,
        compute_marker_state_features(own[:, input_markers], body_rotations, body_positions, training_frames, rate),
        training_frames / rate,
        noise,
        MARKER_FILL_KERNEL,
    )


def compute_marker_state_features(
    input_positions: np.ndarray, body_rotations: np.ndarray, body_positions: np.ndarray, frames: np.ndarray, rate: float
) -> np.ndarray:
    """-> (N, F) the circumstances of the body at N `frames`, each in units of a difference that counts as one.

    told (T, K, 3) metres, in the body's axes; these as turn (T, 3, 3) and origin (T, 3) in the world
    """
    span, last = max(1, round(MARKER_VELOCITY_HALF_SPAN_S * rate)), len(input_positions) - 1
    before, after = np.maximum(frames - span, 0), np.minimum(frames + span, last)
    seconds = ((after - before) / rate + (last == 0))[:, None]
    step = np.swapaxes(body_rotations[before], 1, 2) @ body_rotations[after]
    spin = np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1) / 2
    speed = np.einsum("tba,tb->ta", body_rotations[frames], body_positions[after] - body_positions[before])
    share = np.sqrt(FEATURE_MARKER_COUNT / input_positions.shape[1])
    placed = input_positions[frames].reshape(len(frames), -1) * (share / MARKER_POSITION_UNIT_M)
    moving = (
        np.nan_to_num(input_positions[after] - input_positions[before]).reshape(len(frames), -1)
        * (share / MARKER_SPEED_UNIT_M_S)
        / seconds
    )  # 0 where not known
    hips = [
        body_rotations[frames, 1] / TRUNK_UP_UNIT,
        body_positions[frames, 1:2] / TRUNK_HEIGHT_UNIT_M,
        speed / seconds / TRUNK_SPEED_UNIT_M_S,
        spin / seconds / TRUNK_SPIN_UNIT_RAD_S,
    ]
    return np.concatenate([placed, moving, *hips], axis=1)
