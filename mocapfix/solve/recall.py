"""What a take itself says of a limb it lost: how its joints go with the rest of the body, and with the moments around.

Over the frames in which all is seen, the joints' rotations, the root's tilt, height and velocity have a joint Gaussian
distribution. Where a joint is lost, its expected rotation given those seen follows; what that misses at the gap's edges is
carried across as a course that fades (the same idea as the residual of a filled marker).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels import quaternions
from mocapfix.kernels.course import across
from mocapfix.take import runs

ENOUGH = 2.0  # seconds of wholly seen motion, without which a take cannot tell
MOST = 0.5  # share of the joints: with more of them lost, there is no body left to recall the rest from
FADE = 0.3  # seconds after which the difference at a gap's edge has lost most of its memory
REACH = 0.1  # seconds beside a gap that are listened to
TREMBLE, LEAST = 0.01, 0.1  # radians: what one frame beside a gap cannot tell, and the least that recalling misses by
UNSURE = 0.15  # radians per axis: what a recalled rotation counts as in the smoothing
GRAIN = np.array([0.05] * 3 + [0.05] + [0.2] * 3 + [0.5] * 3)  # differences of tilt, height, velocity, turning that mean nothing
TURN_GRAIN = 0.1  # radians, likewise of joints


def lost_joints(
    root: np.ndarray, local: np.ndarray, variance: np.ndarray, gone: np.ndarray, free: np.ndarray, rate: float
) -> None:
    """Write what the take tells of lost joints into `local` (T, J, 3, 3) and `variance` (T, J), rad^2, where it has seen enough.

    root (T, 3) metres, local and variance: each frame's own solve; gone (T, J) as `listening.lost` says.
    """
    joints = np.flatnonzero(free)[1:]
    whole = ~np.any(gone, axis=1)
    gone = gone & (gone[:, joints].mean(axis=1) <= MOST)[:, None]
    if not gone.any() or whole.sum() < ENOUGH * rate:
        return
    turns = [quaternions.of_joint(local, j, whole) for j in joints]
    mean = [Rotation.from_quat(turn[whole]).mean() for turn in turns]
    away = [quaternions.vectors(turn, m.as_quat()) for turn, m in zip(turns, mean, strict=True)]
    features = np.concatenate([*away, circumstances(root, local[:, 0], rate)], axis=1)
    grain = np.r_[np.full(3 * len(joints), TURN_GRAIN), GRAIN]
    asked = np.flatnonzero(near(np.any(gone, axis=1), rate))
    expected = conditional(features, np.repeat(gone[:, joints], 3, axis=1), whole, asked, grain)
    for i, j in enumerate(joints):
        where = gone[:, j]
        if where.any():
            local[where, j] = corrected(expected[:, 3 * i : 3 * i + 3], mean[i], turns[i], where, rate)
            variance[where, j] = UNSURE**2


def corrected(expected: np.ndarray, mean: Rotation, turns: np.ndarray, where: np.ndarray, rate: float) -> np.ndarray:
    """-> (n, 3, 3) a joint's rotations in the n frames `where` (T,) it is lost: as expected, corrected by what that misses
    beside them.

    expected (T, 3) rotation vectors from the joint's mean; turns (T, 4) quaternions, what the frames' own solve says
    """
    missed, beside = np.full((len(where), 3), np.nan), near(where, rate) & ~where
    guess = Rotation.from_rotvec(expected[beside]) * mean
    missed[beside] = (Rotation.from_quat(turns[beside]) * guess.inv()).as_rotvec()
    course, _, _ = across(missed, where, rate, FADE, REACH, TREMBLE, LEAST)
    return (Rotation.from_rotvec(course[where]) * Rotation.from_rotvec(expected[where]) * mean).as_matrix()


def near(where: np.ndarray, rate: float) -> np.ndarray:
    """-> (T,) bool: within twice the reach of a lost frame, where the edges are listened to."""
    mask = np.zeros_like(where)
    span = 2 * max(1, round(REACH * rate))
    for first, last in runs(where):
        mask[max(0, first - span) : last + span + 1] = True
    return mask


def circumstances(root: np.ndarray, turn: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 10) the root's up direction, height, velocity and turning, all but the height in its own axes."""
    velocity = np.gradient(root, 1 / rate, axis=0)
    step = Rotation.from_matrix(np.swapaxes(turn[:-1], 1, 2) @ turn[1:]).as_rotvec() * rate
    inside = np.swapaxes(turn, 1, 2)
    up, moving = inside[:, :, 1], np.einsum("tab,tb->ta", inside, velocity)
    return np.concatenate([up, root[:, 1:2], moving, np.r_[step, step[-1:]]], 1)


def conditional(features: np.ndarray, gone: np.ndarray, whole: np.ndarray, asked: np.ndarray, grain: np.ndarray) -> np.ndarray:
    """-> (T, 3 J') expected joint features of the frames `asked`, those that are lost given the rest; 0 elsewhere.

    features (T, F), of which the first are the joints'; gone (T, 3 J') which of those are lost in a frame; a frame that
    lost nothing is asked as though it had lost what the nearest frame with a loss has, so that edges can be compared.
    whole (T,) bool: the frames to learn from; asked: indices of frames, rising; grain (F,): differences that mean nothing
    """
    mean = features[whole].mean(0)
    covariance = np.cov((features[whole] - mean).T) + np.diag(grain**2)
    hidden = gone[asked] | gone[nearest(np.flatnonzero(gone.any(1)), asked)]
    first = np.flatnonzero(np.r_[True, np.any(hidden[1:] != hidden[:-1], axis=1)])  # of each stretch of one pattern
    patterns, which = np.unique(hidden[first], axis=0, return_inverse=True)
    which = np.repeat(which.ravel(), np.diff(np.r_[first, len(asked)]))
    expected = np.zeros(gone.shape)
    for p, pattern in enumerate(patterns):
        rows = asked[which == p]
        unknown = np.r_[pattern, np.zeros(features.shape[1] - len(pattern), bool)]
        gain = np.linalg.solve(covariance[np.ix_(~unknown, ~unknown)], covariance[np.ix_(~unknown, unknown)])
        guess = mean[unknown] + (features[np.ix_(rows, ~unknown)] - mean[~unknown]) @ gain
        expected[np.ix_(rows, pattern)] = guess
    return expected


def nearest(among: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """-> for each of `frames` the nearest of `among`, both rising indices; the later of two as near."""
    after = np.searchsorted(among, frames)
    later, earlier = among[np.minimum(after, len(among) - 1)], among[np.maximum(after - 1, 0)]
    return np.where(np.abs(earlier - frames) < np.abs(later - frames), earlier, later)
