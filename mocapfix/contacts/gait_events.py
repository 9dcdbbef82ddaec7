"""Events of gait: the instants at which a foot strikes the floor and leaves it.

A foot is near the floor while its heel or its toes are low and slow. At a strike the floor stops the foot: the vertical
acceleration of heel or toes has its greatest peak (Hreljac and Marshall, J. Biomech. 33, 2000). When a foot leaves, its toes
begin to accelerate: the instant at which their acceleration reaches most of its next peak. Both are between frames.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, binary_opening
from scipy.signal import butter, find_peaks, sosfiltfilt

from mocapfix.contacts.contacts import GaitEvent
from mocapfix.contacts.floor import Floor
from mocapfix.contacts.foot_points import FootPoints
from mocapfix.contacts.standing import compute_speed
from mocapfix.stats.sequences import find_runs

NEAR_FLOOR_M = 0.05
"""Height of a point of the foot above its lowest 5 % while it is slow, below which it is near the floor."""
NEAR_FLOOR_SPEED_M_S = 0.8
LOWEST_PERCENTILE = 5.0
MIN_CONTACT_S = 0.06
"""Shortest contact, and shortest time without contact."""
LOWPASS_HZ = 25.0
"""Cut-off of the positions before they are differentiated twice; the impact of a strike is above the usual 6 to 12 Hz."""
MAX_LOWPASS_SHARE = 0.4
"""The same at most, as a share of the frame rate."""
STRIKE_WINDOW_S = (0.08, 0.06)
OFF_WINDOW_S = (0.06, 0.15)
"""Seconds before and after the ends of a contact in which its events are searched."""
MAX_STRIKE_HEIGHT_M = 0.03
"""Height of the point that strikes above its low places in the contact."""
MIN_STRIKE_ACCELERATION_M_S2 = 2.0
"""Vertical acceleration below which there was no impact, or smoothing of the markers has removed it."""
PEAK_SHARE = 0.9
"""Share of a peak of acceleration that is reached at an event: the force begins, and ends, before the peak."""
MIN_FRAMES = 30
"""Frames below which no acceleration is computed."""


def detect_gait_events(feet: Mapping[str, FootPoints], floor: Floor, rate: float) -> tuple[GaitEvent, ...]:
    """Return the events of all feet by time, from the markers. Contacts at the ends of the take have one event only."""
    events: list[GaitEvent] = []
    for side, points in feet.items():
        if len(points.heel) < MIN_FRAMES:
            continue
        is_near = find_foot_near_floor(points, floor, rate)
        acceleration = [compute_acceleration(path, rate) for path in points]
        for first, last in find_runs(is_near):
            if first > 0:
                events.append(GaitEvent(side, "foot strike", find_strike(points, acceleration, (first, last), rate), "markers"))
            if last < len(is_near) - 1:
                events.append(GaitEvent(side, "foot off", find_off(acceleration[1], last, rate), "markers"))
    return tuple(sorted(events, key=lambda event: event.time_s))


def find_foot_near_floor(points: FootPoints, floor: Floor, rate: float) -> Bool[np.ndarray, " T"]:
    """Return the frames in which the heel or the toes are low above a level of the floor, and slow."""
    is_near = np.zeros(len(points.heel), bool)
    for path in points:
        height = floor.compute_height_above(path)
        is_slow = compute_speed(path, rate) < NEAR_FLOOR_SPEED_M_S
        if is_slow.any():
            is_near |= is_slow & (height < np.percentile(height[is_slow], LOWEST_PERCENTILE) + NEAR_FLOOR_M)
    length = max(1, round(MIN_CONTACT_S * rate))
    structure = np.ones(length + 1, bool)
    padded = np.pad(is_near, len(structure), mode="edge")
    cleaned = binary_opening(binary_closing(padded, structure), structure)
    return cleaned[len(structure) : -len(structure)]


def compute_acceleration(path: Float[np.ndarray, "T 3"], rate: float) -> Float[np.ndarray, "T 3"]:
    """Return the acceleration in m/s^2 of a path in metres, filtered without delay."""
    cutoff_hz = min(LOWPASS_HZ, MAX_LOWPASS_SHARE * rate)
    sections = butter(2, cutoff_hz / (rate / 2), output="sos")
    smooth = sosfiltfilt(sections, path, axis=0)
    return np.gradient(np.gradient(smooth, 1 / rate, axis=0), 1 / rate, axis=0)


def find_strike(points: FootPoints, acceleration: list[Float[np.ndarray, "T 3"]], contact: tuple[int, int], rate: float) -> float:
    """Return the time in seconds at which the floor stops the heel or the toes, about the beginning of a contact.

    Where the markers were smoothed so much that no impact is left in their height, it is where the lower point stops sliding.
    """
    first, last = contact
    start = max(1, first - round(STRIKE_WINDOW_S[0] * rate))
    stop = min(len(points.heel) - 2, first + round(STRIKE_WINDOW_S[1] * rate))
    best_frame, best_value, best_signal = first, 0.0, acceleration[0][:, 1]
    heights_at_first: list[float] = []
    for path, signal in zip(points, (each[:, 1] for each in acceleration), strict=True):
        heights = np.sort(path[first : last + 1, 1])
        low = float(np.median(heights[: max(1, len(heights) // 3)]))
        heights_at_first.append(path[first, 1] - low)
        for frame in start + find_peaks(signal[start : stop + 1])[0]:
            if signal[frame] > best_value and path[frame, 1] < low + MAX_STRIKE_HEIGHT_M:
                best_frame, best_value, best_signal = int(frame), float(signal[frame]), signal
    if best_value < MIN_STRIKE_ACCELERATION_M_S2:
        size = np.linalg.norm(acceleration[int(np.argmin(heights_at_first))], axis=1)
        best_frame, best_signal = find_highest_peak(size, start, stop), size
    return first / rate if best_frame is None else find_rise(best_signal, best_frame) / rate


def find_highest_peak(signal: Float[np.ndarray, " T"], start: int, stop: int) -> int | None:
    """Return the frame of the highest peak from `start` to `stop`; None without a peak."""
    peaks = start + find_peaks(signal[start : stop + 1])[0]
    return int(peaks[signal[peaks].argmax()]) if len(peaks) else None


def find_off(toe_acceleration: Float[np.ndarray, "T 3"], last: int, rate: float) -> float:
    """Return the time in seconds at which the toes' acceleration reaches most of its peak, about the end of a contact."""
    size = np.linalg.norm(toe_acceleration, axis=1)
    start = max(1, last - round(OFF_WINDOW_S[0] * rate))
    peak = find_highest_peak(size, start, min(len(size) - 2, last + round(OFF_WINDOW_S[1] * rate)))
    return last / rate if peak is None else find_rise(size, peak) / rate


def find_rise(signal: Float[np.ndarray, " T"], peak: int) -> float:
    """Return the frame, with a fraction, at which a signal reaches most of a peak."""
    level, frame = PEAK_SHARE * signal[peak], peak
    while frame > 1 and level < signal[frame - 1] <= signal[peak]:
        frame -= 1
    before, at = signal[frame - 1], signal[frame]
    return frame - 1 + float((level - before) / (at - before)) if at > level > before else float(frame)
