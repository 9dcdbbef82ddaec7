"""Moments of a take that are alike, and what one of them says of another: a Gaussian process.

Two moments tell of each other's poses by being near in time, as what moves goes on smoothly (Matern-5/2), or by the body being
in like circumstances: its other joints turned and turning alike, the root as high, as upright, as fast. Of that there are two
parts: a plane through all moments, for what always goes together as both arms do, and a bump about each (Matern-3/2), for what
comes again (Rasmussen and Williams 2006, Eqs. 2.25, 2.26, 4.16, 4.17). So it is a cubic curve across a short gap, a regression
on the take's own motion across a long one, and between them whatever lies between, by how sure each of them is.

The numbers below make the smallest error on CMU's training subjects, arms and legs lost for 0.5 to 2 s. A length for every part
of the body in place of the few here, a slow course through time, or likeness that time wears out, gained less than 2 %.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

MOMENT = 0.067  # seconds before and after, over which turning is measured
TURNED, TURNING = 1.0, 50.0  # radians, radians a second: the differences of joints that count as one
UPRIGHT, HEIGHT = 0.5, 0.5  # of the up vector; metres
SPEED, SPIN = 5.0, 20.0  # metres a second, radians a second, of the root
SMOOTH = 0.3  # seconds over which a joint goes on as it does
LIKE = 0.6  # by how much a bump is wider than a plane is steep
TIME, AGAIN, TOGETHER = 0.06, 1.6, 0.8  # power of the three parts, to be scaled by how lively a joint is
NOISE = 1.5e-4  # likewise: what one moment's own solve is off


def circumstances(root: np.ndarray, local: np.ndarray, told: np.ndarray, frames: np.ndarray, rate: float) -> np.ndarray:
    """-> (N, F) the circumstances of the body at N `frames`, each in units of a difference that counts as one.

    root (T, 3) metres, local (T, J, 3, 3); told: indices of the joints that are asked
    """
    span, last = max(1, round(MOMENT * rate)), len(root) - 1
    before, after = np.maximum(frames - span, 0), np.minimum(frames + span, last)
    seconds = (after - before) / rate + (last == 0)

    def turning(joints: np.ndarray) -> np.ndarray:
        step = np.swapaxes(local[before][:, joints], -1, -2) @ local[after][:, joints]
        return (Rotation.from_matrix(step.reshape(-1, 3, 3)).as_rotvec().reshape(len(frames), -1)) / seconds[:, None]

    inside = np.swapaxes(local[frames, 0], 1, 2)
    moving = np.einsum("tab,tb->ta", inside, root[after] - root[before]) / seconds[:, None]
    turned = local[frames][:, told].reshape(len(frames), -1) / np.sqrt(2)  # a small turn's size is that of its matrix over sqrt 2
    joints, hips = [turned / TURNED, turning(told) / TURNING], [inside[:, :, 1] / UPRIGHT, root[frames, 1:2] / HEIGHT]
    return np.concatenate([*joints, *hips, moving / SPEED, turning(np.array([0])) / SPIN], axis=1)


def expected(
    values: np.ndarray, known: np.ndarray, known_at: np.ndarray, noise: np.ndarray, asked: np.ndarray, asked_at: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> the expectation (A, C) of C courses at A moments, given their `values` (N, C) at N others; its variance (A,), which is
    to be scaled by each course's power; and that power (C,), as the values show it.

    known (N, F), asked (A, F): the circumstances; known_at, asked_at: seconds
    noise (N,) variance of the values beside NOISE, in their unit squared
    """
    middle, mean = known.mean(0), values.mean(0)
    known, asked = known - middle, asked - middle
    scale = max(float(((values - mean) ** 2).mean()), 1e-12)
    among = covariance(known, known_at, known, known_at) + np.diag(NOISE + noise / scale)
    between = covariance(asked, asked_at, known, known_at)
    factor = cho_factor(among, lower=True)
    weights = cho_solve(factor, values - mean)
    alone = TIME + AGAIN + TOGETHER * (asked**2).sum(1)
    left = alone - np.einsum("an,na->a", between, cho_solve(factor, between.T))
    return mean + between @ weights, np.maximum(left, NOISE), ((values - mean) * weights).mean(0)


def covariance(a: np.ndarray, a_at: np.ndarray, b: np.ndarray, b_at: np.ndarray) -> np.ndarray:
    """-> (A, B) of a course at moments in circumstances (A, F) and (B, F), at seconds (A,) and (B,)."""
    time = np.sqrt(5) / SMOOTH * np.abs(a_at[:, None] - b_at)
    together = a @ b.T
    apart = np.sqrt(np.maximum((a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * together, 0.0))
    like = np.sqrt(3) * LIKE * apart
    return TIME * (1 + time + time**2 / 3) * np.exp(-time) + AGAIN * (1 + like) * np.exp(-like) + TOGETHER * together
