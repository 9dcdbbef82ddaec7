"""Twists: how far each joint is turned about its own bone, and what joint positions alone suggest of it.

A joint's rotation is a twist about its bone, the way to its children, and then a swing of the bone (HybrIK, section 3.2). Where
joints lie tells the swing. Of the twist it tells what people's habits make of it, and the bones beyond: a small network says it
(section 3.3), trained by `mocapfix.train.twist` and evaluated without torch.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from mocapfix.errors import SceneError
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.initialise.bones import find_separate_joints
from mocapfix.kernels.twist_network import BoneLines, compute_bone_direction_frames, evaluate_layer_frames
from mocapfix.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.solve.parallel import run_over_frames

CHEST_SPAN_JOINTS = (("Spine1", "LeftArm"), ("Spine1", "RightArm"))  # no bones, but they show how the chest is turned


@dataclass(frozen=True)
class TwistRegressor:
    """The network, of L layers, for the 31 joints of the CMU skeleton.

    weights  L matrices, each layer's inputs by its outputs; between layers what is negative becomes 0
    offsets  L vectors; the last layer has two numbers for each joint that has a bone
    sigma    (J,) radians: how far people's twists are taken to lie from what it says; infinite for joints without a bone
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    sd_rad: np.ndarray

    def predict_twists(self, positions: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """-> (T, J, 2) cosine and sine of each joint's twist, times how sure it is, 1/rad^2: 1 / sigma^2 and less where the
        joints may mean many twists, whose mean is short; 0 for joints without a bone.

        positions  (T, J, 3) metres, in the world; NaN where unknown
        turns      (T, 3, 3) the root's, in the world
        """
        said, joints = self.evaluate(compute_span_directions(positions, turns)), np.flatnonzero(np.isfinite(self.sd_rad))
        scale = 1 / (np.maximum(np.hypot(said[..., 0], said[..., 1]), 1) * self.sd_rad[joints] ** 2)
        told = np.zeros((len(said), len(self.sd_rad), 2))
        told[:, joints] = said * scale[..., None]
        return told

    def evaluate(self, inputs: np.ndarray) -> np.ndarray:
        """-> (T, B, 2) what the network makes of (T, N) inputs: cosine and sine for the B joints with a bone, as they come."""
        found = np.empty((len(inputs), len(self.biases[-1])), np.float32)
        run_over_frames(evaluate_layer_frames, len(inputs), self.weights, self.biases, inputs, found)
        return found.reshape(len(inputs), len(self.biases[-1]) // 2, 2)


def compute_twists(rotations: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """-> (..., J, 2) cosine and sine of the angle about each bone (J, 3) in local rotations (..., J, 3, 3); NaN without a bone.

    R = swing twist, the swing about an axis across the bone. As a quaternion R has w = cos(s/2) cos(t/2) and along the bone
    cos(s/2) sin(t/2), for the angles s and t; and R's trace and its part along the bone tell the squares of both. Where the
    bone swings right round to the other side there is no such angle, and what comes out is not finite.
    """
    u = bones / np.linalg.norm(bones, axis=-1, keepdims=True)
    along = np.einsum("ja,...jab,jb->...j", u, rotations, u)
    skew = rotations - np.swapaxes(rotations, -1, -2)
    turned = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    both = np.stack([np.trace(rotations, axis1=-2, axis2=-1) - along, (turned * u).sum(-1)], axis=-1)
    return both / (1 + along)[..., None]


def compute_bone_vectors(skeleton: Skeleton) -> np.ndarray:
    """-> (J, 3) metres: each joint's bone, the mean offset of its children that lie away from it; NaN where there are none."""
    found = np.full(skeleton.offsets.shape, np.nan)
    ends = find_separate_joints(skeleton)
    for j in set(skeleton.parents[ends]):
        found[j] = skeleton.offsets[ends & (skeleton.parents == j)].mean(axis=0)
    return found


@cache
def build_twist_spans() -> BoneLines:
    """-> what the network is told of: the way to every joint from its parent, where it lies away from it, and BESIDE."""
    body = load_cmu31_skeleton()
    ends = [(int(body.parents[j]), int(j)) for j in np.flatnonzero(find_separate_joints(body))]
    rest = [body.offsets[j] for _, j in ends]
    for start, end in CHEST_SPAN_JOINTS:
        j = body.find_joint(end)
        ends.append((body.find_joint(start), j))
        rest.append(body.offsets[body.parents[j]] + body.offsets[j])
    start, end = np.array(ends).T.copy()
    bone = {int(j): p for p, j in reversed(list(enumerate(end)))}
    return BoneLines(start, end, np.array([bone.get(int(j), -1) for j in start]), np.array(rest))


def compute_span_directions(positions: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """-> (T, N) single precision: the spans of joints (T, J, 3) in the axes (T, 3, 3) of the root, see `direct_frames`."""
    found = np.empty((len(positions), 2, len(build_twist_spans().start), 3), np.float32)
    plain = (np.ascontiguousarray(each, float) for each in (positions, turns))
    run_over_frames(compute_bone_direction_frames, len(found), build_twist_spans(), *plain, found)
    return found.reshape(len(found), 6 * len(build_twist_spans().start))


@cache
def load_shipped_regressor() -> TwistRegressor:
    """-> the network that ships."""
    return read_twist_regressor(find_shipped_folder("priors") / "twist.safetensors")


def read_twist_regressor(path: Path) -> TwistRegressor:
    """-> the network in a file. Raises SceneError naming the file, where it is none."""
    try:
        tensors = {name: values.astype(np.float32) for name, values in load_file(path).items()}
        layers = range((len(tensors) - 1) // 2)
        weights, offsets = (tuple(tensors.pop(f"{kind}.{i}") for i in layers) for kind in ("weights", "offsets"))
        network = TwistRegressor(weights, offsets, tensors.pop("sigma").astype(float))
        if tensors:
            raise ValueError(f"it holds {', '.join(tensors)}, too")
        return check_twist_regressor(network)
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise SceneError(f"{path}: is no regressor of twists that mocapfix trained ({' '.join(str(error).split())}).") from error


def write_twist_regressor(path: Path, network: TwistRegressor) -> None:
    """Put a network into place, whole or not at all, in half precision. Raises WriteError where the folder cannot be written."""
    tensors = {"sigma": network.sd_rad.astype(np.float32)}
    for i, (weights, offsets) in enumerate(zip(network.weights, network.biases, strict=True)):
        tensors |= {f"weights.{i}": weights.astype(np.float16), f"offsets.{i}": offsets.astype(np.float16)}
    with replace_atomically(path) as part:
        save_file(tensors, part)


def check_twist_regressor(network: TwistRegressor) -> TwistRegressor:
    """-> the network. Raises ValueError unless it is one for the 31 joints: its layers fit, and all numbers are finite."""
    body = load_cmu31_skeleton()
    has = ~np.isnan(compute_bone_vectors(body)[:, 0])
    widths = [6 * len(build_twist_spans().start), *map(len, network.biases)]
    if not network.weights or network.sd_rad.shape != has.shape or widths[-1] != 2 * has.sum():
        raise ValueError(f"it must say a cosine and a sine for the {has.sum()} of {len(has)} joints that have a bone")
    if [each.shape for each in network.weights] != list(pairwise(widths)):
        raise ValueError(f"its layers are not {' by '.join(map(str, widths))}")
    numbers = np.concatenate([each.ravel() for each in (*network.weights, *network.biases)])
    if not np.isfinite(numbers).all() or not ((network.sd_rad > 0) & (np.isfinite(network.sd_rad) == has)).all():
        raise ValueError("it holds numbers that are not finite, or a sigma of a joint without a bone")
    return network
