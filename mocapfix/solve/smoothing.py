"""Time as a prior: the smoothest course of each joint that agrees with what every frame's markers say of it.

Each joint's rotation, as a quaternion, and the root's place are smoothed on their own: frames enter with the variance
that the pose solve gives them, so that a joint whose markers are lost follows the frames around it, and the course is
an integrated random acceleration whose power about each moment is measured on the take itself. Solved exactly as one
banded system.
"""

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from mocapfix.kernels import quaternions
from mocapfix.kernels.terms import TrackingTerm
from mocapfix.options import SolveOptions
from mocapfix.solve.pose_problem import PoseUncertainty
from mocapfix.stats.runs import find_runs

# MERGED: mocapfix.solve.temporal
ACCELERATION_STEP_S = 0.06  # seconds over which the course's acceleration is measured
SMOOTHING_POWER_WINDOW_S = 0.25  # seconds over which its power is averaged: a landing is livelier than the flight before it
MAX_POWER_SAMPLE_SD = 0.1  # radians (or metres times ten): frames less certain than this do not tell the power
PEAK_POWER_RATIO = 2.0  # the quickest moments in a window over its average: smoothing must not cost them their speed
GAP_POWER_RATIO = 20.0  # likewise across a gap: a course that is surer than the motion is lively leads it astray
MIN_POWER_SHARE = 0.02  # least power, as a share of the whole take's: a joint held still may yet move
FRAME_JITTER_SD_RAD = 0.02  # radians: what is left of a joint's variance from one frame to the next
MAX_SAMPLE_VARIANCE = (
    1e4  # rad^2 or m^2: the variance of a frame that says nothing; with more the system would be singular to rounding
)
MAX_ROOT_SD_M = 0.1  # metres: a frame that knows its root no better does not know it
MIN_ACCELERATION_POWER = 1e-3  # least power, rad^2/s^3 or m^2/s^3


def smooth_path(path: np.ndarray, variance: np.ndarray, acceleration_power: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, C): argmin over x of sum |x_t - path_t|^2 / variance_t + integral |x''|^2 / power.

    path (T, C); variance (T,) per component; power (T,) in units^2 / s^3; rate in Hz
    """
    frames = len(path)
    if frames < 3:
        return path
    stiff = rate**3 / acceleration_power[1:-1]  # of the second difference about each inner frame
    band = np.zeros((3, frames))
    information = 1 / np.minimum(variance, MAX_SAMPLE_VARIANCE)
    band[2] = information
    for shift, coefficient in ((0, 1.0), (1, 4.0), (2, 1.0)):
        band[2, shift : shift + frames - 2] += coefficient * stiff
    band[1, 1 : frames - 1] -= 2 * stiff
    band[1, 2:] -= 2 * stiff
    band[0, 2:] += stiff
    return np.ascontiguousarray(solveh_banded(band, path * information[:, None], overwrite_ab=True, check_finite=False))


def estimate_acceleration_power(path: np.ndarray, variance: np.ndarray, rate: float, max_sd: float) -> np.ndarray:
    """-> (T,) the power of the random acceleration that a path (T, C) shows, per component, about each frame.

    The second difference of an integrated random acceleration over steps of h has variance 2/3 power h^3. Where the path
    is not well known, the power is that of the nearest moments where it is.
    """
    frames, h = len(path), max(1, round(ACCELERATION_STEP_S * rate))
    if frames < 4 * h:
        return np.ones(frames)
    second = ((path[2 * h :] - 2 * path[h:-h] + path[: -2 * h]) ** 2).mean(1) / (2 / 3 * (h / rate) ** 3)
    known = variance[2 * h :] + 4 * variance[h:-h] + variance[: -2 * h] < 6 * max_sd**2
    window = max(1, round(SMOOTHING_POWER_WINDOW_S * rate))
    amount = uniform_filter1d(np.where(known, second, 0.0), window, mode="nearest")
    share = uniform_filter1d(known.astype(float), window, mode="nearest")
    told = np.flatnonzero(share > 0.1)
    if known.sum() < 4 * h or not len(told):
        return np.ones(frames)
    local = np.interp(np.arange(frames), told + h, amount[told] / share[told])
    return np.maximum(PEAK_POWER_RATIO * np.maximum(local, MIN_POWER_SHARE * second[known].mean()), MIN_ACCELERATION_POWER)


def smooth_quaternions(quaternions: np.ndarray, variance: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 4), not of unit length, the smooth course of one joint's quaternions (T, 4), variance (T,) in rad^2 per axis."""
    return smooth_path(quaternions, variance, estimate_rotation_power(quaternions, variance, rate), rate)


def bridge_quaternions(
    quaternions: np.ndarray, variance: np.ndarray, is_uncertain: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> the course of one joint (T, 4) through the frames that are sure of it, and its variance (T,) at the others."""
    # what makes a joint's place unsure, its markers' places, is the same from frame to frame: the course is known better
    sure = np.where(is_uncertain, MAX_SAMPLE_VARIANCE, np.minimum(variance, FRAME_JITTER_SD_RAD**2))
    power = estimate_rotation_power(quaternions, sure, rate)
    return smooth_path(quaternions, sure, power, rate), compute_gap_variance(is_uncertain, power, rate)


def estimate_rotation_power(quaternions: np.ndarray, variance: np.ndarray, rate: float) -> np.ndarray:
    """-> (T,) rad^2/s^3 per axis: the power that a joint's quaternions (T, 4) show."""
    return (
        estimate_acceleration_power(2 * quaternions, variance, rate, MAX_POWER_SAMPLE_SD) * 4 / 3
    )  # three degrees of freedom in four numbers


def compute_gap_variance(is_uncertain: np.ndarray, acceleration_power: np.ndarray, rate: float) -> np.ndarray:
    """-> (T,) the variance of a course of `power` (T,) at the frames that are unsure, 0 at the others.

    Between two known ends, a and b seconds away, an integrated random acceleration of power q has variance
    q a^3 b^3 / 3 (a + b)^3; beyond the last known end, q a^3 / 3.
    """
    variance = np.zeros(len(is_uncertain))
    for first, last in find_runs(is_uncertain):
        a, b = np.arange(1, last - first + 2) / rate, np.arange(last - first + 1, 0, -1) / rate
        if first == 0:
            a = np.full(len(a), np.inf)
        if last == len(is_uncertain) - 1:
            b = np.full(len(b), np.inf)
        variance[first : last + 1] = (
            GAP_POWER_RATIO * acceleration_power[first : last + 1].mean() / 3 / np.maximum(1 / a + 1 / b, 1e-9) ** 3
        )
    return variance


def smooth_root_path(root_position: np.ndarray, variance: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> (T, 3) metres, the smooth course of the root, and its variance (T,) in frames that hardly tell the root.

    variance  (T,) m^2 per axis, each frame's own
    """
    power = estimate_acceleration_power(root_position, variance, rate, MAX_POWER_SAMPLE_SD / 10)
    return smooth_path(root_position, variance, power, rate), compute_gap_variance(variance > MAX_ROOT_SD_M**2, power, rate)


# MERGED: mocapfix.solve.courses
# The smooth courses of all joints and the root, as pulls on the poses, joint by joint.
#
# A pull to each joint's own course, once, does as well as all poses of a gap solved together with the smoothness between
# them (block-banded Gauss-Newton), in gaps of seconds too, at a small part of the cost; more rounds change little.
# The matrices of all joints over a long take are large, so each function here holds as few of them as it can and says which
# it writes into.
MAX_TRACKING_SD_RAD = 0.5  # radians: the weakest pull to a joint's course


def track_across_gaps(
    local_rotations: np.ndarray, variance: np.ndarray, is_uncertain: np.ndarray, rate: float, options: SolveOptions
) -> tuple[TrackingTerm, np.ndarray]:
    """-> where each joint's course leads while the joint itself is unsure, as a pull as strong as that course is certain,
    and the course's variance (T, J), rad^2, there.

    local (T, J, 3, 3), variance (T, J) rad^2: each frame's own solve; unsure (T, J) bool
    """
    rotations, weight, left_open = local_rotations.copy(), np.zeros(is_uncertain.shape), np.zeros(is_uncertain.shape)
    for j in np.flatnonzero(is_uncertain.any(0)):
        turns = quaternions.extract_joint_quaternions(local_rotations, j, ~is_uncertain[:, j])
        course, left_open[:, j] = bridge_quaternions(turns, variance[:, j], is_uncertain[:, j], rate)
        quaternions.store_joint_quaternions(course, j, rotations)
        weight[:, j] = np.where(is_uncertain[:, j], 1 / (left_open[:, j] + options.rotation_tracking_sd_rad**2), 0.0)
    return TrackingTerm(rotations, weight, np.zeros((len(local_rotations), 3)), np.zeros(len(local_rotations))), left_open


def smooth_poses(
    root: np.ndarray,
    local_rotations: np.ndarray,
    uncertainty: PoseUncertainty,
    free_joints: np.ndarray,
    rate: float,
    options: SolveOptions,
) -> TrackingTerm:
    """-> the smooth course of every free joint and the root, as a pull for each frame. Its rotations lie in `local`.

    root (T, 3) metres, local (T, J, 3, 3) and how far they are known: what is smoothed
    """
    weight, everywhere = np.zeros(local_rotations.shape[:2]), np.ones(len(local_rotations), bool)
    for j in np.flatnonzero(free_joints):
        variance = uncertainty.rotation_variance[:, j]
        course = smooth_quaternions(quaternions.extract_joint_quaternions(local_rotations, j, everywhere), variance, rate)
        quaternions.store_joint_quaternions(course, j, local_rotations)
        doubt = np.minimum(variance, MAX_TRACKING_SD_RAD**2)  # joints that share a turn, as the spine's do, are unsure one by one
        weight[:, j] = 1 / (options.rotation_tracking_sd_rad**2 + doubt)
    smooth_root, left_open = smooth_root_path(root, uncertainty.root_variance, rate)
    return TrackingTerm(local_rotations, weight, smooth_root, 1 / (options.root_tracking_sd_m**2 + left_open))


def remove_pose_jitter(
    root: np.ndarray, local_rotations: np.ndarray, free_joints: np.ndarray, rate: float, options: SolveOptions
) -> np.ndarray:
    """Take from `local` (T, J, 3, 3) the tremble that skin and cameras give each frame of its own. -> root (T, 3) likewise"""
    everywhere, tremble = np.ones(len(local_rotations), bool), np.full(len(local_rotations), options.rotation_jitter_rad**2)
    for j in np.flatnonzero(free_joints):
        course = smooth_quaternions(quaternions.extract_joint_quaternions(local_rotations, j, everywhere), tremble, rate)
        quaternions.store_joint_quaternions(course, j, local_rotations)
    return smooth_root_path(root, np.full(len(root), options.root_jitter_m**2), rate)[0]
