"""Smoothing: the smoothest trajectory of each joint that agrees with the frames' own solutions.

Each joint's rotation, as a quaternion, and the root position are smoothed independently of each other. Frames are weighted by the
uncertainty of the pose solve, so that a joint without markers follows the frames around it. The trajectory is modelled as an
integrated random acceleration, whose power at each time is estimated from the take, and solved exactly as a banded system.

The trajectories become tracking terms of the poses, joint by joint. Tracking each joint's own trajectory once gives the same
error as solving all poses of a gap together with the smoothness terms (block-banded Gauss-Newton), also for gaps of seconds, at a
small part of the cost; more rounds change little. The matrices of all joints over a long take are large, so the functions hold as
few of them as possible and document which arguments they overwrite.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import lie
from mocapfix.kernels.forward_kinematics import KinematicTree, compute_local_frames
from mocapfix.kernels.terms import TrackingTerm
from mocapfix.model.motion import PoseUncertainty
from mocapfix.solve import kinematics
from mocapfix.solve.parallel import run_in_parallel, run_over_frames
from mocapfix.stats.sequences import MAX_SAMPLE_VARIANCE, average_windows, find_runs, smooth_path

ROTATION_JITTER_SD_RAD = 0.01  # noise of a joint's rotation from frame to frame, in addition to its motion: skin and cameras
ROOT_JITTER_SD_M = 0.001  # the same of the root's position, per axis
ROTATION_TRACKING_SD_RAD = 0.1  # standard deviation of a joint's rotation about its smooth trajectory
ROOT_TRACKING_SD_M = 0.03  # the same of the root's position, per axis
ACCELERATION_STEP_S = 0.06  # step of the second differences that measure the acceleration
SMOOTHING_POWER_WINDOW_S = 0.25  # of the mean acceleration power; short: a landing has far more than the flight before
MAX_POWER_SAMPLE_SD = 0.1  # rad, above which a frame does not enter the power; for the root a tenth, in metres
MAX_OBSERVED_SAMPLE_SD_RAD = 0.3
"""The same for joints whose markers are visible. Shoulder and elbow share an arm's twist, so that neither is known alone, yet
both turn as the markers show. Without these frames the power of a strike would be that of the quieter moments around it."""
MIN_WINDOW_SHARE = 0.1  # share of usable frames that a window needs to give an estimate of the power
PEAK_POWER_RATIO = 2.0  # assumed power over the window's mean: the fastest motion in a window must not be smoothed away
GAP_POWER_RATIO = 20.0  # the same across a gap, where a trajectory with too small a variance would mislead the solve
MIN_POWER_SHARE = 0.02  # smallest power, as a share of the take's mean: a joint at rest may still start to move
FRAME_JITTER_SD_RAD = 0.02  # part of a joint's standard deviation that is independent from frame to frame
MAX_ROOT_SD_M = 0.1  # standard deviation of the root position above which a frame does not determine it
MIN_ACCELERATION_POWER = 1e-3  # smallest acceleration power, in rad^2/s^3 or m^2/s^3
MAX_POWER_CORRECTIONS = 3  # where smoothing removes more than jitter; the power is low enough after one or two
USUAL_DEVIATION_RATIO = 4.0  # of a deviation that is no jitter to the take's median: a noisy take deviates everywhere
POWER_CORRECTION_EXPONENT = 3
"""Exponent of the factor of the power, whose base is the deviation over the jitter's standard deviation. What smoothing removes
of a motion is inversely proportional to the power at most, so that one correction nearly suffices."""
MAX_TRACKING_SD_RAD = 0.5  # joints that share a rotation, as in the spine, are individually uncertain


def estimate_acceleration_power(
    path: Float[np.ndarray, "T C"], variance: Float[np.ndarray, " T"], rate: float, max_sd: float
) -> Float[np.ndarray, " T"]:
    """Return the power of the random acceleration of a path, per component, about each frame.

    The second difference of an integrated random acceleration over steps of h has the variance 2/3 power h^3. Frames with a
    standard deviation above `max_sd` do not enter; where a window has too few others, the power is interpolated.
    """
    frames, h = len(path), max(1, round(ACCELERATION_STEP_S * rate))
    if frames < 4 * h:
        return np.ones(frames)
    is_known = variance[2 * h :] + 4 * variance[h:-h] + variance[: -2 * h] < 6 * max_sd**2
    window = max(1, round(SMOOTHING_POWER_WINDOW_S * rate))
    usable, power, second = average_acceleration_power(path, is_known, rate, h, window, MIN_WINDOW_SHARE)
    if is_known.sum() < 4 * h or not len(usable):
        return np.ones(frames)
    power = np.interp(np.arange(frames), usable + h, power)
    return np.maximum(PEAK_POWER_RATIO * np.maximum(power, MIN_POWER_SHARE * second[is_known].mean()), MIN_ACCELERATION_POWER)


def average_acceleration_power(
    path: Float[np.ndarray, "T C"], is_used: Bool[np.ndarray, " S"], rate: float, step: int, window: int, min_share: float
) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, " N"], Float[np.ndarray, " S"]]:
    """Return the windows of second differences over `step` frames of which enough are used, the power in each, and by difference.

    The power is that of a random acceleration, per component, averaged over the differences of a window that are used.
    """
    second = ((path[2 * step :] - 2 * path[step:-step] + path[: -2 * step]) ** 2).mean(1) / (2 / 3 * (step / rate) ** 3)
    total, share = average_windows(np.stack([np.where(is_used, second, 0.0), is_used], axis=1), window).T
    usable = np.flatnonzero(share > min_share)
    return usable, total[usable] / share[usable], second


def estimate_rotation_power(
    joint_quaternions: Float[np.ndarray, "T 4"],
    variance: Float[np.ndarray, " T"],
    rate: float,
    max_sd_rad: float = MAX_POWER_SAMPLE_SD,
) -> Float[np.ndarray, " T"]:
    """Return the power of a joint's random angular acceleration, in rad^2/s^3 per axis, from its quaternions."""
    # quaternions are half the angle, and spread three degrees of freedom over four numbers
    return estimate_acceleration_power(2 * joint_quaternions, variance, rate, max_sd_rad) * 4 / 3


def interpolate_quaternions(
    joint_quaternions: Float[np.ndarray, "T 4"], is_uncertain: Bool[np.ndarray, " T"], rate: float
) -> tuple[Float[np.ndarray, "T 4"], Float[np.ndarray, " T"]]:
    """Return one joint's smooth trajectory through its certain frames, and its variance in rad^2 in the others."""
    # the errors of marker offsets are the same in all frames, so the trajectory is known better than each frame
    known_variance = np.where(is_uncertain, MAX_SAMPLE_VARIANCE, FRAME_JITTER_SD_RAD**2)
    power = estimate_rotation_power(joint_quaternions, known_variance, rate)
    return smooth_path(joint_quaternions, known_variance, power, rate), compute_gap_variance(is_uncertain, power, rate)


def compute_gap_variance(
    is_uncertain: Bool[np.ndarray, " T"], acceleration_power: Float[np.ndarray, " T"], rate: float
) -> Float[np.ndarray, " T"]:
    """Return the variance of a smooth trajectory in uncertain frames, 0 in the others.

    Between two known ends, a and b seconds away, an integrated random acceleration of power q has the variance
    q a^3 b^3 / 3 (a + b)^3; beyond the last known end q a^3 / 3.
    """
    variance = np.zeros(len(is_uncertain))
    for first, last in find_runs(is_uncertain):
        a, b = np.arange(1, last - first + 2) / rate, np.arange(last - first + 1, 0, -1) / rate
        if first == 0:
            a = np.full(len(a), np.inf)
        if last == len(is_uncertain) - 1:
            b = np.full(len(b), np.inf)
        power = GAP_POWER_RATIO * acceleration_power[first : last + 1].mean()
        variance[first : last + 1] = power / 3 / np.maximum(1 / a + 1 / b, 1e-9) ** 3
    return variance


def smooth_root_path(
    root_position: Float[np.ndarray, "T 3"], variance: Float[np.ndarray, " T"], rate: float
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, " T"]]:
    """Return the smooth path of the root in metres, and its variance where undetermined, from those of each frame (m^2)."""
    power = estimate_acceleration_power(root_position, variance, rate, MAX_POWER_SAMPLE_SD / 10)
    return smooth_path(root_position, variance, power, rate), compute_gap_variance(variance > MAX_ROOT_SD_M**2, power, rate)


def track_across_gaps(
    local_rotations: Float[np.ndarray, "T J 3 3"], is_uncertain: Bool[np.ndarray, "T J"], rate: float
) -> tuple[TrackingTerm, Float[np.ndarray, "T J"]]:
    """Return a term that tracks uncertain joints' smooth paths through each frame's own solution, and variances in rad^2."""
    rotations, weight, gap_variance = local_rotations.copy(), np.zeros(is_uncertain.shape), np.zeros(is_uncertain.shape)

    def track_joint(j: int) -> None:
        joint = lie.extract_joint_quaternions(local_rotations, j, ~is_uncertain[:, j])
        trajectory, gap_variance[:, j] = interpolate_quaternions(joint, is_uncertain[:, j], rate)
        lie.store_joint_quaternions(trajectory, j, rotations)
        tracking_variance = gap_variance[:, j] + ROTATION_TRACKING_SD_RAD**2
        weight[:, j] = np.where(is_uncertain[:, j], 1 / tracking_variance, 0.0)

    run_in_parallel(track_joint, np.flatnonzero(is_uncertain.any(0)).tolist())
    return TrackingTerm(rotations, weight, np.zeros((len(rotations), 3)), np.zeros(len(rotations))), gap_variance


def smooth_poses(
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    uncertainty: PoseUncertainty,
    is_uncertain: Bool[np.ndarray, "T J"],
    free_joints: Bool[np.ndarray, " J"],
    rate: float,
) -> TrackingTerm:
    """Return a tracking term that follows the smooth trajectories of all free joints and the root.

    Args:
        local_rotations: Overwritten with the smooth rotations, which the term refers to.
        is_uncertain: Joints that lack a marker.
    """
    weight = np.zeros(local_rotations.shape[:2])

    def smooth_joint(j: int) -> None:
        variance = uncertainty.rotation_variance[:, j]
        trajectory = smooth_joint_rotations(local_rotations, j, variance, is_uncertain[:, j], rate)
        lie.store_joint_quaternions(trajectory, j, local_rotations)
        weight[:, j] = compute_tracking_weight(variance)

    run_in_parallel(smooth_joint, np.flatnonzero(free_joints).tolist())
    smooth_root, root_variance = smooth_root_path(root_position, uncertainty.root_variance, rate)
    return TrackingTerm(local_rotations, weight, smooth_root, 1 / (ROOT_TRACKING_SD_M**2 + root_variance))


def smooth_joint_rotations(
    local_rotations: Float[np.ndarray, "T J 3 3"],
    joint: int,
    variance: Float[np.ndarray, " T"],
    is_uncertain: Bool[np.ndarray, " T"],
    rate: float,
) -> Float[np.ndarray, "T 4"]:
    """Return the smooth trajectory of one joint's rotations, whose variance is in rad^2, as quaternions."""
    joint_quaternions = lie.extract_joint_quaternions(local_rotations, joint, np.ones(len(variance), bool))
    observed_variance = np.where(is_uncertain, MAX_SAMPLE_VARIANCE, variance)
    power = estimate_rotation_power(joint_quaternions, observed_variance, rate, MAX_OBSERVED_SAMPLE_SD_RAD)
    if is_uncertain.any():  # what is inferred for a gap is smooth, unlike what markers show
        inferred_power = estimate_rotation_power(joint_quaternions, variance, rate)
        power = np.where(is_uncertain, np.minimum(power, inferred_power), power)
    return smooth_path(joint_quaternions, variance, power, rate)


def compute_tracking_weight(variance: Float[np.ndarray, "*T"]) -> Float[np.ndarray, "*T"]:
    """Return the weight in 1/rad^2 of tracking a smooth trajectory, from the variance in rad^2 of the smoothed rotations."""
    return 1 / (ROTATION_TRACKING_SD_RAD**2 + np.minimum(variance, MAX_TRACKING_SD_RAD**2))


def remove_pose_jitter(
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    is_uncertain: Bool[np.ndarray, "T J"],
    is_unobserved: Bool[np.ndarray, "T J"],
    tree: KinematicTree,
    rate: float,
) -> Float[np.ndarray, "T 3"]:
    """Remove the frame-to-frame jitter caused by skin and cameras from local_rotations, in place; return the root without it.

    World rotations are smoothed: markers determine those of the segments, and how adjacent joints share them much less.

    Args:
        is_uncertain, is_unobserved: Joints that lack some markers, and all: where markers appear or disappear, a jump of the pose
            is no motion.
    """
    is_known = ~is_unobserved
    is_known[1:] &= is_uncertain[1:] == is_uncertain[:-1]
    for j in range(1, len(tree.parents)):
        is_known[:, j] &= is_known[:, tree.parents[j]]
    _, world_rotations = kinematics.compute_tree_poses(tree, root_position, local_rotations)

    def smooth_joint(j: int) -> None:
        joint = lie.extract_joint_quaternions(world_rotations, j, np.ones(len(world_rotations), bool))
        lie.store_joint_quaternions(remove_jitter(joint, is_known[:, j], rate, ROTATION_JITTER_SD_RAD), j, world_rotations)

    run_in_parallel(smooth_joint, np.flatnonzero(tree.free).tolist())
    run_over_frames(compute_local_frames, len(local_rotations), tree, world_rotations, local_rotations)
    return smooth_root_path(root_position, np.full(len(root_position), ROOT_JITTER_SD_M**2), rate)[0]


def remove_jitter(
    joint_quaternions: Float[np.ndarray, "T 4"], is_known: Bool[np.ndarray, " T"], rate: float, jitter_sd_rad: float
) -> Float[np.ndarray, "T 4"]:
    """Return quaternions without jitter, not normalised.

    Where a trajectory is left to one side by more than jitter, the motion is faster than the average of the window from which its
    power was estimated. The power is raised there, so that a strike is not cut short. Jitter changes its side from frame to
    frame: the mean over ACCELERATION_STEP_S has little of it.

    Args:
        is_known: Frames in which the markers determine the rotation; only those, with known neighbours, show a faster motion.
    """
    variance = np.full(len(joint_quaternions), jitter_sd_rad**2)
    power = estimate_rotation_power(joint_quaternions, variance, rate)
    smooth = smooth_path(joint_quaternions, variance, power, rate)
    reach = 2 * max(1, round(ACCELERATION_STEP_S * rate)) + 1
    window = max(1, round(ACCELERATION_STEP_S * rate))
    has_known_neighbours = np.convolve(~is_known, np.ones(2 * reach + 1))[reach : len(is_known) + reach] == 0
    for _ in range(MAX_POWER_CORRECTIONS):
        deviation = average_windows(smooth - joint_quaternions, window)
        deviation_rad = np.where(has_known_neighbours, 2 * np.linalg.norm(deviation, axis=1), 0.0)
        usual_rad = np.median(deviation_rad[has_known_neighbours]) if has_known_neighbours.any() else 0.0
        largest_rad = np.lib.stride_tricks.sliding_window_view(np.pad(deviation_rad, reach // 2), reach).max(axis=1)
        excess = largest_rad / max(jitter_sd_rad, USUAL_DEVIATION_RATIO * usual_rad)
        if not (excess > 1).any():
            break
        power = power * np.maximum(excess, 1.0) ** POWER_CORRECTION_EXPONENT
        smooth = smooth_path(joint_quaternions, variance, power, rate)
    return smooth
