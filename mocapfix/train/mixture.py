"""Fitting a mixture of Gaussians to poses, as Wei and Chai do: principal components, then expectation maximisation in these."""

import warnings
from collections.abc import Callable

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from mocapfix.errors import SceneError
from mocapfix.prior.mixture import Mixture
from mocapfix.train.linear import FLOOR
from mocapfix.train.settings import MixtureSettings

EVERY = 5  # poses: the beginnings are compared on every fifth, for frames that follow each other say the same
TOLD = """\
Of {} fits to every {}th pose, each from where k-means begins, the likeliest was taken (at rest after {} iterations), and fitted
to all (at rest after {}): an iteration raised the mean log-likelihood of a pose by less than {:g}. The reduced space has {} axes;
a pose's mean log-likelihood in it is {:.2f}."""


def fit(
    joints: tuple[str, ...], middle: np.ndarray, vectors: np.ndarray, settings: MixtureSettings, progress: Callable[[str], None]
) -> tuple[Mixture, str]:
    """-> the likeliest of some mixtures fitted to poses (N, J, 3), its sigma still the floor; and how it was fitted, in words.

    No component is narrower than FLOOR along any axis: frames that follow each other are all but the same pose, and a component
    of such alone would be infinitely likely.

    Raises SceneError where expectation maximisation does not come to rest.
    """
    rows = vectors.reshape(len(vectors), -1)
    mean, axes = rows.mean(0, dtype=float), principal(rows, settings.variance)
    reduced = ((rows - mean) @ axes.T).astype(np.float32)  # in single precision each iteration takes less than half the time
    starts = []
    for number in range(settings.fits):
        progress(f"fit {number + 1} of {settings.fits}")
        starts.append(rested(mixture(settings, random_state=settings.seed + number), reduced[::EVERY], settings))
    best = max(starts, key=lambda each: each.score(reduced))
    progress("fitting the likeliest to all poses")
    begun = {"weights_init": best.weights_, "means_init": best.means_, "precisions_init": best.precisions_}
    found, shape = rested(mixture(settings, **begun), reduced, settings), (len(joints), 3)
    told = TOLD.format(settings.fits, EVERY, best.n_iter_, found.n_iter_, settings.tolerance, len(axes), found.score(reduced))
    weights, centres, covariances = (np.asarray(each, float) for each in (found.weights_, found.means_, found.covariances_))
    return Mixture(
        joints, middle, np.full(len(joints), FLOOR), mean.reshape(shape), axes.reshape(-1, *shape), weights, centres,
        np.linalg.cholesky(covariances), np.zeros(1, int),
    ), told  # fmt: skip


def principal(rows: np.ndarray, part: float) -> np.ndarray:
    """-> (P, F) the fewest orthonormal axes along which rows (N, F) have at least this part of their variance."""
    values, axes = np.linalg.eigh(np.cov(rows.T, bias=True, dtype=float))
    kept = np.cumsum(values[::-1]) / values.sum()
    return axes.T[::-1][: int(np.searchsorted(kept, part)) + 1]


def mixture(settings: MixtureSettings, **begun) -> GaussianMixture:
    """-> one that is still to be fitted, and where it begins."""
    return GaussianMixture(settings.components, tol=settings.tolerance, reg_covar=FLOOR**2, max_iter=settings.most, **begun)


def rested(found: GaussianMixture, rows: np.ndarray, settings: MixtureSettings) -> GaussianMixture:
    """-> the mixture, fitted to rows (N, P)."""
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):  # said below
        found.fit(rows)
    if not found.converged_:
        raise SceneError(f"The mixture did not come to rest in {settings.most} iterations; allow more (most).")
    return found
