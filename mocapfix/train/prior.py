"""Training a prior: settings and motion in; a model, measured on people it has not seen, and its card out."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix import prior
from mocapfix.errors import WriteError
from mocapfix.prior import models
from mocapfix.prior.contract import PoseModel
from mocapfix.skeleton import cmu31
from mocapfix.train import linear
from mocapfix.train.card import Scores, write
from mocapfix.train.poses import Poses, gather
from mocapfix.train.settings import AutoencoderSettings, LinearSettings, Settings

LOOSE = 2.5  # times what is measured: the few unseen subjects stand for everybody, and what markers say shall stand
FLOOR = np.radians(1.0)  # a prior that says it knows a joint better than this is wrong


def train(settings: Settings, folder: Path, target: Path, progress: Callable[[str], None], interleaved: bool = False) -> Scores:
    """Train a model and write it to `target`, its card beside it as .md. -> its scores

    interleaved  learn from three frames of every five, of everybody, as MNN-IK did: only to be compared with it
    Training that is interrupted goes on, when it is asked for again, from `target` with .checkpoint in place of its suffix.

    Raises ReadError where the folder holds no motion of the subjects that are needed, WriteError where nothing can be written.
    """
    if target.suffix != ".safetensors":
        raise WriteError(f"{target}: weights are kept in the form safetensors; give a name that ends in .safetensors.")
    skeleton = cmu31().skeleton
    middle = prior.load("mean-pose", skeleton).rotations
    poses = gather(folder, middle, settings.test, settings.unseen, progress, interleaved)
    checkpoint = target.with_suffix(".checkpoint")
    model, told = fitted(settings, skeleton.names, middle, poses, checkpoint, progress)
    progress("measuring")
    # by MNN-IK's split nobody is unseen but in the frames that it is tested on: they must not set anything
    model = replace(model, sigma=deviations(model, poses.seen if interleaved else poses.unseen))
    scores = measured(model, poses)
    models.save(target, model)
    write(target.with_suffix(".md"), settings, model, poses, scores, told)
    checkpoint.unlink(missing_ok=True)
    return scores


def fitted(
    settings: Settings, joints: tuple[str, ...], middle: np.ndarray, poses: Poses, checkpoint: Path, progress
) -> tuple[PoseModel, str]:
    """-> a model whose sigma is still to be measured, and what its card must tell of the fit beside the settings."""
    if isinstance(settings, AutoencoderSettings):
        return autoencoder(settings, joints, middle, poses, checkpoint, progress), ""
    progress("fitting")
    if isinstance(settings, LinearSettings):
        components = settings.components if isinstance(settings.components, int) else None
        return linear.fit(joints, middle, poses.seen, components), ""
    from mocapfix.train import mixture

    return mixture.fit(joints, middle, poses.seen, settings, progress)


def autoencoder(
    settings: AutoencoderSettings, joints: tuple[str, ...], middle: np.ndarray, poses: Poses, checkpoint: Path, progress
) -> PoseModel:
    """-> a trained network with the density of its code; its sigma is still to be measured."""
    from mocapfix.prior.autoencoder import Autoencoder
    from mocapfix.train.autoencoder import train as trained

    shape, network, doubt = trained(joints, middle, poses.seen, poses.whose, settings, checkpoint, progress)
    noise, astray = (LOOSE * each.detach().numpy().astype(float) for each in (doubt.noise, doubt.astray))
    sigma = np.maximum(np.sqrt((noise.reshape(len(joints), 3) ** 2).mean(1)), FLOOR)
    astray = astray.reshape(shape.astray, len(joints), 3)
    raw = Autoencoder(joints, middle, sigma, shape, network, np.zeros(shape.code), np.eye(shape.code), astray)
    codes = raw.encode(poses.seen)[:, : shape.code]
    covariance = np.cov(codes.T).reshape(shape.code, shape.code)
    least = 1e-6 * np.trace(covariance) / shape.code  # so that a number that the network never uses does no harm
    spread = LOOSE * np.linalg.cholesky(covariance + least * np.eye(shape.code))
    return replace(raw, mean=codes.mean(0), spread=spread)


def strays(model: PoseModel, vectors: np.ndarray) -> np.ndarray:
    """-> (N, J) radians between poses (N, J, 3) and what the model makes of them."""
    model = model.near(vectors)
    decoded = model.decode(model.encode(vectors))
    turns = Rotation.from_rotvec(vectors.reshape(-1, 3)) * Rotation.from_rotvec(decoded.reshape(-1, 3)).inv()
    return turns.magnitude().reshape(vectors.shape[:2])


def deviations(model: PoseModel, unseen: np.ndarray) -> np.ndarray:
    """-> (J,) radians per axis: sigma, from poses of people the model has not seen; of the root's tilt as measured, not LOOSE,
    for in the solve that places people best whom the model has not seen."""
    loose = np.where(np.arange(len(model.joints)) == 0, 1.0, LOOSE)
    return np.maximum(loose * np.sqrt((strays(model, unseen) ** 2).mean(0) / 3), FLOOR)


def measured(model: PoseModel, poses: Poses) -> Scores:
    """-> how near the model comes to poses, by themselves and decoded."""
    seen, unseen = (np.degrees(strays(model, each)) for each in (poses.seen[::10], poses.unseen))
    spread = np.sqrt((model.near(poses.unseen).encode(poses.unseen) ** 2).mean())
    return Scores(float(seen[:, 1:].mean()), float(unseen[:, 1:].mean()), float(spread))
