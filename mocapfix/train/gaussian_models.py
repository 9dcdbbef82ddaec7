"""Fitting a Gaussian to poses: probabilistic principal components (Tipping and Bishop, 1999, Eqs. 7 and 8)."""

import warnings
from collections.abc import Callable

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from mocapfix.errors import SceneError
from mocapfix.pose_prior.gaussian import GaussianModel
from mocapfix.pose_prior.mixture import MixtureModel
from mocapfix.train.settings import MixtureSettings

# MERGED: mocapfix.train.linear
MIN_NOISE_SD_RAD = np.radians(1.0)  # what stands out by less is noise of the solve that the poses come from


def fit_gaussian_model(
    joint_names: tuple[str, ...], reference_rotations: np.ndarray, pose_vectors: np.ndarray, max_components: int | None
) -> GaussianModel:
    """-> the maximum-likelihood model of poses (N, J, 3), but for a noise of at least FLOOR; its sigma is still the noise.

    components  at most so many; None for all that stand out
    """
    rows = pose_vectors.reshape(len(pose_vectors), -1)
    values, axes = np.linalg.eigh(np.cov(rows.T, bias=True, dtype=float))
    values, axes = values[::-1], axes[:, ::-1]
    kept = int((values > MIN_NOISE_SD_RAD**2).sum()) if max_components is None else max_components
    noise = max(MIN_NOISE_SD_RAD**2, values[kept:].mean() if kept < len(values) else 0.0)
    kept = min(kept, int((values > noise).sum()))
    w = axes[:, :kept] * np.sqrt(values[:kept] - noise)
    mean = rows.mean(0, dtype=float).reshape(len(joint_names), 3)
    sigma = np.full(len(joint_names), np.sqrt(noise))
    return GaussianModel(
        joint_names, reference_rotations, sigma, mean, w.T.reshape(kept, len(joint_names), 3), float(np.sqrt(noise))
    )


# MERGED: mocapfix.train.mixture
# Fitting a mixture of Gaussians to poses, as Wei and Chai do: principal components, then expectation maximisation in these.
INITIAL_FIT_STRIDE = 5  # poses: the beginnings are compared on every fifth, for frames that follow each other say the same
MIXTURE_FIT_SUMMARY = """\
Of {} fits to every {}th pose, each from where k-means begins, the likeliest was taken (at rest after {} iterations), and fitted
to all (at rest after {}): an iteration raised the mean log-likelihood of a pose by less than {:g}. The reduced space has {} axes;
a pose's mean log-likelihood in it is {:.2f}."""


def fit_mixture_model(
    joint_names: tuple[str, ...],
    reference_rotations: np.ndarray,
    pose_vectors: np.ndarray,
    settings: MixtureSettings,
    progress: Callable[[str], None],
) -> tuple[MixtureModel, str]:
    """-> the likeliest of some mixtures fitted to poses (N, J, 3), its sigma still the floor; and how it was fitted, in words.

    No component is narrower than FLOOR along any axis: frames that follow each other are all but the same pose, and a component
    of such alone would be infinitely likely.

    Raises SceneError where expectation maximisation does not come to rest.
    """
    rows = pose_vectors.reshape(len(pose_vectors), -1)
    mean, axes = rows.mean(0, dtype=float), compute_principal_axes(rows, settings.variance_share)
    reduced = ((rows - mean) @ axes.T).astype(np.float32)  # in single precision each iteration takes less than half the time
    starts = []
    for number in range(settings.restarts):
        progress(f"fit {number + 1} of {settings.restarts}")
        starts.append(
            fit_until_converged(
                build_gaussian_mixture(settings, random_state=settings.seed + number), reduced[::INITIAL_FIT_STRIDE], settings
            )
        )
    best = max(starts, key=lambda each: each.score(reduced))
    progress("fitting the likeliest to all poses")
    begun = {"weights_init": best.weights_, "means_init": best.means_, "precisions_init": best.precisions_}
    found, shape = fit_until_converged(build_gaussian_mixture(settings, **begun), reduced, settings), (len(joint_names), 3)
    told = MIXTURE_FIT_SUMMARY.format(
        settings.restarts, INITIAL_FIT_STRIDE, best.n_iter_, found.n_iter_, settings.tolerance, len(axes), found.score(reduced)
    )
    weights, centres, covariances = (np.asarray(each, float) for each in (found.weights_, found.means_, found.covariances_))
    return MixtureModel(
        joint_names, reference_rotations, np.full(len(joint_names), MIN_NOISE_SD_RAD), mean.reshape(shape), axes.reshape(-1, *shape), weights, centres,
        np.linalg.cholesky(covariances), np.zeros(1, int),
    ), told  # fmt: skip


def compute_principal_axes(rows: np.ndarray, variance_share: float) -> np.ndarray:
    """-> (P, F) the fewest orthonormal axes along which rows (N, F) have at least this part of their variance."""
    values, axes = np.linalg.eigh(np.cov(rows.T, bias=True, dtype=float))
    kept = np.cumsum(values[::-1]) / values.sum()
    return axes.T[::-1][: int(np.searchsorted(kept, variance_share)) + 1]


def build_gaussian_mixture(settings: MixtureSettings, **initial_values) -> GaussianMixture:
    """-> one that is still to be fitted, and where it begins."""
    return GaussianMixture(
        settings.components,
        tol=settings.tolerance,
        reg_covar=MIN_NOISE_SD_RAD**2,
        max_iter=settings.max_iterations,
        **initial_values,
    )


def fit_until_converged(mixture: GaussianMixture, rows: np.ndarray, settings: MixtureSettings) -> GaussianMixture:
    """-> the mixture, fitted to rows (N, P)."""
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):  # said below
        mixture.fit(rows)
    if not mixture.converged_:
        raise SceneError(f"The mixture did not come to rest in {settings.max_iterations} iterations; allow more (most).")
    return mixture
