"""Events of gait: the instants at which a foot strikes the floor and leaves it.

A foot is near the floor while its heel or its toes are low and slow. At a strike the floor stops the foot: the vertical
acceleration of heel or toes has its greatest peak (Hreljac and Marshall, J. Biomech. 33, 2000). When a foot leaves, its toes
begin to accelerate: the instant at which their acceleration reaches most of its next peak. Both are between frames.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, binary_opening
from scipy.signal import butter, filtfilt, find_peaks

from mocapfix.contacts.contacts import GaitEvent
from mocapfix.contacts.foot_points import FootPoints
from mocapfix.contacts.standing import compute_speed
from mocapfix.stats.sequences import find_runs

NEAR_FLOOR_M = 0.05
"""Height of a point of the foot above its lowest 5 % below which it is near the floor."""
NEAR_FLOOR_SPEED_M_S = 0.8
LOWEST_PERCENTILE = 5.0
MIN_CONTACT_S = 0.06
"""Shortest contact, and shortest time without contact."""
LOWPASS_HZ = 25.0
"""Cut-off of the positions before they are differentiated twice; the impact of a strike is above the usual 6 to 12 Hz."""
MAX_LOWPASS_SHARE = 0.4
"""The same at most, as a share of the frame rate."""
STRIKE_WINDOW_S = (0.08, 0.06)
OFF_WINDOW_S = (0.04, 0.1)
"""Seconds before and after the ends of a contact in which its events are searched."""
MAX_STRIKE_HEIGHT_M = 0.03
"""Height of the point that strikes above its low places in the contact."""
OFF_PEAK_SHARE = 0.8
"""Share of the peak of the toes' acceleration that is reached when the foot leaves."""
MIN_FRAMES = 30
"""Frames below which no acceleration is computed."""


def detect_gait_events(feet: Mapping[str, FootPoints], rate: float) -> tuple[GaitEvent, ...]:
    """Return the events of all feet by time, from the markers. Contacts at the ends of the take have one event only."""
    events: list[GaitEvent] = []
    for side, points in feet.items():
        if len(points.heel) < MIN_FRAMES:
            continue
        is_near = find_foot_near_floor(points, rate)
        acceleration = [compute_acceleration(path, rate) for path in points]
        for first, last in find_runs(is_near):
            if first > 0:
                events.append(GaitEvent(side, "foot strike", find_strike(points, acceleration, (first, last), rate), "markers"))
            if last < len(is_near) - 1:
                events.append(GaitEvent(side, "foot off", find_off(acceleration[1], last, rate), "markers"))
    return tuple(sorted(events, key=lambda event: event.time_s))


def find_foot_near_floor(points: FootPoints, rate: float) -> Bool[np.ndarray, " T"]:
    """Return the frames in which the heel or the toes are low and slow."""
    is_near = np.zeros(len(points.heel), bool)
    for path in points:
        height = path[:, 1] - np.percentile(path[:, 1], LOWEST_PERCENTILE)
        is_near |= (height < NEAR_FLOOR_M) & (compute_speed(path, rate) < NEAR_FLOOR_SPEED_M_S)
    length = max(1, round(MIN_CONTACT_S * rate))
    structure = np.ones(length + 1, bool)
    padded = np.pad(is_near, len(structure), mode="edge")
    cleaned = binary_opening(binary_closing(padded, structure), structure)
    return cleaned[len(structure) : -len(structure)]


def compute_acceleration(path: Float[np.ndarray, "T 3"], rate: float) -> Float[np.ndarray, "T 3"]:
    """Return the acceleration in m/s^2 of a path in metres, filtered without delay."""
    cutoff_hz = min(LOWPASS_HZ, MAX_LOWPASS_SHARE * rate)
    b, a = butter(2, cutoff_hz / (rate / 2))
    smooth = filtfilt(b, a, path, axis=0)
    return np.gradient(np.gradient(smooth, 1 / rate, axis=0), 1 / rate, axis=0)


def find_strike(points: FootPoints, acceleration: list[Float[np.ndarray, "T 3"]], contact: tuple[int, int], rate: float) -> float:
    """Return the time in seconds of the greatest peak of vertical acceleration about the beginning of a contact."""
    first, last = contact
    start = max(1, first - round(STRIKE_WINDOW_S[0] * rate))
    stop = min(len(points.heel) - 2, first + round(STRIKE_WINDOW_S[1] * rate))
    best_frame, best_value, best_signal = first, 0.0, acceleration[0][:, 1]
    for path, signal in zip(points, (each[:, 1] for each in acceleration), strict=True):
        heights = np.sort(path[first : last + 1, 1])
        low = float(np.median(heights[: max(1, len(heights) // 3)]))
        for frame in start + find_peaks(signal[start : stop + 1])[0]:
            if signal[frame] > best_value and path[frame, 1] < low + MAX_STRIKE_HEIGHT_M:
                best_frame, best_value, best_signal = int(frame), float(signal[frame]), signal
    return interpolate_peak(best_signal, best_frame) / rate if best_value > 0 else first / rate


def find_off(toe_acceleration: Float[np.ndarray, "T 3"], last: int, rate: float) -> float:
    """Return the time in seconds at which the toes' acceleration reaches most of its peak, about the end of a contact."""
    size = np.linalg.norm(toe_acceleration, axis=1)
    start = max(1, last - round(OFF_WINDOW_S[0] * rate))
    peaks = start + find_peaks(size[start : min(len(size) - 2, last + round(OFF_WINDOW_S[1] * rate)) + 1])[0]
    if not len(peaks):
        return last / rate
    peak = int(peaks[size[peaks].argmax()])
    level, frame = OFF_PEAK_SHARE * size[peak], peak
    while frame > 1 and size[frame - 1] > level:
        frame -= 1
    before, at = size[frame - 1], size[frame]
    return (frame - 1 + (level - before) / (at - before)) / rate if at > level > before else frame / rate


def interpolate_peak(signal: Float[np.ndarray, " T"], frame: int) -> float:
    """Return the place of a peak between frames, by a parabola through three samples."""
    if not 0 < frame < len(signal) - 1:
        return float(frame)
    before, at, after = signal[frame - 1 : frame + 2]
    curvature = before - 2 * at + after
    return frame + 0.5 * (before - after) / curvature if curvature < 0 else float(frame)
