"""What a take itself says of a limb it lost: how its joints go with the rest of the body, and with the moments around.

Over the frames in which all is seen, the joints' rotations, the root's tilt, height and velocity have a joint Gaussian
distribution. Where a joint is lost, its expected rotation given those seen follows; what that misses at the gap's edges is
carried across as a course that fades (the same idea as the residual of a filled marker).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels.course import across
from mocapfix.subject import Subject
from mocapfix.take import runs

ENOUGH = 2.0  # seconds of wholly seen motion, without which a take cannot tell
MOST = 0.5  # share of the joints: with more of them lost, there is no body left to recall the rest from
FADE = 0.3  # seconds after which the difference at a gap's edge has lost most of its memory
REACH = 0.1  # seconds beside a gap that are listened to
TREMBLE, LEAST = 0.01, 0.1  # radians: what one frame beside a gap cannot tell, and the least that recalling misses by
UNSURE = 0.15  # radians per axis: what a recalled rotation counts as in the smoothing
GRAIN = np.array([0.05] * 3 + [0.05] + [0.2] * 3 + [0.5] * 3)  # differences of tilt, height, velocity, turning that mean nothing
TURN_GRAIN = 0.1  # radians, likewise of joints


def lost(listened: np.ndarray, subject: Subject, free: np.ndarray) -> np.ndarray:
    """-> (T, J) bool: free joints below the root that no marker tells of: none on them or farther out is there.

    listened (T, K): the subject's markers that the solve listens to
    """
    told = np.zeros((len(listened), len(free)), bool)
    for k, joint in enumerate(subject.joints):
        told[:, joint] |= listened[:, k]
    for j in range(len(free) - 1, 0, -1):
        told[:, subject.skeleton.parents[j]] |= told[:, j]
    carrying = told.any(0)
    return ~told & free & carrying & (np.arange(len(free)) > 0)


def recalled(
    root: np.ndarray, local: np.ndarray, variance: np.ndarray, gone: np.ndarray, free: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> local rotations (T, J, 3, 3) and variances (T, J) with lost joints recalled where the take has seen enough.

    root (T, 3) metres, local (T, J, 3, 3), variance (T, J) rad^2: each frame's own solve; gone (T, J) as `lost` says.
    """
    joints = np.flatnonzero(free)[1:]
    whole = ~np.any(gone, axis=1)
    gone = gone & (gone[:, joints].mean(axis=1) <= MOST)[:, None]
    if not gone.any() or whole.sum() < ENOUGH * rate:
        return local, variance
    mean = np.stack([Rotation.from_matrix(local[whole, j]).mean().as_matrix() for j in joints])
    turns = np.stack([Rotation.from_matrix(local[:, j] @ m.T).as_rotvec() for j, m in zip(joints, mean, strict=True)], 1)
    features = np.concatenate([turns.reshape(len(root), -1), circumstances(root, local[:, 0], rate)], 1)
    grain = np.r_[np.full(3 * len(joints), TURN_GRAIN), GRAIN]
    expected = conditional(features, np.repeat(gone[:, joints], 3, axis=1), whole, grain)
    out, out_variance = local.copy(), variance.copy()
    for i, j in enumerate(joints):
        where = gone[:, j]
        if not where.any():
            continue
        guess = Rotation.from_rotvec(expected[:, 3 * i : 3 * i + 3]).as_matrix() @ mean[i]
        missed = Rotation.from_matrix(local[:, j] @ np.swapaxes(guess, 1, 2)).as_rotvec()
        missed[where | ~near(where, rate)] = np.nan
        course, _, _ = across(missed, where, rate, FADE, REACH, TREMBLE, LEAST)
        out[where, j] = Rotation.from_rotvec(course[where]).as_matrix() @ guess[where]
        out_variance[where, j] = UNSURE**2
    return out, out_variance


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


def conditional(features: np.ndarray, gone: np.ndarray, whole: np.ndarray, grain: np.ndarray) -> np.ndarray:
    """-> (T, 3 J') expected joint features of every frame that lost some, or lies beside one that did, given the rest.

    features (T, F), of which the first are the joints'; gone (T, 3 J') which of those are lost in a frame; a frame that
    lost nothing is asked as though it had lost what the nearest frame with a loss has, so that edges can be compared.
    """
    mean = features[whole].mean(0)
    covariance = np.cov((features[whole] - mean).T) + np.diag(grain**2)
    losing = np.flatnonzero(gone.any(1))
    nearest = losing[np.clip(np.searchsorted(losing, np.arange(len(gone))), 0, len(losing) - 1)]
    before = losing[np.clip(np.searchsorted(losing, np.arange(len(gone))) - 1, 0, len(losing) - 1)]
    frames = np.arange(len(gone))
    closest = np.where(np.abs(before - frames) < np.abs(nearest - frames), before, nearest)
    asked = gone | gone[closest]
    expected = np.zeros_like(gone, float)
    patterns, which = np.unique(asked, axis=0, return_inverse=True)
    for p, pattern in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == p)
        hidden = np.r_[pattern, np.zeros(features.shape[1] - len(pattern), bool)]
        gain = np.linalg.solve(covariance[np.ix_(~hidden, ~hidden)], covariance[np.ix_(~hidden, hidden)])
        guess = mean[hidden] + (features[np.ix_(rows, ~hidden)] - mean[~hidden]) @ gain
        expected[np.ix_(rows, pattern)] = guess
    return expected
