"""Training a prior: settings and motion in; a model, measured on people it has not seen, and its card out."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import WriteError
from mocapfix.pose_prior import io, mean_pose
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train import gaussian_models as linear
from mocapfix.train.cards import PriorScores, write_prior_card
from mocapfix.train.settings import AutoencoderSettings, GaussianSettings, PriorSettings
from mocapfix.train.training_poses import TrainingPoses, gather_training_poses

SD_INFLATION = 2.5  # times what is measured: the few unseen subjects stand for everybody, and what markers say shall stand
MIN_RESIDUAL_SD_RAD = np.radians(1.0)  # a prior that says it knows a joint better than this is wrong


def train_pose_prior(
    settings: PriorSettings, folder: Path, target: Path, progress: Callable[[str], None], is_interleaved: bool = False
) -> PriorScores:
    """Train a model and write it to `target`, its card beside it as .md. -> its scores

    interleaved  learn from three frames of every five, of everybody, as MNN-IK did: only to be compared with it
    Training that is interrupted goes on, when it is asked for again, from `target` with .checkpoint in place of its suffix.

    Raises ReadError where the folder holds no motion of the subjects that are needed, WriteError where nothing can be written.
    """
    if target.suffix != ".safetensors":
        raise WriteError(f"{target}: weights are kept in the form safetensors; give a name that ends in .safetensors.")
    skeleton = load_cmu31_body().skeleton
    middle = mean_pose.load_mean_pose_prior("mean-pose", skeleton).mean_rotations
    poses = gather_training_poses(folder, middle, settings.test_subjects, settings.held_out_subjects, progress, is_interleaved)
    checkpoint = target.with_suffix(".checkpoint")
    model, told = fit_pose_model(settings, skeleton.names, middle, poses, checkpoint, progress)
    progress("measuring")
    # by MNN-IK's split nobody is unseen but in the frames that it is tested on: they must not set anything
    model = replace(
        model, residual_sd_rad=compute_residual_sd(model, poses.training_vectors if is_interleaved else poses.held_out_vectors)
    )
    scores = compute_prior_scores(model, poses)
    io.save_pose_model(target, model)
    write_prior_card(target.with_suffix(".md"), settings, model, poses, scores, told)
    checkpoint.unlink(missing_ok=True)
    return scores


def fit_pose_model(
    settings: PriorSettings,
    joint_names: tuple[str, ...],
    reference_rotations: np.ndarray,
    poses: TrainingPoses,
    checkpoint: Path,
    progress,
) -> tuple[PoseModel, str]:
    """-> a model whose sigma is still to be measured, and what its card must tell of the fit beside the settings."""
    if isinstance(settings, AutoencoderSettings):
        return fit_autoencoder(settings, joint_names, reference_rotations, poses, checkpoint, progress), ""
    progress("fitting")
    if isinstance(settings, GaussianSettings):
        components = settings.components if isinstance(settings.components, int) else None
        return linear.fit_gaussian_model(joint_names, reference_rotations, poses.training_vectors, components), ""
    from mocapfix.train import gaussian_models as mixture

    return mixture.fit_mixture_model(joint_names, reference_rotations, poses.training_vectors, settings, progress)


def fit_autoencoder(
    settings: AutoencoderSettings,
    joint_names: tuple[str, ...],
    reference_rotations: np.ndarray,
    poses: TrainingPoses,
    checkpoint: Path,
    progress,
) -> PoseModel:
    """-> a trained network with the density of its code; its sigma is still to be measured."""
    from mocapfix.pose_prior.autoencoder import AutoencoderModel
    from mocapfix.train.autoencoder import train_network

    shape, network, doubt = train_network(
        joint_names, reference_rotations, poses.training_vectors, poses.subject_index, settings, checkpoint, progress
    )
    noise, astray = (SD_INFLATION * each.detach().numpy().astype(float) for each in (doubt.feature_sd, doubt.residual_directions))
    sigma = np.maximum(np.sqrt((noise.reshape(len(joint_names), 3) ** 2).mean(1)), MIN_RESIDUAL_SD_RAD)
    astray = astray.reshape(shape.residual_directions, len(joint_names), 3)
    raw = AutoencoderModel(
        joint_names, reference_rotations, sigma, shape, network, np.zeros(shape.code_size), np.eye(shape.code_size), astray
    )
    codes = raw.encode(poses.training_vectors)[:, : shape.code_size]
    covariance = np.cov(codes.T).reshape(shape.code_size, shape.code_size)
    least = 1e-6 * np.trace(covariance) / shape.code_size  # so that a number that the network never uses does no harm
    spread = SD_INFLATION * np.linalg.cholesky(covariance + least * np.eye(shape.code_size))
    return replace(raw, code_mean=codes.mean(0), code_cholesky=spread)


def compute_reconstruction_error(model: PoseModel, pose_vectors: np.ndarray) -> np.ndarray:
    """-> (N, J) radians between poses (N, J, 3) and what the model makes of them."""
    model = model.select_components(pose_vectors)
    decoded = model.decode(model.encode(pose_vectors))
    turns = Rotation.from_rotvec(pose_vectors.reshape(-1, 3)) * Rotation.from_rotvec(decoded.reshape(-1, 3)).inv()
    return turns.magnitude().reshape(pose_vectors.shape[:2])


def compute_residual_sd(model: PoseModel, held_out_vectors: np.ndarray) -> np.ndarray:
    """-> (J,) radians per axis: sigma, from poses of people the model has not seen; of the root's tilt as measured, not LOOSE,
    for in the solve that places people best whom the model has not seen."""
    loose = np.where(np.arange(len(model.joint_names)) == 0, 1.0, SD_INFLATION)
    return np.maximum(
        loose * np.sqrt((compute_reconstruction_error(model, held_out_vectors) ** 2).mean(0) / 3), MIN_RESIDUAL_SD_RAD
    )


def compute_prior_scores(model: PoseModel, poses: TrainingPoses) -> PriorScores:
    """-> how near the model comes to poses, by themselves and decoded."""
    seen, unseen = (
        np.degrees(compute_reconstruction_error(model, each)) for each in (poses.training_vectors[::10], poses.held_out_vectors)
    )
    spread = np.sqrt((model.select_components(poses.held_out_vectors).encode(poses.held_out_vectors) ** 2).mean())
    return PriorScores(float(seen[:, 1:].mean()), float(unseen[:, 1:].mean()), float(spread))
