"""The network of learned inverse kinematics, evaluated without torch, and its file."""

import json
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from mocapfix.errors import SceneError
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.kernels.pose_transfer import FEATURES_PER_JOINT
from mocapfix.skeleton import load_cmu31_skeleton

IK_WEIGHTS_FILE = "ik.safetensors"
IK_KIND = "ik"


@dataclass(frozen=True)
class IkNetwork:
    """A multilayer perceptron with rectifiers between its L layers.

    input_mean, input_scale  (F,) subtracted from the inputs, and the factors that follow
    weights                  L matrices, inputs by outputs
    biases                   L vectors
    """

    input_mean: np.ndarray
    input_scale: np.ndarray
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]

    def evaluate(self, features: Float32[np.ndarray, "T F"]) -> Float32[np.ndarray, "T C"]:
        """Return the corrections for the inputs of `mocapfix.learned_ik.pose_transfer.transfer_poses`."""
        row = (features - self.input_mean) * self.input_scale
        for weights, biases in zip(self.weights[:-1], self.biases[:-1], strict=True):
            row = row @ weights
            row += biases
            np.maximum(row, 0, out=row)
        return row @ self.weights[-1] + self.biases[-1]


@cache
def load_shipped_ik_network() -> IkNetwork:
    """Return the network shipped with mocapfix."""
    return read_ik_network(find_shipped_folder("priors") / IK_WEIGHTS_FILE)


def read_ik_network(path: Path) -> IkNetwork:
    """Read a network. Raises SceneError, naming the file, if it is not one for the 31 joints."""
    try:
        with safe_open(path, "numpy") as file:
            header = json.loads((file.metadata() or {}).get("mocapfix", "{}"))
            if header.get("kind") != IK_KIND:
                raise ValueError("the header does not give the kind ik")
            tensors = {key: file.get_tensor(key).astype(np.float32) for key in file.keys()}  # noqa: SIM118 (not a mapping)
        layers = range((len(tensors) - 2) // 2)
        weights, biases = (tuple(tensors[f"{kind}.{i}"] for i in layers) for kind in ("weights", "offsets"))
        return check_ik_network(IkNetwork(tensors["input_mean"], tensors["input_scale"], weights, biases))
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise SceneError(f"{path}: is not a network of learned inverse kinematics trained by mocapfix ({reason}).") from error


def write_ik_network(path: Path, network: IkNetwork) -> None:
    """Write a network in half precision, atomically. Raises WriteError if the folder cannot be written."""
    tensors = {"input_mean": network.input_mean.astype(np.float32), "input_scale": network.input_scale.astype(np.float32)}
    for i, (weights, biases) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors |= {f"weights.{i}": weights.astype(np.float16), f"offsets.{i}": biases.astype(np.float16)}
    write_tensors(path, tensors, IK_KIND)


def write_tensors(path: Path, tensors: dict[str, np.ndarray], kind: str = "graph") -> None:
    """Write tensors and their kind, atomically. Raises WriteError if the folder cannot be written."""
    metadata = {"mocapfix": json.dumps({"kind": kind, "joints": load_cmu31_skeleton().names})}
    with replace_atomically(path) as temporary:
        save_file({name: np.ascontiguousarray(values) for name, values in tensors.items()}, temporary, metadata)


def check_ik_network(network: IkNetwork) -> IkNetwork:
    """Return the network. Raises ValueError unless its layers fit the 31 joints and each other and all numbers are finite."""
    joints = len(load_cmu31_skeleton().names)
    widths = [FEATURES_PER_JOINT * joints, *map(len, network.biases)]
    if not network.weights or widths[-1] != 3 * joints + 3 or network.input_mean.shape != network.input_scale.shape:
        raise ValueError(f"it must have {widths[0]} inputs and {3 * joints + 3} outputs")
    if network.input_mean.shape != (widths[0],) or [each.shape for each in network.weights] != list(pairwise(widths)):
        raise ValueError(f"its layers are not {' by '.join(map(str, widths))}")
    values = (network.input_mean, network.input_scale, *network.weights, *network.biases)
    if not all(np.isfinite(each).all() for each in values):
        raise ValueError("it has values that are not finite")
    return network
