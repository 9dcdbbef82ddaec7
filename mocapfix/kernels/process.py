"""A Gaussian process over a take's moments: what is known of a course at some of them says what it is at others.

Two moments tell of each other by being near in time, as what moves goes on smoothly (Matern-5/2), or by the body being in like
circumstances. Of that there are two parts: a plane through all moments, for what always goes together as both arms do, and a
bump about each (Matern-3/2), for what comes again (Rasmussen and Williams 2006, Eqs. 2.25, 2.26, 4.16, 4.17). So it is a cubic
curve across a short gap, a regression on the take's own motion across a long one, and between them whatever lies between, by
how sure each of them is. The plane alone is the Gaussian over all that is seen, in its dual form.
"""

from typing import NamedTuple

import numpy as np


class Likeness(NamedTuple):
    """How far moments tell of each other. Powers are to be scaled by how lively a course is."""

    smooth: float  # seconds over which a course goes on as it does
    like: float  # by how much a bump is wider than a plane is steep
    time: float  # power of the part that goes on in time
    again: float  # of what comes again
    together: float  # of what goes together, per unit of circumstance squared
    noise: float  # what one moment's own value is off

    def covariance(self, a: np.ndarray, a_at: np.ndarray, b: np.ndarray, b_at: np.ndarray) -> np.ndarray:
        """-> (A, B) of a course at moments in circumstances (A, F) and (B, F), at seconds (A,) and (B,)."""
        together = a @ b.T
        apart = np.sqrt(np.maximum((a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * together, 0.0))
        like = np.sqrt(3) * self.like * apart
        goes_on, comes_again = matern(a_at[:, None] - b_at, self.smooth), (1 + like) * np.exp(-like)
        return self.time * goes_on + self.again * comes_again + self.together * together


class Process(NamedTuple):
    """C courses as their values at N moments tell them."""

    likeness: Likeness
    middle: np.ndarray  # (F,) of the circumstances
    known: np.ndarray  # (N, F) the circumstances, from their middle
    known_at: np.ndarray  # (N,) seconds
    mean: np.ndarray  # (C,)
    inverse: np.ndarray  # (N, N) of the values' covariance
    weights: np.ndarray  # (N, C) the inverse times the values from their mean
    power: np.ndarray  # (C,) of the courses, as the values show it

    def expected(self, asked: np.ndarray, asked_at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> the expectation (A, C) in circumstances (A, F) at seconds (A,), and its variance (A,), to be scaled by the power."""
        like, asked = self.likeness, asked - self.middle
        between = like.covariance(asked, asked_at, self.known, self.known_at)
        alone = like.time + like.again + like.together * (asked**2).sum(1)
        left = alone - np.einsum("an,an->a", between @ self.inverse, between)
        return self.mean + between @ self.weights, np.maximum(left, like.noise)

    def missed(self, seconds: float) -> np.ndarray:
        """-> (C,) the mean square of what it misses in stretches so long, each struck out of what it knows in its turn, over
        what it foretells there (power not counted); NaN where fewer than two could be.

        Foretelling a stretch from all others takes no second factorisation: with K the covariance, its error is the inverse
        of K^-1's own block times the stretch's weights (Rasmussen and Williams 2006, Eq. 5.12, of more than one value).
        """
        stretch = ((self.known_at - self.known_at[0]) // seconds).astype(int)
        squares = []
        for each in np.unique(stretch):
            out = np.flatnonzero(stretch == each)
            if 2 * len(out) <= len(stretch):
                left = np.linalg.inv(self.inverse[np.ix_(out, out)])
                squares.append(((left @ self.weights[out]) ** 2 / np.diag(left)[:, None]).mean(0))
        return np.mean(squares, 0) if len(squares) > 1 else np.full(len(self.mean), np.nan)


def learnt(values: np.ndarray, known: np.ndarray, known_at: np.ndarray, noise: np.ndarray, likeness: Likeness) -> Process:
    """-> the process of C courses, given their `values` (N, C) at N moments.

    known (N, F) the circumstances, each in units of a difference that counts as one; known_at seconds
    noise (N,) variance of the values beside the likeness' own, in their unit squared
    """
    middle, mean = known.mean(0), values.mean(0)
    known, values = known - middle, values - mean
    scale = max(float((values**2).mean()), 1e-12)
    among = likeness.covariance(known, known_at, known, known_at) + np.diag(likeness.noise + noise / scale)
    inverse = np.linalg.inv(among)
    weights = inverse @ values
    return Process(likeness, middle, known, known_at, mean, inverse, weights, (values * weights).mean(0))


def matern(seconds: np.ndarray, smooth: float) -> np.ndarray:
    """-> the correlation (Matern-5/2) of a course at moments so far apart."""
    time = np.sqrt(5) / smooth * np.abs(seconds)
    return (1 + time + time**2 / 3) * np.exp(-time)
