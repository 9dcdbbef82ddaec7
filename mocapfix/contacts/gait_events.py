"""Events of gait: the instants at which a foot strikes the floor and leaves it, and the points of the feet that show them.

The heel and the tip of each foot are markers where the foot has them, otherwise points of the solved body.

A foot is near the floor while its heel or its toes are low and slow. At a strike the floor stops the point that lands first,
the heel or the toes: the first peak of vertical acceleration of a point that is down and nearly stopped (after Hreljac and
Marshall, J. Biomech. 33, 2000). A foot that glides to its place without an impact strikes when this point stops. When a foot
leaves, its toes begin to accelerate: the instant at which their acceleration reaches most of its next peak. Events are between
frames.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, MAX_LEVEL_DEVIATION_M, Floor, GaitEvent
from mocapfix.contacts.find_contacts import compute_speed
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs, smooth_path

HEEL_PER_FOOT = -0.35  # the heel, as a share of the length from the ankle to the toe base; negative is behind the ankle
MAX_HEEL_MARKER_M = 0.02  # the foremost place along the foot, before the ankle, of a marker that stands for the heel
MIN_TOE_MARKER_SHARE = 0.9
"""The rearmost place along the foot, before the ankle, of a marker that stands for the toes, as a share of the length from the
ankle to the toe base: one farther back leaves the floor before the toes do."""
MIN_SHOWN_SHARE = 0.8  # share of frames in which such a marker is visible; the body shows where it is in the others


@dataclass(frozen=True)
class FootPoints:
    """The heel and the toes of one foot."""

    heel: Float[np.ndarray, "T 3"]  # heel, toe: (T, 3) m
    toe: Float[np.ndarray, "T 3"]
    is_seen: Bool[np.ndarray, "T 2"]  # (T, 2): whether markers show each of both

    @property
    def paths(self) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
        """The paths (T, 3) in metres of heel and toes."""
        return self.heel, self.toe


def build_foot_points(
    subject: Subject,
    motion: Motion,
    markers: Float[np.ndarray, "T K 3"],
    body_markers: Float[np.ndarray, "T K 3"],
    is_known: Bool[np.ndarray, "T C"],
) -> Mapping[str, FootPoints]:
    """Return the points of the feet, by side.

    Args:
        markers: (T, K, 3) m: the subject's markers as measured, NaN where they are missing or faulty.
        body_markers: (T, K, 3) m: where the body carries them.
        is_known: (T, C): whether markers show the position of each joint, of which the first are CONTACT_JOINTS.
    """
    skeleton = subject.skeleton
    position, rotation = kinematics.compute_world_poses(skeleton, motion)
    visible = np.all(np.isfinite(markers), axis=-1)
    shown = np.where(visible[..., None], markers, body_markers)
    points: dict[str, FootPoints] = {}
    for side, joints in FOOT_JOINTS.items():
        foot, toe = (skeleton.names.index(joint) for joint in joints)
        bone, end = skeleton.offsets[toe], np.nan_to_num(skeleton.ends[toe])
        heel = position[:, foot] + rotation[:, foot] @ (bone * [HEEL_PER_FOOT, 1.0, HEEL_PER_FOOT])
        tip = position[:, toe] + rotation[:, toe] @ end
        place = _compute_place_along_foot(subject, foot, toe)
        is_usable = np.isfinite(place) & (visible.mean(0) >= MIN_SHOWN_SHARE) & np.isfinite(shown).all((0, 2))
        is_seen = is_known[:, [CONTACT_JOINTS.index(joint) for joint in joints]]
        by_place = sorted(np.flatnonzero(is_usable), key=lambda marker: place[marker])
        if by_place and place[by_place[0]] < MAX_HEEL_MARKER_M:
            heel, is_seen[:, 0] = shown[:, by_place[0]], is_seen[:, 0] | visible[:, by_place[0]]
        if by_place and place[by_place[-1]] > MIN_TOE_MARKER_SHARE * np.linalg.norm(bone):
            tip, is_seen[:, 1] = shown[:, by_place[-1]], is_seen[:, 1] | visible[:, by_place[-1]]
        points[side] = FootPoints(heel, tip, is_seen)
    return points


def _compute_place_along_foot(subject: Subject, foot: int, toe: int) -> Float[np.ndarray, " K"]:
    """Return how far before the ankle, in metres along the foot, each marker of a foot is; NaN for other markers."""
    bone = subject.skeleton.offsets[toe]
    direction = bone / np.linalg.norm(bone)
    along = subject.marker_offsets @ direction
    along = np.where(subject.joints == toe, along + np.linalg.norm(bone), along)
    return np.where(np.isin(subject.joints, (foot, toe)), along, np.nan)


NEAR_FLOOR_M = 0.05
NEAR_LOWEST_M = 0.1
"""Height of a point of the foot above its lowest 5 % while it stands, below which it is near the floor, and the same where no
floor is known: of sprinters, whose feet never stand for long, on a track that rises by 13 mm a step."""
NEAR_FLOOR_SPEED_M_S, SLOW_STEP_SPEED_M_S = 0.8, 0.4  # below which a point is slow; the same in steps with a swing as slow
NEAR_FLOOR_SPEED_SHARE, SPRINT_SPEED_SHARE = 0.4, 0.04
MIN_NEAR_FLOOR_SPEED_M_S = 0.2
"""The same as shares of the speed of a swing: for slow feet, whose points would be slow in swings, but not less than the third;
and for sprinters, whose toes move at 0.6 of 20 m/s while they stand."""
STANDING_POINT_SPEED_M_S = 0.3
STANDING_POINT_SPEED_SHARE = 0.03
"""Speed of a heel or toes below which these stand: the first, or this share of a swing for sprinters. At 8 strikes on plates in
4 walks the heel had 0.2 to 0.4 m/s."""
SWING_PERCENTILE = 98.0  # percentile of a point's speed that is the speed of its swing
LOWEST_PERCENTILE = 5.0
MIN_CONTACT_S = 0.06  # shortest contact, and shortest time without contact
MIN_SEEN_S = 0.05  # time before and after an event for which the take must last and markers must show the foot
LOWPASS_HZ = 25.0  # of the positions before they are differentiated; the impact of a strike is above the usual 6 to 12 Hz
MAX_LOWPASS_SHARE = 0.4  # the same at most, as a share of the frame rate
STRIKE_WINDOW_S = (0.08, 0.08)
OFF_WINDOW_S = (0.06, 0.15)  # seconds before and after the ends of a contact in which its events are searched
MAX_STRIKE_HEIGHT_M = 0.03  # height of the point that strikes above its low places in the contact
MAX_STRIKE_SPEED_M_S = 0.8
MAX_STRIKE_SPEED_SHARE = 0.2
"""Speed of a point at its strike: at most the first, or this share of its swing. The toes of a sprinter land at 3 of 20 m/s."""
MIN_STRIKE_ACCELERATION_M_S2 = 3.0  # vertical, below which there was no impact, or smoothing of the markers has removed it
PEAK_SHARE = 0.93
"""Share of a peak of acceleration that is reached at an event: the force begins, and ends, before the peak. Against 21 strikes
and 20 offs on plates the medians are -3 and +2 ms; from 0.9 to 0.98 they grow by 6 and 8 ms, standard deviations of 9 ms by 1."""
MIN_FRAMES = 30  # frames below which no acceleration is computed


class PointMotion(NamedTuple):
    """The motion of the heel or the toes of a foot."""

    path: Float[np.ndarray, "T 3"]  # m
    speed: Float[np.ndarray, " T"]  # m/s
    acceleration: Float[np.ndarray, "T 3"]  # m/s^2, filtered
    swing_m_s: float  # its speed in a swing


def detect_gait_events(feet: Mapping[str, FootPoints], floor: Floor, rate: float) -> tuple[GaitEvent, ...]:
    """Return the events of all feet by time, from the markers.

    A foot has no event where markers do not show it, nor within MIN_SEEN_S of the ends of the take.

    Args:
        feet: The heel and the toes of each foot, by side.
        rate: Frames per second.
    """
    events: list[GaitEvent] = []
    for side, points in feet.items():
        if len(points.heel) < MIN_FRAMES:
            continue
        times = remove_repeated_contacts(list(_generate_contact_times(points, floor, rate)))
        for times_s, kind, is_seen in (
            ([strike_s for strike_s, _ in times], "foot strike", np.all(points.is_seen, axis=1)),
            ([off_s for _, off_s in times], "foot off", points.is_seen[:, 1]),
        ):
            for time_s in times_s:
                first, last = np.ceil((time_s - MIN_SEEN_S) * rate), np.floor((time_s + MIN_SEEN_S) * rate)
                if first >= 0 and last < len(is_seen) and is_seen[int(first) : int(last) + 1].all():
                    events.append(GaitEvent(side, kind, time_s, "markers"))
    return tuple(sorted(events, key=lambda event: event.time_s))


def _generate_contact_times(points: FootPoints, floor: Floor, rate: float) -> Iterator[tuple[float, float]]:
    """Yield strike and off of each contact of a foot, in seconds; NaN where the take begins or ends in contact."""
    motions: list[PointMotion] = []
    for path in points.paths:
        speed = compute_speed(path, rate)
        motions.append(PointMotion(path, speed, compute_acceleration(path, rate), float(np.percentile(speed, SWING_PERCENTILE))))
    for first, last in find_runs(find_foot_near_floor(points, floor, rate)):
        strikes_s = [find_strike(motion, (first, last), rate) for motion in motions]
        strike_s = float(np.nanmin(strikes_s)) if np.isfinite(strikes_s).any() else first / rate
        off_s = find_off(motions[1].acceleration, last, rate)
        yield (strike_s if first > 0 else np.nan), (off_s if last < len(points.heel) - 1 else np.nan)


def remove_repeated_contacts(contacts: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the contacts (strike and off, s) of one foot, joined where two strikes or two offs are within half a step.

    Half a step is a quarter of the median time from one strike of the foot to the next.
    """
    stride_s = [after - before for (before, _), (after, _) in pairwise(contacts) if np.isfinite(before)]
    half_step_s = max(0.25 * float(np.median(stride_s)), 2 * MIN_CONTACT_S) if stride_s else 2 * MIN_CONTACT_S
    kept: list[tuple[float, float]] = []
    for strike_s, off_s in contacts:
        previous_strike_s, previous_off_s = kept[-1] if kept else (np.nan, np.nan)
        if strike_s - previous_strike_s < half_step_s or off_s - previous_off_s < half_step_s or strike_s <= previous_off_s:
            kept[-1] = (previous_strike_s, off_s)
        else:
            kept.append((strike_s, off_s))
    return kept


def find_foot_near_floor(points: FootPoints, floor: Floor, rate: float) -> Bool[np.ndarray, " T"]:
    """Return the frames in which the heel or the toes are slow and low, about times at which they stand on the floor.

    A contact lasts while a point is slower than NEAR_FLOOR_SPEED_M_S, between steps in which no point ever is faster while it is
    slower than SLOW_STEP_SPEED_M_S.
    """
    is_slowest, is_slow = (find_low_frames(points, floor, rate, limit) for limit in (SLOW_STEP_SPEED_M_S, NEAR_FLOOR_SPEED_M_S))
    is_near = is_slowest.copy()
    for first, last in find_runs(~is_slowest):
        if not is_slow[first : last + 1].all():
            is_near[first : last + 1] = is_slow[first : last + 1]
    min_frames = max(1, round(MIN_CONTACT_S * rate)) + 1
    for first, last in find_runs(~is_near):
        is_near[first : last + 1] = first > 0 and last < len(is_near) - 1 and last - first + 1 < min_frames
    for first, last in find_runs(is_near):
        is_near[first : last + 1] = last - first + 1 >= min_frames
    return is_near


def find_low_frames(points: FootPoints, floor: Floor, rate: float, limit_m_s: float) -> Bool[np.ndarray, " T"]:
    """Return the frames in which the heel or the toes are low and slower than a limit, in runs in which they stand."""
    is_found = np.zeros(len(points.heel), bool)
    ground = replace(floor, level_heights_m=floor.level_heights_m[:1])
    margin_m = NEAR_FLOOR_M if floor.level_heights_m else NEAR_LOWEST_M
    for path in points.paths if len(is_found) else ():
        height, speed = floor.compute_height_above(path), compute_speed(path, rate)
        swing_m_s = float(np.percentile(speed, SWING_PERCENTILE))
        largest_m_s = max(limit_m_s, SPRINT_SPEED_SHARE * swing_m_s)
        is_slow = speed < np.clip(NEAR_FLOOR_SPEED_SHARE * swing_m_s, MIN_NEAR_FLOOR_SPEED_M_S, largest_m_s)
        is_standing = speed < max(STANDING_POINT_SPEED_M_S, STANDING_POINT_SPEED_SHARE * swing_m_s)
        standing_m = height[is_standing & (height > -MAX_LEVEL_DEVIATION_M)]
        lowest_m = np.percentile(standing_m, LOWEST_PERCENTILE) if len(standing_m) else 0.0
        # a point below an upper level is between two levels, not on it; one below the lowest level is on something lower still
        is_on_level = (height > lowest_m - MAX_LEVEL_DEVIATION_M) | (ground.compute_height_above(path) < lowest_m)
        for first, last in find_runs(is_slow & is_on_level & (height < lowest_m + margin_m)):
            is_found[first : last + 1] |= is_standing[first : last + 1].any()
    return is_found


def compute_acceleration(path: Float[np.ndarray, "T 3"], rate: float) -> Float[np.ndarray, "T 3"]:
    """Return the acceleration in m/s^2 of a path in metres, smoothed without delay.

    The frequency response is that of a Butterworth filter of second order, forwards and backwards: half at the cutoff frequency.
    """
    cutoff = 2 * np.sin(np.pi * min(LOWPASS_HZ / rate, MAX_LOWPASS_SHARE))
    smooth = smooth_path(path, np.ones(len(path)), np.full(len(path), rate**3 * cutoff**4), rate)
    return np.gradient(np.gradient(smooth, 1 / rate, axis=0), 1 / rate, axis=0)


def find_strike(motion: PointMotion, contact: tuple[int, int], rate: float) -> float:
    """Return the time in seconds at which the floor stops a point of the foot, about the beginning of a contact.

    Without an impact, or where the laboratory has smoothed it away, it is where the point stops sliding. NaN if it does neither.
    """
    (path, speed, acceleration, swing_m_s), (first, last) = motion, contact
    start = max(1, first - round(STRIKE_WINDOW_S[0] * rate))
    stop = min(len(path) - 2, first + round(STRIKE_WINDOW_S[1] * rate))
    heights = np.sort(path[first : last + 1, 1])
    is_low = path[:, 1] < float(np.median(heights[: max(1, len(heights) // 3)])) + MAX_STRIKE_HEIGHT_M
    is_down = is_low & (speed < max(MAX_STRIKE_SPEED_M_S, MAX_STRIKE_SPEED_SHARE * swing_m_s))
    signal = acceleration[:, 1]
    peaks = start + find_peaks(signal[start : stop + 1])
    peaks = peaks[is_down[peaks] & (signal[peaks] >= MIN_STRIKE_ACCELERATION_M_S2)]
    if len(peaks):
        return find_rise(signal, int(peaks[signal[peaks].argmax()])) / rate
    stops = start + np.flatnonzero((is_low & (speed < STANDING_POINT_SPEED_M_S))[start : last + 1])
    if not len(stops):
        return np.nan
    before, at = speed[stops[0] - 1], speed[stops[0]]
    share = (before - STANDING_POINT_SPEED_M_S) / (before - at) if before > STANDING_POINT_SPEED_M_S else 1.0
    return float(stops[0] - 1 + share) / rate


def find_off(toe_acceleration: Float[np.ndarray, "T 3"], last: int, rate: float) -> float:
    """Return the time in seconds at which the toes' acceleration reaches most of its peak, about the end of a contact."""
    size = np.linalg.norm(toe_acceleration, axis=1)
    start = max(1, last - round(OFF_WINDOW_S[0] * rate))
    peaks = start + find_peaks(size[start : last + 1 + round(OFF_WINDOW_S[1] * rate)])
    return find_rise(size, int(peaks[size[peaks].argmax()])) / rate if len(peaks) else last / rate


def find_peaks(signal: Float[np.ndarray, " T"]) -> Int[np.ndarray, " N"]:
    """Return the frames at which a signal is greater than before and after (`scipy.signal`, which does it, is slow to import)."""
    return 1 + np.flatnonzero((signal[1:-1] > signal[:-2]) & (signal[1:-1] > signal[2:]))


def find_rise(signal: Float[np.ndarray, " T"], peak: int) -> float:
    """Return the frame, with a fraction, at which a signal reaches most of a peak."""
    level, frame = PEAK_SHARE * signal[peak], peak
    while frame > 1 and level < signal[frame - 1] <= signal[peak]:
        frame -= 1
    before, at = signal[frame - 1], signal[frame]
    return frame - 1 + float((level - before) / (at - before)) if at > level > before else float(frame)
