"""A tremble smoothed away: each trembling frame is one more moment that a Gaussian process over the take knows, not well."""

import numpy as np

from mocapfix.solve import state_features
from mocapfix.stats import constant_offsets
from mocapfix.stats.constant_offsets import OffsetModel
from mocapfix.stats.gaussian_process import fit_gaussian_process, select_training_frames

# MERGED: mocapfix.solve.calmed
MIN_STEADY_FRAMES = 3  # frames without a tremble, without which there is nothing to go by
QUATERNION_VARIANCE_RATIO = (
    0.75  # of a turn's variance per axis, that of a number of twice its quaternion: four of them for three axes
)


def smooth_joint_jitter(
    root: np.ndarray,
    local_rotations: np.ndarray,
    quaternions: np.ndarray,
    joints: np.ndarray,
    is_steady: np.ndarray,
    first: int,
    last: int,
    jitter_sd_rad: float,
    rate: float,
) -> tuple[np.ndarray, np.ndarray]:
    """-> the quaternions (n, 4) of one joint over first..last without the tremble, and their variance (n,), rad^2 per axis.

    root (T, 3) metres, local (T, J, 3, 3); quaternions (T, 4) of the joint, without changes of sign
    told   indices of the other joints whose circumstances are asked;  sound (T,): frames that are known, and do not tremble
    size   radians per axis, of the tremble
    """
    span = np.arange(first, last + 1)
    steady = select_training_frames(is_steady & ~np.isin(np.arange(len(is_steady)), span), first, last, rate)
    learn = np.sort(np.r_[steady, span])
    noise = np.where(np.isin(learn, span), QUATERNION_VARIANCE_RATIO * jitter_sd_rad**2, 0.0)
    known = state_features.compute_joint_state_features(root, local_rotations, joints, learn, rate)
    process = fit_gaussian_process(2 * quaternions[learn], known, learn / rate, noise, state_features.RECORDED_ROTATION_KERNEL)
    expected, left = process.predict(known[np.isin(learn, span)], span / rate)
    return expected / np.linalg.norm(expected, axis=1, keepdims=True), left * process.signal_power.sum() / 3


# MERGED: mocapfix.solve.unshifted
# A pop or a flip undone: what lies in it keeps its motion, and is turned back by the amount that lets it go on the smoothest.
OFFSET_CONTEXT_S = 0.3  # seconds on either side of each edge that are asked


def remove_rotation_offset(
    quaternions: np.ndarray, is_sound: np.ndarray, first: int, last: int, rotation_order: str, rate: float
) -> tuple[np.ndarray, float]:
    """-> the quaternions (n, 4) of one joint over first..last without what is off there, and the variance of that, rad^2 per
    axis. turned (T, 4): its quaternions; sound (T,): which are to be believed; order: the joint's axes of rotation, as "ZYX"."""
    inside = make_quaternions_continuous(quaternions[first : last + 1])
    beside = _find_offset_context(is_sound, first, last, rate)
    known = make_quaternions_continuous(quaternions[beside])
    found, variance = _solve_offset(
        2 * known, beside, constant_offsets.build_rotation_offset_models(inside, rotation_order), first, last, rate
    )
    return found / np.linalg.norm(found, axis=1, keepdims=True), variance


def remove_position_offset(
    positions: np.ndarray, is_sound: np.ndarray, first: int, last: int, rate: float
) -> tuple[np.ndarray, float]:
    """-> likewise the places (n, 3) of the root, and the variance in m^2 per axis."""
    beside = _find_offset_context(is_sound, first, last, rate)
    return _solve_offset(
        positions[beside], beside, constant_offsets.build_position_offset_models(positions[first : last + 1]), first, last, rate
    )


def make_quaternions_continuous(quaternions: np.ndarray) -> np.ndarray:
    """-> (T, 4) the same turns without changes of sign from frame to frame."""
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0)
    return quaternions * np.cumprod(np.r_[1.0, signs])[:, None]


def _find_offset_context(is_sound: np.ndarray, first: int, last: int, rate: float) -> np.ndarray:
    frames = max(4, round(OFFSET_CONTEXT_S * rate))
    beside = np.r_[max(0, first - frames) : first, last + 1 : min(len(is_sound), last + 1 + frames)]
    return beside[is_sound[beside]]


def _solve_offset(
    known: np.ndarray, context_frames: np.ndarray, corrections: tuple[OffsetModel, ...], first: int, last: int, rate: float
) -> tuple[np.ndarray, float]:
    frames, count = max(4, round(OFFSET_CONTEXT_S * rate)), last - first + 1
    near = np.unique(np.r_[: min(frames, count), max(0, count - frames) : count])
    return constant_offsets.fit_smoothest_offset(
        known, context_frames / rate, corrections, np.arange(first, last + 1) / rate, near
    )
