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
from mocapfix.files import replacing
from mocapfix.initialise.bones import away
from mocapfix.kernels.layers import layer_frames
from mocapfix.kernels.spans import Spans, direct_frames
from mocapfix.kernels.threads import over_frames
from mocapfix.scenes import folder
from mocapfix.skeleton import Skeleton, average

BESIDE = (("Spine1", "LeftArm"), ("Spine1", "RightArm"))  # no bones, but they show how the chest is turned


@dataclass(frozen=True)
class Twists:
    """The network, of L layers, for the 31 joints of the CMU skeleton.

    weights  L matrices, each layer's inputs by its outputs; between layers what is negative becomes 0
    offsets  L vectors; the last layer has two numbers for each joint that has a bone
    sigma    (J,) radians: how far people's twists are taken to lie from what it says; infinite for joints without a bone
    """

    weights: tuple[np.ndarray, ...]
    offsets: tuple[np.ndarray, ...]
    sigma: np.ndarray

    def regressed(self, positions: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """-> (T, J, 2) cosine and sine of each joint's twist, times how sure it is, 1/rad^2: 1 / sigma^2 and less where the
        joints may mean many twists, whose mean is short; 0 for joints without a bone.

        positions  (T, J, 3) metres, in the world; NaN where unknown
        turns      (T, 3, 3) the root's, in the world
        """
        said, joints = self.said(directions(positions, turns)), np.flatnonzero(np.isfinite(self.sigma))
        scale = 1 / (np.maximum(np.hypot(said[..., 0], said[..., 1]), 1) * self.sigma[joints] ** 2)
        told = np.zeros((len(said), len(self.sigma), 2))
        told[:, joints] = said * scale[..., None]
        return told

    def said(self, inputs: np.ndarray) -> np.ndarray:
        """-> (T, B, 2) what the network makes of (T, N) inputs: cosine and sine for the B joints with a bone, as they come."""
        found = np.empty((len(inputs), len(self.offsets[-1])), np.float32)
        over_frames(layer_frames, len(inputs), self.weights, self.offsets, inputs, found)
        return found.reshape(len(inputs), len(self.offsets[-1]) // 2, 2)


def twists(rotations: np.ndarray, bones: np.ndarray) -> np.ndarray:
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


def bones(skeleton: Skeleton) -> np.ndarray:
    """-> (J, 3) metres: each joint's bone, the mean offset of its children that lie away from it; NaN where there are none."""
    found = np.full(skeleton.offsets.shape, np.nan)
    ends = away(skeleton)
    for j in set(skeleton.parents[ends]):
        found[j] = skeleton.offsets[ends & (skeleton.parents == j)].mean(axis=0)
    return found


@cache
def spans() -> Spans:
    """-> what the network is told of: the way to every joint from its parent, where it lies away from it, and BESIDE."""
    body = average()
    ends = [(int(body.parents[j]), int(j)) for j in np.flatnonzero(away(body))]
    rest = [body.offsets[j] for _, j in ends]
    for start, end in BESIDE:
        j = body.index(end)
        ends.append((body.index(start), j))
        rest.append(body.offsets[body.parents[j]] + body.offsets[j])
    start, end = np.array(ends).T.copy()
    bone = {int(j): p for p, j in reversed(list(enumerate(end)))}
    return Spans(start, end, np.array([bone.get(int(j), -1) for j in start]), np.array(rest))


def directions(positions: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """-> (T, N) single precision: the spans of joints (T, J, 3) in the axes (T, 3, 3) of the root, see `direct_frames`."""
    found = np.empty((len(positions), 2, len(spans().start), 3), np.float32)
    plain = (np.ascontiguousarray(each, float) for each in (positions, turns))
    over_frames(direct_frames, len(found), spans(), *plain, found)
    return found.reshape(len(found), 6 * len(spans().start))


@cache
def regressor() -> Twists:
    """-> the network that ships."""
    return load(folder("priors") / "twist.safetensors")


def load(path: Path) -> Twists:
    """-> the network in a file. Raises SceneError naming the file, where it is none."""
    try:
        tensors = {name: values.astype(np.float32) for name, values in load_file(path).items()}
        layers = range((len(tensors) - 1) // 2)
        weights, offsets = (tuple(tensors.pop(f"{kind}.{i}") for i in layers) for kind in ("weights", "offsets"))
        network = Twists(weights, offsets, tensors.pop("sigma").astype(float))
        if tensors:
            raise ValueError(f"it holds {', '.join(tensors)}, too")
        return checked(network)
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise SceneError(f"{path}: is no regressor of twists that mocapfix trained ({' '.join(str(error).split())}).") from error


def save(path: Path, network: Twists) -> None:
    """Put a network into place, whole or not at all, in half precision. Raises WriteError where the folder cannot be written."""
    tensors = {"sigma": network.sigma.astype(np.float32)}
    for i, (weights, offsets) in enumerate(zip(network.weights, network.offsets, strict=True)):
        tensors |= {f"weights.{i}": weights.astype(np.float16), f"offsets.{i}": offsets.astype(np.float16)}
    with replacing(path) as part:
        save_file(tensors, part)


def checked(network: Twists) -> Twists:
    """-> the network. Raises ValueError unless it is one for the 31 joints: its layers fit, and all numbers are finite."""
    body = average()
    has = ~np.isnan(bones(body)[:, 0])
    widths = [6 * len(spans().start), *map(len, network.offsets)]
    if not network.weights or network.sigma.shape != has.shape or widths[-1] != 2 * has.sum():
        raise ValueError(f"it must say a cosine and a sine for the {has.sum()} of {len(has)} joints that have a bone")
    if [each.shape for each in network.weights] != list(pairwise(widths)):
        raise ValueError(f"its layers are not {' by '.join(map(str, widths))}")
    numbers = np.concatenate([each.ravel() for each in (*network.weights, *network.offsets)])
    if not np.isfinite(numbers).all() or not ((network.sigma > 0) & (np.isfinite(network.sigma) == has)).all():
        raise ValueError("it holds numbers that are not finite, or a sigma of a joint without a bone")
    return network
