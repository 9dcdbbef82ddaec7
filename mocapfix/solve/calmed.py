"""A tremble smoothed away: each trembling frame is one more moment that a Gaussian process over the take knows, not well."""

import numpy as np

from mocapfix.kernels.gaps import chosen
from mocapfix.kernels.process import learnt
from mocapfix.solve import alike

FEWEST = 3  # frames without a tremble, without which there is nothing to go by
SHARE = 0.75  # of a turn's variance per axis, that of a number of twice its quaternion: four of them for three axes


def turns(
    root: np.ndarray,
    local: np.ndarray,
    quaternions: np.ndarray,
    told: np.ndarray,
    sound: np.ndarray,
    first: int,
    last: int,
    size: float,
    rate: float,
) -> tuple[np.ndarray, np.ndarray]:
    """-> the quaternions (n, 4) of one joint over first..last without the tremble, and their variance (n,), rad^2 per axis.

    root (T, 3) metres, local (T, J, 3, 3); quaternions (T, 4) of the joint, without changes of sign
    told   indices of the other joints whose circumstances are asked;  sound (T,): frames that are known, and do not tremble
    size   radians per axis, of the tremble
    """
    span = np.arange(first, last + 1)
    steady = chosen(sound & ~np.isin(np.arange(len(sound)), span), first, last, rate)
    learn = np.sort(np.r_[steady, span])
    noise = np.where(np.isin(learn, span), SHARE * size**2, 0.0)
    known = alike.circumstances(root, local, told, learn, rate)
    process = learnt(2 * quaternions[learn], known, learn / rate, noise, alike.EXACT)
    expected, left = process.expected(known[np.isin(learn, span)], span / rate)
    return expected / np.linalg.norm(expected, axis=1, keepdims=True), left * process.power.sum() / 3
