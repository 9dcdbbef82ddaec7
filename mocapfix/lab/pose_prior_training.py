"""Training of a pose prior: fit a model, measure it on held-out subjects, write weights and card.

The models are an autoencoder, probabilistic principal component analysis, or a mixture of Gaussians on principal axes.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from mocapfix.errors import SceneError
from mocapfix.lab.autoencoder_training import train_network
from mocapfix.lab.cards import CardData, format_table, write_card, write_pose_model
from mocapfix.lab.networks import copy_weights
from mocapfix.lab.settings import AutoencoderSettings, GaussianSettings, MixtureSettings, PriorSettings, SubjectSettings
from mocapfix.lab.training_poses import TrainingPoses, compute_sampling_weights, conform_training_poses, gather_training_poses
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.solve.pose_prior import GaussianModel, MixtureModel, PoseModel
from mocapfix.solve.trained_priors import AutoencoderModel

# Measured standard deviations are multiplied by this: the held-out subjects are few, and measurements shall outweigh the prior.
SD_INFLATION = 2.5
MIN_RESIDUAL_SD_RAD = np.radians(1.0)  # lower bound of a joint's standard deviation
SCORE_STRIDE = 10  # the score of training poses is measured on every tenth pose


PRIOR_SCORES = """\
Error of a pose that is encoded and decoded, mean over frames and all joints except the root:

{table}

A code has {code_size} dimensions; the root mean square of the codes of held-out subjects is {code_rms:.2f}, where the model
assumes 1. The standard deviation of a pose around the decoded pose is {low:.1f} to {high:.1f} degrees per axis, its median
{median:.1f}.

A better reconstruction does not make a better prior: choose a prior by its results in the solver."""


@dataclass(frozen=True)
class PriorScores:
    """The accuracy of a pose prior."""

    # training_deg, held_out_deg: degrees: mean reconstruction error of training and held-out poses over all joints except the
    # root
    training_deg: float
    held_out_deg: float
    code_rms: float  # root mean square of the codes of held-out poses


def train_pose_prior(
    settings: PriorSettings, folders: Sequence[Path], target: Path, progress: Callable[[str], object]
) -> PriorScores:
    """Train a model, write it to `target` and its card to the same path with the suffix .md, and return its scores.

    Interrupted training of an autoencoder continues from `target` with the suffix .checkpoint when it is started again.

    Raises:
        ReadError: If the folders hold no motion of the required subjects.
        WriteError: If the files cannot be written.
    """
    skeleton = load_cmu31_body().skeleton
    reference_rotations = load_mean_pose_prior("mean-pose", skeleton).mean_rotations
    test, held_out = settings.test_subjects, settings.held_out_subjects
    gathered = gather_training_poses(folders, reference_rotations, test, held_out, progress)
    poses = conform_training_poses(gathered, skeleton.names, settings.subject_balance)
    checkpoint = target.with_suffix(".checkpoint")
    model, fit_summary = fit_pose_model(settings, skeleton.names, reference_rotations, poses, checkpoint, progress)
    progress("measuring")
    vectors = select_measured_poses(poses)
    model = replace(model, residual_sd_rad=compute_residual_sd(model, vectors))
    scores = compute_prior_scores(model, poses)
    write_pose_model(target, model)
    use = f"{describe_pose_use(poses)}{fit_summary and f'{chr(10) * 2}{fit_summary}'}"
    data, scored = build_card_data(settings, poses), format_prior_scores(model, scores)
    write_card(target.with_suffix(".md"), settings, data, "Trained by `mocapfix train prior` on", use, scored)
    checkpoint.unlink(missing_ok=True)
    return scores


def fit_pose_model(
    settings: PriorSettings,
    joint_names: tuple[str, ...],
    reference_rotations: Float[np.ndarray, "J 3 3"],
    poses: TrainingPoses,
    checkpoint: Path,
    progress: Callable[[str], object],
) -> tuple[PoseModel, str]:
    """Return a model whose residual standard deviations are yet to be measured, and a summary of the fit for its card."""
    if isinstance(settings, AutoencoderSettings):
        return fit_autoencoder(settings, joint_names, reference_rotations, poses, checkpoint, progress), ""
    progress("fitting")
    weights = compute_pose_weights(settings, poses)
    if isinstance(settings, GaussianSettings):
        components = settings.components if isinstance(settings.components, int) else None
        return fit_gaussian_model(joint_names, reference_rotations, poses.training_vectors, weights, components), ""
    return fit_mixture_model(joint_names, reference_rotations, poses.training_vectors, weights, settings, progress)


def compute_pose_weights(settings: PriorSettings, poses: TrainingPoses) -> Float[np.ndarray, " N"]:
    """Return the relative frequencies of the training poses by the settings."""
    is_retargeted, weight = poses.is_retargeted, settings.retargeted_weight
    return compute_sampling_weights(poses.subject_index, settings.subject_balance, is_retargeted, weight)


def fit_autoencoder(
    settings: AutoencoderSettings,
    joint_names: tuple[str, ...],
    reference_rotations: Float[np.ndarray, "J 3 3"],
    poses: TrainingPoses,
    checkpoint: Path,
    progress: Callable[[str], object],
) -> PoseModel:
    """Return a trained autoencoder with the distribution of its code; its residual standard deviations are yet to be measured."""
    training_vectors, weights = poses.training_vectors, compute_pose_weights(settings, poses)
    trained = train_network(reference_rotations, training_vectors, weights, settings, checkpoint, progress)
    architecture, residual_model = trained.architecture, trained.residual_model
    noise, directions = (
        SD_INFLATION * each.detach().numpy().astype(float)
        for each in (residual_model.feature_sd, residual_model.residual_directions)
    )
    residual_sd = np.maximum(np.sqrt((noise.reshape(len(joint_names), 3) ** 2).mean(1)), MIN_RESIDUAL_SD_RAD)
    size = architecture.code_size
    unscaled = AutoencoderModel(
        joint_names,
        reference_rotations,
        residual_sd,
        architecture,
        copy_weights(trained.network),
        code_mean=np.zeros(size),
        code_cholesky=np.eye(size),
        residual_directions=directions.reshape(architecture.residual_directions, len(joint_names), 3),
    )
    codes = unscaled.encode(training_vectors)[:, :size]
    covariance = np.cov(codes.T).reshape(size, size)
    regularisation = 1e-6 * np.trace(covariance) / size  # for code dimensions that the network does not use
    cholesky = SD_INFLATION * np.linalg.cholesky(covariance + regularisation * np.eye(size))
    return replace(unscaled, code_mean=codes.mean(0), code_cholesky=cholesky)


def describe_pose_use(poses: TrainingPoses) -> str:
    """Return what a card says on the use of training poses."""
    dropped = f"{poses.dropped_frames:,} more frames, beyond a jump in the solved motion, were not used."
    return f", each also mirrored,\nwithout position and heading. {dropped}"


def build_card_data(settings: SubjectSettings, poses: TrainingPoses) -> CardData:
    """Return what a card says on the motion that poses come from."""
    counts, names = poses.frame_counts, settings.held_out_subjects
    trained_on, held_out = ({s: n for s, n in counts.items() if (s in names) == is_held} for is_held in (False, True))
    return CardData(trained_on, held_out, poses.source_frames, is_conformed=True)


def format_prior_scores(model: PoseModel, scores: PriorScores) -> str:
    """Return the scores of a card."""
    low, median, high = np.degrees(np.percentile(model.residual_sd_rad[1:], [0, 50, 100]))
    rows = {"subjects trained on": [scores.training_deg], "held-out subjects": [scores.held_out_deg]}
    return PRIOR_SCORES.format(
        table=format_table(["", "degrees"], rows, ".2f"),
        code_size=model.code_size,
        code_rms=scores.code_rms,
        low=low,
        median=median,
        high=high,
    )


def select_measured_poses(poses: TrainingPoses) -> Float[np.ndarray, "N J 3"]:
    """Return the held-out poses that are not retargeted, whose joints have all been measured; all of them if there are none."""
    is_measured = ~poses.is_retargeted[poses.held_out_index]
    return poses.held_out_vectors[is_measured] if is_measured.any() else poses.held_out_vectors


def compute_reconstruction_error(model: PoseModel, pose_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, "N J"]:
    """Return the angles in radians between poses and the decoded poses of their codes."""
    model = model.select_components(pose_vectors)
    decoded = model.decode(model.encode(pose_vectors))
    difference = Rotation.from_rotvec(pose_vectors.reshape(-1, 3)) * Rotation.from_rotvec(decoded.reshape(-1, 3)).inv()
    return difference.magnitude().reshape(pose_vectors.shape[:2])


def compute_residual_sd(model: PoseModel, held_out_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, " J"]:
    """Return the standard deviations per axis in radians of held-out poses around their decoded poses, inflated by SD_INFLATION.

    That of the root's tilt is not inflated: the solver is then most accurate for people that the model was not trained on.
    """
    inflation = np.where(np.arange(len(model.joint_names)) == 0, 1.0, SD_INFLATION)
    error = compute_reconstruction_error(model, held_out_vectors)
    return np.maximum(inflation * np.sqrt((error**2).mean(0) / 3), MIN_RESIDUAL_SD_RAD)


def compute_prior_scores(model: PoseModel, poses: TrainingPoses) -> PriorScores:
    """Return the reconstruction errors of training and held-out poses, and the root mean square of the held-out codes."""
    training_deg, held_out_deg = (
        np.degrees(compute_reconstruction_error(model, vectors))
        for vectors in (poses.training_vectors[::SCORE_STRIDE], poses.held_out_vectors)
    )
    codes = model.select_components(poses.held_out_vectors).encode(poses.held_out_vectors)
    return PriorScores(
        training_deg=float(training_deg[:, 1:].mean()),
        held_out_deg=float(held_out_deg[:, 1:].mean()),
        code_rms=float(np.sqrt((codes**2).mean())),
    )


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

    Args:
        max_components: None for all components above the noise.
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

    Raises:
        SceneError: If expectation maximisation does not converge.
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
