"""Trained models as files: NAME.safetensors, whose header says of what kind the model is and for which joints."""

import json
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from mocapfix.errors import SceneError
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import Skeleton

OTHER_WEIGHT_FILES = ("twist",)  # on the shelf of weights, but no model of poses
MNN_IK = "mnn-ik"  # which stands in a solve in another way, as one number, so that benchmarks can compare it


def find_pose_model(name: str) -> Path:
    """-> where the model is that is shipped as priors/NAME.safetensors, or the file, where `name` ends so.

    Raises SceneError naming the models there are; also for the paper's, which goes by its file alone.
    """
    path = Path(name) if name.endswith(".safetensors") else find_shipped_folder("priors") / f"{Path(name).name}.safetensors"
    shelf = {each.stem for each in find_shipped_folder("priors").glob("*.safetensors")}
    there = ", ".join(sorted(shelf - {MNN_IK, *OTHER_WEIGHT_FILES}))
    if name == MNN_IK:
        raise SceneError(f"Only mocapfix bench prior asks {name!r}, to compare it with the others; choose one of: {there}.")
    if not path.is_file() or name in OTHER_WEIGHT_FILES:
        raise SceneError(f"There is no trained prior {name!r}; choose one of: {there}; or give a .safetensors file.")
    return path


def load_pose_model(name: str, skeleton: Skeleton) -> PoseModel:
    """-> the model that `find` finds.

    Raises SceneError naming the models there are; or the file, where it holds none or one of another skeleton.
    """
    path = find_pose_model(name)
    try:
        with safe_open(path, "numpy") as file:
            said = json.loads((file.metadata() or {}).get("mocapfix", "null"))
            if said is None:
                raise ValueError("it does not say what kind of model it holds")
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (it is no mapping)
        joints = tuple(said.pop("joints"))
        if joints == skeleton.names:
            return get_model_class(said.pop("kind")).deserialise(joints, said, tensors)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise SceneError(f"{path}: is no prior that mocapfix trained ({' '.join(str(error).split())}).") from error
    raise SceneError(f"{path}: was trained for the joints {', '.join(joints)}, in this order; the skeleton has others.")


def save_pose_model(path: Path, model: PoseModel) -> None:
    """Put a model into place, whole or not at all. Raises WriteError where the folder cannot be written."""
    said, tensors = model.serialise()
    header = {"mocapfix": json.dumps({"kind": type(model).__name__.lower(), "joints": model.joint_names, **said})}
    with replace_atomically(path) as part:
        save_file({name: np.ascontiguousarray(values) for name, values in tensors.items()}, part, header)


def get_model_class(name: str) -> type[PoseModel]:
    """-> the class of models; only a network's brings torch with it."""
    if name == "linear":
        from mocapfix.pose_prior.gaussian import GaussianModel

        return GaussianModel
    if name == "mixture":
        from mocapfix.pose_prior.mixture import MixtureModel

        return MixtureModel
    if name == "autoencoder":
        from mocapfix.pose_prior.autoencoder import AutoencoderModel

        return AutoencoderModel
    raise ValueError(f"of a kind {name!r} that is not known")
