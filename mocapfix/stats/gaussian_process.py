"""What is lost together, and the moments from which it is learnt what was lost."""

from typing import NamedTuple

import numpy as np

from mocapfix.take import find_runs

# MERGED: mocapfix.kernels.gaps
DENSE_TRAINING_MARGIN_S, TRAINING_STEP_S = (
    0.6,
    1 / 30,
)  # seconds beside a gap that are learnt from densely, and what lies between two frames learnt from
MAX_TRAINING_FRAMES = 200  # frames at most that are learnt from


def group_gaps(missing: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
    """-> (first, last): the columns that are gone (T, J) from then till then, neither longer nor shorter."""
    found: dict[tuple[int, int], list[int]] = {}
    for j in np.flatnonzero(missing.any(axis=0)):
        for gap in find_runs(missing[:, j]):
            found.setdefault(gap, []).append(int(j))
    return {gap: np.array(lost) for gap, lost in found.items()}


def select_training_frames(is_known: np.ndarray, first: int, last: int, rate: float) -> np.ndarray:
    """-> indices of the frames that a gap is learnt from, rising: of those `known` (T,), all beside it but for such as follow
    too soon on one another, and others as many as may be, evenly spread.
    """
    frames = np.flatnonzero(is_known)
    beyond = np.where(frames < first, first - 1 - frames, frames - last - 1)  # frames from the edge
    step = max(1, round(TRAINING_STEP_S * rate))
    beside = beyond < DENSE_TRAINING_MARGIN_S * rate
    near, far = frames[beside & (beyond % step == 0)], frames[~beside]
    count = min(MAX_TRAINING_FRAMES - len(near), len(far))
    spread = far[np.unique(np.linspace(0, len(far) - 1, count).astype(int))] if count > 0 else far[:0]
    return np.sort(np.r_[near, spread])


# MERGED: mocapfix.kernels.process
# A Gaussian process over a take's moments: what is known of a course at some of them says what it is at others.
#
# Two moments tell of each other by being near in time, as what moves goes on smoothly (Matern-5/2), or by the body being in like
# circumstances. Of that there are two parts: a plane through all moments, for what always goes together as both arms do, and a
# bump about each (Matern-3/2), for what comes again (Rasmussen and Williams 2006, Eqs. 2.25, 2.26, 4.16, 4.17). So it is a cubic
# curve across a short gap, a regression on the take's own motion across a long one, and between them whatever lies between, by
# how sure each of them is. The plane alone is the Gaussian over all that is seen, in its dual form.
class StateCovariance(NamedTuple):
    """How far moments tell of each other. Powers are to be scaled by how lively a course is."""

    time_scale_s: float  # seconds over which a course goes on as it does
    similarity_rate: float  # by how much a bump is wider than a plane is steep
    time_power: float  # power of the part that goes on in time
    recurrence_power: float  # of what comes again
    linear_power: float  # of what goes together, per unit of circumstance squared
    noise_power: float  # what one moment's own value is off

    def compute_covariance(
        self, states_a: np.ndarray, times_a_s: np.ndarray, states_b: np.ndarray, times_b_s: np.ndarray
    ) -> np.ndarray:
        """-> (A, B) of a course at moments in circumstances (A, F) and (B, F), at seconds (A,) and (B,)."""
        together = states_a @ states_b.T
        apart = np.sqrt(np.maximum((states_a**2).sum(1)[:, None] + (states_b**2).sum(1) - 2 * together, 0.0))
        like = np.sqrt(3) * self.similarity_rate * apart
        goes_on, comes_again = compute_matern_52(times_a_s[:, None] - times_b_s, self.time_scale_s), (1 + like) * np.exp(-like)
        return self.time_power * goes_on + self.recurrence_power * comes_again + self.linear_power * together


class GaussianProcess(NamedTuple):
    """C courses as their values at N moments tell them."""

    covariance: StateCovariance
    state_mean: np.ndarray  # (F,) of the circumstances
    training_states: np.ndarray  # (N, F) the circumstances, from their middle
    training_times_s: np.ndarray  # (N,) seconds
    value_mean: np.ndarray  # (C,)
    precision: np.ndarray  # (N, N) of the values' covariance
    weights: np.ndarray  # (N, C) the inverse times the values from their mean
    signal_power: np.ndarray  # (C,) of the courses, as the values show it

    def predict(self, states: np.ndarray, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> the expectation (A, C) in circumstances (A, F) at seconds (A,), and its variance (A,), to be scaled by the power."""
        like, states = self.covariance, states - self.state_mean
        between = like.compute_covariance(states, times_s, self.training_states, self.training_times_s)
        alone = like.time_power + like.recurrence_power + like.linear_power * (states**2).sum(1)
        left = alone - np.einsum("an,an->a", between @ self.precision, between)
        return self.value_mean + between @ self.weights, np.maximum(left, like.noise_power)

    def cross_validate_gaps(self, gap_s: float) -> np.ndarray:
        """-> (C,) the mean square of what it misses in stretches so long, each struck out of what it knows in its turn, over
        what it foretells there (power not counted); NaN where fewer than two could be.

        Foretelling a stretch from all others takes no second factorisation: with K the covariance, its error is the inverse
        of K^-1's own block times the stretch's weights (Rasmussen and Williams 2006, Eq. 5.12, of more than one value).
        """
        stretch = ((self.training_times_s - self.training_times_s[0]) // gap_s).astype(int)
        squares = []
        for each in np.unique(stretch):
            out = np.flatnonzero(stretch == each)
            if 2 * len(out) <= len(stretch):
                left = np.linalg.inv(self.precision[np.ix_(out, out)])
                squares.append(((left @ self.weights[out]) ** 2 / np.diag(left)[:, None]).mean(0))
        return np.mean(squares, 0) if len(squares) > 1 else np.full(len(self.value_mean), np.nan)


def fit_gaussian_process(
    values: np.ndarray, states: np.ndarray, times_s: np.ndarray, noise_variance: np.ndarray, covariance: StateCovariance
) -> GaussianProcess:
    """-> the process of C courses, given their `values` (N, C) at N moments.

    known (N, F) the circumstances, each in units of a difference that counts as one; known_at seconds
    noise (N,) variance of the values beside the likeness' own, in their unit squared
    """
    middle, mean = states.mean(0), values.mean(0)
    states, values = states - middle, values - mean
    scale = max(float((values**2).mean()), 1e-12)
    among = covariance.compute_covariance(states, times_s, states, times_s) + np.diag(
        covariance.noise_power + noise_variance / scale
    )
    inverse = np.linalg.inv(among)
    weights = inverse @ values
    return GaussianProcess(covariance, middle, states, times_s, mean, inverse, weights, (values * weights).mean(0))


def compute_matern_52(lag_s: np.ndarray, time_scale_s: float) -> np.ndarray:
    """-> the correlation (Matern-5/2) of a course at moments so far apart."""
    time = np.sqrt(5) / time_scale_s * np.abs(lag_s)
    return (1 + time + time**2 / 3) * np.exp(-time)
