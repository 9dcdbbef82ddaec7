"""Time as a prior: the smoothest course of each joint that agrees with what every frame's markers say of it.

Each joint's rotation, as a quaternion, and the root's place are smoothed on their own: frames enter with the variance
that the pose solve gives them, so that a joint whose markers are lost follows the frames around it, and the course is
an integrated random acceleration whose intensity is measured on the take itself. Solved exactly as one banded system.
"""

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from mocapfix.take import runs

STEP = 0.1  # seconds over which the course's acceleration is measured
WELL_KNOWN = 0.1  # radians (or metres times ten): frames less certain than this do not tell the intensity
LIVELY = 3.0  # the take's quick moments over its average: smoothing must not cost them their speed
DOUBT = 100.0  # likewise across a gap: a course that is surer than the motion is lively leads it astray
LEAST = 1e-3  # least intensity, rad^2/s^3 or m^2/s^3: a joint held still still may move


def course(path: np.ndarray, variance: np.ndarray, intensity: float, rate: float) -> np.ndarray:
    """-> (T, C): argmin over x of sum |x_t - path_t|^2 / variance_t + integral |x''|^2 / intensity.

    path (T, C); variance (T,) per component; intensity in units^2 / s^3; rate in Hz
    """
    frames = len(path)
    if frames < 3:
        return path
    stiff = rate**3 / intensity
    band = np.zeros((3, frames))
    band[2] = stiff * np.r_[1, 5, np.full(max(frames - 4, 0), 6.0), 5, 1][:frames] if frames > 3 else stiff * np.array([1, 4, 1])
    band[1, 1:] = stiff * (np.r_[-2, np.full(max(frames - 3, 0), -4.0), -2] if frames > 3 else np.array([-2, -2]))
    band[0, 2:] = stiff
    band[2] += 1 / variance
    return np.ascontiguousarray(solveh_banded(band, path / variance[:, None], overwrite_ab=True, check_finite=False))


def intensity(path: np.ndarray, variance: np.ndarray, rate: float, well_known: float) -> float:
    """-> the power of the random acceleration that a path (T, C) shows, per component, where it is well known.

    The second difference of an integrated random acceleration over steps of h has variance 2/3 intensity h^3. Over a
    tenth of a second motion outweighs what skin and cameras add, so their part is left in.
    """
    h = max(1, round(STEP * rate))
    if len(path) < 3 * h:
        return 1.0
    second = path[2 * h :] - 2 * path[h:-h] + path[: -2 * h]
    noise = variance[2 * h :] + 4 * variance[h:-h] + variance[: -2 * h]
    known = noise < 6 * well_known**2
    if known.sum() < 3 * h:
        return 1.0
    power = (second[known] ** 2).mean()
    return max(LIVELY * power / (2 / 3 * (h / rate) ** 3), LEAST)


def smoothed_rotations(rotations: np.ndarray, variance: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 3, 3) the smooth course of one joint's rotations (T, 3, 3), variance (T,) in rad^2 per axis."""
    quaternions = continuous(rotations, np.ones(len(rotations), bool))
    power = intensity(2 * quaternions, variance, rate, WELL_KNOWN) * 4 / 3  # three degrees of freedom in four numbers
    smooth = course(quaternions, variance, power, rate)
    return Rotation.from_quat(smooth).as_matrix()


def bridged(rotations: np.ndarray, variance: np.ndarray, unsure: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> the course of one joint (T, 3, 3) through the frames that are sure of it, and its variance (T,) at the others.

    Between two known ends, a and b seconds away, an integrated random acceleration of intensity q has variance
    q a^3 b^3 / 3 (a + b)^3; beyond the last known end, q a^3 / 3.
    """
    sure = np.where(unsure, 1e4, variance)
    quaternions = continuous(rotations, ~unsure)
    power = intensity(2 * quaternions, sure, rate, WELL_KNOWN)
    smooth = Rotation.from_quat(course(quaternions, sure, power * 4 / 3, rate)).as_matrix()
    open_variance = np.zeros(len(rotations))
    for first, last in runs(unsure):
        a, b = np.arange(1, last - first + 2) / rate, np.arange(last - first + 1, 0, -1) / rate
        if first == 0:
            a = np.full(len(a), np.inf)
        if last == len(rotations) - 1:
            b = np.full(len(b), np.inf)
        open_variance[first : last + 1] = DOUBT * power / 3 / (1 / a + 1 / b) ** 3
    return smooth, open_variance


def continuous(rotations: np.ndarray, known: np.ndarray) -> np.ndarray:
    """-> quaternions (T, 4), each on the same side as the last known one before it."""
    quaternions = Rotation.from_matrix(rotations).as_quat()
    before = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
    before = np.r_[0, before[:-1]]
    same = (quaternions * quaternions[before]).sum(1) >= 0
    side = np.ones(len(quaternions))
    for t in np.flatnonzero(~same):
        side[t] = -1.0
    # a frame's side is its own flip times the side of the frame it is held against
    for t in range(1, len(side)):
        side[t] *= side[before[t]]
    return quaternions * side[:, None]


def smoothed_root(root: np.ndarray, variance: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 3) metres, the smooth course of the root, variance (T,) in m^2 per axis."""
    return course(root, variance, intensity(root, variance, rate, WELL_KNOWN / 10), rate)
