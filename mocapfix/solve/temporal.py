"""Time as a prior: the smoothest course of each joint that agrees with what every frame's markers say of it.

Each joint's rotation, as a quaternion, and the root's place are smoothed on their own: frames enter with the variance
that the pose solve gives them, so that a joint whose markers are lost follows the frames around it, and the course is
an integrated random acceleration whose power about each moment is measured on the take itself. Solved exactly as one
banded system.
"""

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from mocapfix.take import runs

STEP = 0.06  # seconds over which the course's acceleration is measured
WINDOW = 0.25  # seconds over which its power is averaged: a landing is livelier than the flight before it
WELL_KNOWN = 0.1  # radians (or metres times ten): frames less certain than this do not tell the power
LIVELY = 2.0  # the quickest moments in a window over its average: smoothing must not cost them their speed
DOUBT = 20.0  # likewise across a gap: a course that is surer than the motion is lively leads it astray
QUIET = 0.02  # least power, as a share of the whole take's: a joint held still may yet move
TREMBLE = 0.02  # radians: what is left of a joint's variance from one frame to the next
SILENT = 1e4  # rad^2 or m^2: the variance of a frame that says nothing; with more the system would be singular to rounding
UNKNOWN_ROOT = 0.1  # metres: a frame that knows its root no better does not know it
LEAST = 1e-3  # least power, rad^2/s^3 or m^2/s^3


def course(path: np.ndarray, variance: np.ndarray, power: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, C): argmin over x of sum |x_t - path_t|^2 / variance_t + integral |x''|^2 / power.

    path (T, C); variance (T,) per component; power (T,) in units^2 / s^3; rate in Hz
    """
    frames = len(path)
    if frames < 3:
        return path
    stiff = rate**3 / power[1:-1]  # of the second difference about each inner frame
    band = np.zeros((3, frames))
    information = 1 / np.minimum(variance, SILENT)
    band[2] = information
    for shift, coefficient in ((0, 1.0), (1, 4.0), (2, 1.0)):
        band[2, shift : shift + frames - 2] += coefficient * stiff
    band[1, 1 : frames - 1] -= 2 * stiff
    band[1, 2:] -= 2 * stiff
    band[0, 2:] += stiff
    return np.ascontiguousarray(solveh_banded(band, path * information[:, None], overwrite_ab=True, check_finite=False))


def liveliness(path: np.ndarray, variance: np.ndarray, rate: float, well_known: float) -> np.ndarray:
    """-> (T,) the power of the random acceleration that a path (T, C) shows, per component, about each frame.

    The second difference of an integrated random acceleration over steps of h has variance 2/3 power h^3. Where the path
    is not well known, the power is that of the nearest moments where it is.
    """
    frames, h = len(path), max(1, round(STEP * rate))
    if frames < 4 * h:
        return np.ones(frames)
    second = ((path[2 * h :] - 2 * path[h:-h] + path[: -2 * h]) ** 2).mean(1) / (2 / 3 * (h / rate) ** 3)
    known = variance[2 * h :] + 4 * variance[h:-h] + variance[: -2 * h] < 6 * well_known**2
    window = max(1, round(WINDOW * rate))
    amount = uniform_filter1d(np.where(known, second, 0.0), window, mode="nearest")
    share = uniform_filter1d(known.astype(float), window, mode="nearest")
    told = np.flatnonzero(share > 0.1)
    if known.sum() < 4 * h or not len(told):
        return np.ones(frames)
    local = np.interp(np.arange(frames), told + h, amount[told] / share[told])
    return np.maximum(LIVELY * np.maximum(local, QUIET * second[known].mean()), LEAST)


def smoothed_turns(quaternions: np.ndarray, variance: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 4), not of unit length, the smooth course of one joint's quaternions (T, 4), variance (T,) in rad^2 per axis."""
    return course(quaternions, variance, turn_power(quaternions, variance, rate), rate)


def bridged(quaternions: np.ndarray, variance: np.ndarray, unsure: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> the course of one joint (T, 4) through the frames that are sure of it, and its variance (T,) at the others."""
    # what makes a joint's place unsure, its markers' places, is the same from frame to frame: the course is known better
    sure = np.where(unsure, SILENT, np.minimum(variance, TREMBLE**2))
    power = turn_power(quaternions, sure, rate)
    return course(quaternions, sure, power, rate), left_open(unsure, power, rate)


def turn_power(quaternions: np.ndarray, variance: np.ndarray, rate: float) -> np.ndarray:
    """-> (T,) rad^2/s^3 per axis: the power that a joint's quaternions (T, 4) show."""
    return liveliness(2 * quaternions, variance, rate, WELL_KNOWN) * 4 / 3  # three degrees of freedom in four numbers


def left_open(unsure: np.ndarray, power: np.ndarray, rate: float) -> np.ndarray:
    """-> (T,) the variance of a course of `power` (T,) at the frames that are unsure, 0 at the others.

    Between two known ends, a and b seconds away, an integrated random acceleration of power q has variance
    q a^3 b^3 / 3 (a + b)^3; beyond the last known end, q a^3 / 3.
    """
    variance = np.zeros(len(unsure))
    for first, last in runs(unsure):
        a, b = np.arange(1, last - first + 2) / rate, np.arange(last - first + 1, 0, -1) / rate
        if first == 0:
            a = np.full(len(a), np.inf)
        if last == len(unsure) - 1:
            b = np.full(len(b), np.inf)
        variance[first : last + 1] = DOUBT * power[first : last + 1].mean() / 3 / np.maximum(1 / a + 1 / b, 1e-9) ** 3
    return variance


def smoothed_root(root: np.ndarray, variance: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> (T, 3) metres, the smooth course of the root, and its variance (T,) in frames that hardly tell the root.

    variance  (T,) m^2 per axis, each frame's own
    """
    power = liveliness(root, variance, rate, WELL_KNOWN / 10)
    return course(root, variance, power, rate), left_open(variance > UNKNOWN_ROOT**2, power, rate)
