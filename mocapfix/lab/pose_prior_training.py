"""Training of a pose prior: fit a model, measure it on held-out subjects, write weights and card."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.errors import WriteError
from mocapfix.lab.cards import PriorScores, write_prior_card
from mocapfix.lab.settings import AutoencoderSettings, GaussianSettings, PriorSettings
from mocapfix.lab.training_poses import TrainingPoses, compute_sampling_weights, conform_training_poses, gather_training_poses
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.prior_files import save_pose_model

# Measured standard deviations are multiplied by this: the held-out subjects are few, and measurements shall outweigh the prior.
SD_INFLATION = 2.5
MIN_RESIDUAL_SD_RAD = np.radians(1.0)  # lower bound of a joint's standard deviation
SCORE_STRIDE = 10  # the score of training poses is measured on every tenth pose


def train_pose_prior(
    settings: PriorSettings,
    folders: Sequence[Path],
    target: Path,
    progress: Callable[[str], object],
    *,
    is_interleaved: bool = False,
) -> PriorScores:
    """Train a model, write it to `target` and its card to the same path with the suffix .md, and return its scores.

    Interrupted training of an autoencoder continues from `target` with the suffix .checkpoint when it is started again.

    is_interleaved  train on three frames of every five of all subjects, which is MNN-IK's split; for comparison with MNN-IK only

    Raises ReadError if the folders hold no motion of the required subjects, WriteError if the files cannot be written.
    """
    if target.suffix != ".safetensors":
        raise WriteError(f"{target}: weights are written as safetensors; give a name that ends in .safetensors.")
    skeleton = load_cmu31_body().skeleton
    reference_rotations = load_mean_pose_prior("mean-pose", skeleton).mean_rotations
    test, held_out = settings.test_subjects, settings.held_out_subjects
    gathered = gather_training_poses(folders, reference_rotations, test, held_out, progress, is_interleaved=is_interleaved)
    poses = conform_training_poses(gathered, skeleton.names, settings.subject_balance)
    checkpoint = target.with_suffix(".checkpoint")
    model, fit_summary = fit_pose_model(settings, skeleton.names, reference_rotations, poses, checkpoint, progress)
    progress("measuring")
    # In MNN-IK's split the held-out poses are its test set, which must not determine any parameter.
    vectors = poses.training_vectors if is_interleaved else select_measured_poses(poses)
    model = replace(model, residual_sd_rad=compute_residual_sd(model, vectors))
    scores = compute_prior_scores(model, poses)
    save_pose_model(target, model)
    write_prior_card(target.with_suffix(".md"), settings, model, poses, scores, fit_summary)
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
    from mocapfix.lab.gaussian_training import fit_gaussian_model, fit_mixture_model

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
    from mocapfix.lab.autoencoder_training import train_network
    from mocapfix.lab.networks import copy_weights
    from mocapfix.solve.autoencoder import AutoencoderModel

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
