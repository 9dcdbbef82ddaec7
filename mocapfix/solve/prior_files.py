"""Weights files of trained pose models: NAME.safetensors, whose header holds the kind of the model and its joints."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from mocapfix.errors import SceneError
from mocapfix.io.files import replace_atomically
from mocapfix.io.shipped import find_shipped_folder, is_existing_file
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve.pose_prior import PoseModel

OTHER_WEIGHT_FILES = ("twist", "ik", "motion")  # weights in priors/ that are not pose models
MNN_IK = "mnn-ik"  # enters the solver as one scalar, unlike the other models; used by the benchmarks only


def find_pose_model(name: str) -> Path:
    """Return the path of the model shipped as priors/NAME.safetensors, or `name` itself if it ends in .safetensors.

    Raises SceneError that lists the available models if there is none; also for MNN-IK, which is available by its path only.
    """
    path = Path(name) if name.endswith(".safetensors") else find_shipped_folder("priors") / f"{Path(name).name}.safetensors"
    shipped = {each.stem for each in find_shipped_folder("priors").glob("*.safetensors")}
    available = ", ".join(sorted(shipped - {MNN_IK, *OTHER_WEIGHT_FILES}))
    if name == MNN_IK:
        raise SceneError(f"The prior {name!r} is available in mocapfix bench prior only; choose one of: {available}.")
    if not is_existing_file(path) or name in OTHER_WEIGHT_FILES:
        raise SceneError(f"There is no trained prior {name!r}; choose one of: {available}; or give a .safetensors file.")
    return path


def load_pose_model(name: str, skeleton: Skeleton) -> PoseModel:
    """Return the model that `find_pose_model` finds.

    Raises SceneError that lists the available models if there is none, or names the file if it is invalid or was trained for
    another skeleton.
    """
    path = find_pose_model(name)
    try:
        with safe_open(path, "numpy") as file:
            header = json.loads((file.metadata() or {}).get("mocapfix", "null"))
            if header is None:
                raise ValueError("the header does not give the kind of the model")
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (safe_open is not a mapping)
        joint_names = tuple(header.pop("joints"))
        if joint_names == skeleton.names:
            return get_model_class(header.pop("kind")).deserialise(joint_names, header, tensors)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise SceneError(f"{path}: is not a prior trained by mocapfix ({' '.join(str(error).split())}).") from error
    joints = ", ".join(joint_names)
    raise SceneError(f"{path}: was trained for the joints {joints}, in this order; the joints of the skeleton differ.")


def save_pose_model(path: Path, model: PoseModel) -> None:
    """Write a model, replacing the file atomically. Raises WriteError if the folder cannot be written."""
    header, tensors = model.serialise()
    metadata = {"mocapfix": json.dumps({"kind": model.kind, "joints": model.joint_names, **header})}
    with replace_atomically(path) as temporary:
        save_file({name: np.ascontiguousarray(values) for name, values in tensors.items()}, temporary, metadata)


def get_model_class(kind: str) -> type[PoseModel]:
    """Return the class of models of a kind. The class of neural networks imports torch for encoding only."""
    if kind == "linear":
        from mocapfix.solve.pose_prior import GaussianModel

        return GaussianModel
    if kind == "mixture":
        from mocapfix.solve.pose_prior import MixtureModel

        return MixtureModel
    if kind == "autoencoder":
        from mocapfix.solve.autoencoder import AutoencoderModel

        return AutoencoderModel
    raise ValueError(f"the kind {kind!r} is unknown")


def build_pose_model_loader(name: str) -> Callable[[], PoseModel] | None:
    """Return a function that loads a trained prior once, when it is first needed; None for the name "none".

    Raises SceneError where there is no such prior.
    """
    if name == "none":
        return None
    find_pose_model(name)
    return cache(lambda: load_pose_model(name, load_cmu31_body().skeleton))
