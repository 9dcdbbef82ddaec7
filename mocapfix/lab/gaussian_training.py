"""Fitting Gaussian pose models: probabilistic principal component analysis, and a mixture of Gaussians on principal axes."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from mocapfix.errors import SceneError
from mocapfix.lab.settings import MixtureSettings
from mocapfix.solve.pose_prior import GaussianModel, MixtureModel

MIN_NOISE_SD_RAD = np.radians(1.0)  # smaller deviations are noise of the solved motion that the poses come from
MAX_MIXTURE_POSES = 120_000  # EM takes time in proportion, and neighbouring frames are nearly the same pose
INITIAL_FIT_STRIDE = 5  # initial values are compared on every fifth pose, because consecutive frames are nearly the same
MIXTURE_FIT_SUMMARY = """\
Of {} fits to every {}th of {:,} drawn poses, each initialised by k-means, the one of greatest likelihood (converged after {}
iterations) was fitted to all of these (converged after {}). Convergence means that an iteration raises the mean log-likelihood
of a pose by less than {:g}. The poses are projected onto {} principal axes; the mean log-likelihood of a projected pose is
{:.2f}."""


def fit_gaussian_model(
    joint_names: tuple[str, ...],
    reference_rotations: Float[np.ndarray, "J 3 3"],
    pose_vectors: Float[np.ndarray, "N J 3"],
    weights: Float[np.ndarray, " N"],
    max_components: int | None,
) -> GaussianModel:
    """Return the maximum-likelihood model of poses with a noise of at least MIN_NOISE_SD_RAD (Tipping and Bishop, 1999, Eqs. 7,
    8).

    The residual standard deviation of the model is the noise; it is yet to be measured on held-out poses.

    weights         relative weights of the poses
    max_components  None for all components above the noise
    """
    rows = pose_vectors.reshape(len(pose_vectors), -1)
    values, axes = np.linalg.eigh(np.cov(rows.T, bias=True, aweights=weights, dtype=float))
    values, axes = values[::-1], axes[:, ::-1]
    kept = int((values > MIN_NOISE_SD_RAD**2).sum()) if max_components is None else max_components
    noise = max(MIN_NOISE_SD_RAD**2, values[kept:].mean() if kept < len(values) else 0.0)
    kept = min(kept, int((values > noise).sum()))
    w = axes[:, :kept] * np.sqrt(values[:kept] - noise)
    mean = np.average(rows, axis=0, weights=weights).reshape(len(joint_names), 3)
    residual_sd = np.full(len(joint_names), np.sqrt(noise))
    components = w.T.reshape(kept, len(joint_names), 3)
    return GaussianModel(joint_names, reference_rotations, residual_sd, mean, components, float(np.sqrt(noise)))


def fit_mixture_model(
    joint_names: tuple[str, ...],
    reference_rotations: Float[np.ndarray, "J 3 3"],
    pose_vectors: Float[np.ndarray, "N J 3"],
    weights: Float[np.ndarray, " N"],
    settings: MixtureSettings,
    progress: Callable[[str], object],
) -> tuple[MixtureModel, str]:
    """Return the mixture of greatest likelihood out of several fits by expectation maximisation, and a summary of the fit.

    The method is that of Wei and Chai (2011). The residual standard deviation of the model is MIN_NOISE_SD_RAD; it is yet to be
    measured on held-out poses. No component is narrower than MIN_NOISE_SD_RAD along any axis: consecutive frames are nearly the
    same pose, and a component for such frames alone would have infinite likelihood. The mixture is fitted to MAX_MIXTURE_POSES
    poses, drawn by their weights if there are more or if the weights differ.

    Raises SceneError if expectation maximisation does not converge.
    """
    rows = draw_poses(pose_vectors, weights, settings.seed).reshape(-1, pose_vectors[0].size)
    mean, axes = rows.mean(0, dtype=float), compute_principal_axes(rows, settings.variance_share)
    projected = ((rows - mean) @ axes.T).astype(np.float32)  # an iteration takes less than half the time in single precision
    fits: list[GaussianMixture] = []
    for number in range(settings.restarts):
        progress(f"fit {number + 1} of {settings.restarts}")
        unfitted = build_gaussian_mixture(settings, random_state=settings.seed + number)
        fits.append(fit_until_converged(unfitted, projected[::INITIAL_FIT_STRIDE], settings))
    best = max(fits, key=lambda each: each.score(projected))
    progress("fitting all poses")
    initial_values = {"weights_init": best.weights_, "means_init": best.means_, "precisions_init": best.precisions_}
    fit = fit_until_converged(build_gaussian_mixture(settings, **initial_values), projected, settings)
    summary = MIXTURE_FIT_SUMMARY.format(
        settings.restarts,
        INITIAL_FIT_STRIDE,
        len(rows),
        best.n_iter_,
        fit.n_iter_,
        settings.tolerance,
        len(axes),
        fit.score(projected),
    )
    weights, means, covariances = (np.asarray(each, float) for each in (fit.weights_, fit.means_, fit.covariances_))
    shape = (len(joint_names), 3)
    model = MixtureModel(
        joint_names,
        reference_rotations,
        np.full(len(joint_names), MIN_NOISE_SD_RAD),
        mean_vectors=mean.reshape(shape),
        principal_axes=axes.reshape(-1, *shape),
        component_weights=weights,
        component_means=means,
        component_cholesky=np.linalg.cholesky(covariances),
        component_index=np.zeros(1, int),
    )
    return model, summary


def draw_poses(
    pose_vectors: Float[np.ndarray, "N J 3"], weights: Float[np.ndarray, " N"], seed: int
) -> Float[np.ndarray, "M J 3"]:
    """Return all poses if they are few and of equal weight, else as many as a mixture is fitted to, drawn by their weights."""
    if len(pose_vectors) <= MAX_MIXTURE_POSES and weights.min() == weights.max():
        return pose_vectors
    count = min(len(pose_vectors), MAX_MIXTURE_POSES)
    return pose_vectors[np.random.default_rng(seed).choice(len(pose_vectors), count, p=weights / weights.sum())]


def compute_principal_axes(rows: Float[np.ndarray, "N F"], variance_share: float) -> Float[np.ndarray, "P F"]:
    """Return the fewest orthonormal axes along which rows have at least this fraction of their variance."""
    values, axes = np.linalg.eigh(np.cov(rows.T, bias=True, dtype=float))
    kept_share = np.cumsum(values[::-1]) / values.sum()
    return axes.T[::-1][: int(np.searchsorted(kept_share, variance_share)) + 1]


def build_gaussian_mixture(settings: MixtureSettings, **initial_values: Any) -> GaussianMixture:
    """Return a mixture that is yet to be fitted, with initial values by scikit-learn's names."""
    return GaussianMixture(
        settings.components,
        tol=settings.tolerance,
        reg_covar=MIN_NOISE_SD_RAD**2,
        max_iter=settings.max_iterations,
        **initial_values,
    )


def fit_until_converged(mixture: GaussianMixture, rows: Float[np.ndarray, "N P"], settings: MixtureSettings) -> GaussianMixture:
    """Return the mixture, fitted to rows. Raises SceneError if it does not converge."""
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):  # raised as an error below
        mixture.fit(rows)
    if not mixture.converged_:
        raise SceneError(f"EM did not converge in {settings.max_iterations} iterations; raise max_iterations.")
    return mixture
