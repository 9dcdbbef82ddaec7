"""What a take itself says of a whole figure that was lost: how it went, at other times, between edges like these.

Every stretch of the take as long as the gap shows what the course around it would have missed there (see `bridged`). Where its
two edges are like the gap's, the gap will have missed the same: a Gaussian process over the stretches, in the circumstances of
their edges, foretells it. Between edges that nothing in the take is like, that is nothing.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels import offsets
from mocapfix.kernels.process import Likeness, learnt
from mocapfix.solve import alike

MOST, FEWEST = 250, 8  # stretches that are learnt from
LIKENESS = Likeness(smooth=1.0, like=0.5, time=0.0, again=1.6, together=0.0, noise=0.05)
WAY = 1.0  # metres between the edges: the difference that counts as one


def missed(
    root: np.ndarray,
    local: np.ndarray,
    turned: np.ndarray,
    sound: np.ndarray,
    weights: np.ndarray,
    near: np.ndarray,
    first: int,
    last: int,
    rate: float,
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """-> what the course around a gap misses, (n, J, 3) radians in the turned axes and (n, 3) metres in the heading before the
    gap, and the part of its power that stays unknown; None where nothing in the take tells.

    root (T, 3) metres, local and turned (T, J, 3, 3) in the parents' axes and in the world; sound (T,): frames that are known
    weights (n, N) by which the course at a gap's n frames follows from N frames, `near` (N,) the gap's first frame, rising
    """
    count, span = last - first + 1, max(1, round(alike.MOMENT * rate))
    reach = np.unique(np.r_[near - first, -1 - 2 * span, count + 2 * span, np.arange(-1, count + 1)])
    starts = np.arange(-reach.min(), len(root) - reach.max())
    starts = starts[[bool(sound[start + reach].all()) for start in starts]]
    if len(starts) < FEWEST or not 2 * span < first < len(root) - count - 2 * span:
        return None
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, min(MOST, len(starts))).astype(int))]
    away = [_off(turned, root, weights, near - first, start, count) for start in starts]
    known = edges(root, local, np.r_[starts, first], count, span, rate)
    process = learnt(np.array(away), known[:-1], np.zeros(len(starts)), np.zeros(len(starts)), LIKENESS)
    expected, left = process.expected(known[-1:], np.zeros(1))
    both = expected.reshape(count, -1, 3)
    return both[:, :-1], both[:, -1], float(left[0] / (LIKENESS.again + LIKENESS.noise))


def edges(root: np.ndarray, local: np.ndarray, starts: np.ndarray, count: int, span: int, rate: float) -> np.ndarray:
    """-> (S, F) the circumstances at both edges of stretches of `count` frames, and how far and by how much of a turn they lie
    apart, each in units of a difference that counts as one."""
    before, after, told = starts - 1 - span, starts + count + span, np.arange(1, local.shape[1])
    back = np.swapaxes(heading(local[before, 0]), -1, -2)
    way = (back @ (root[after] - root[before])[..., None])[..., 0] / WAY
    turn = (np.swapaxes(local[before, 0], -1, -2) @ local[after, 0]).reshape(len(starts), 9) / np.sqrt(2)
    return np.concatenate([*(alike.circumstances(root, local, told, each, rate) for each in (before, after)), way, turn], axis=1)


def heading(rotations: np.ndarray) -> np.ndarray:
    """-> (..., 3, 3) the turns about the vertical that bring Z below where rotations (..., 3, 3) bring it."""
    angle = np.arctan2(rotations[..., 0, 2], rotations[..., 2, 2])
    return Rotation.from_euler("y", angle.reshape(-1, 1)).as_matrix().reshape(rotations.shape)


def _off(turned: np.ndarray, root: np.ndarray, weights: np.ndarray, near: np.ndarray, start: int, count: int) -> np.ndarray:
    """-> (n * (J + 1) * 3,) what the course around a stretch misses."""
    quaternions = Rotation.from_matrix(turned[np.r_[start + near, start : start + count]].reshape(-1, 3, 3)).as_quat()
    quaternions = quaternions.reshape(-1, turned.shape[1], 4)
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    known, true = quaternions[: len(near)].copy(), quaternions[len(near) :]
    known[1:] *= np.cumprod(signs[: len(near) - 1], axis=0)
    guess = np.einsum("gn,njc->gjc", weights, known)
    guess /= np.linalg.norm(guess, axis=-1, keepdims=True)
    off = offsets.product(guess * [-1, -1, -1, 1], true)
    turn = 2 * off[..., :3] * np.where(off[..., 3:] < 0, -1.0, 1.0)
    place = (root[start : start + count] - weights @ root[start + near]) @ heading(turned[start - 1, 0])
    return np.concatenate([turn.reshape(count, -1), place], axis=1).ravel()
