"""Learned inverse kinematics (Learnable SMPLify): any pose is brought to joint positions and refined by a network.

Start poses are brought to the positions in closed form, which gives the network's inputs; its outputs correct the result. Each
further pass (B.3) starts from the result of the pass before. For a take, the joint positions are smoothed over time before the
network sees them, by a Kalman smoother: wide where they are uncertain, one frame where they are exact.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from safetensors import SafetensorError, safe_open

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.kernels import pose_transfer
from mocapfix.model.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.parallel import run_over_frames

IK_WEIGHTS_FILE = "ik.safetensors"
IK_KIND = "ik"


@dataclass(frozen=True)
class Perceptron:
    """A multilayer perceptron with rectifiers between its L layers."""

    input_mean: np.ndarray  # input_mean, input_scale: (F,) subtracted from the inputs, and the factors that follow
    input_scale: np.ndarray
    weights: tuple[np.ndarray, ...]  # L matrices, inputs by outputs
    biases: tuple[np.ndarray, ...]  # L vectors

    def evaluate(self, features: Float32[np.ndarray, "T F"]) -> Float32[np.ndarray, "T C"]:
        """Return the outputs, of learned inverse kinematics corrections for the inputs of `transfer_poses`."""
        row = (features - self.input_mean) * self.input_scale
        for weights, biases in zip(self.weights[:-1], self.biases[:-1], strict=True):
            row = row @ weights
            row += biases
            np.maximum(row, 0, out=row)
        return row @ self.weights[-1] + self.biases[-1]


@cache
def load_shipped_ik_network() -> Perceptron:
    return read_ik_network(find_shipped_folder("priors") / IK_WEIGHTS_FILE)


def read_ik_network(path: Path) -> Perceptron:
    """Read learned inverse kinematics. Raises SceneError, naming the file, if it is not a network for the 31 joints."""
    joints = len(load_cmu31_skeleton().names)
    return read_perceptron(path, IK_KIND, pose_transfer.FEATURES_PER_JOINT * joints, 3 * joints + 3)


def read_perceptron(path: Path, kind: str, input_count: int, output_count: int) -> Perceptron:
    """Read a network. Raises SceneError, naming the file, if it is not one of this kind and size, or not finite."""
    try:
        with safe_open(path, "numpy") as file:
            header = json.loads((file.metadata() or {}).get("mocapfix", "{}"))
            if header.get("kind") != kind:
                raise ValueError(f"the header does not give the kind {kind}")
            tensors = {key: file.get_tensor(key).astype(np.float32) for key in file.keys()}  # noqa: SIM118 (not a mapping)
        layers = range((len(tensors) - 2) // 2)
        weights, biases = (tuple(tensors[f"{part}.{i}"] for i in layers) for part in ("weights", "offsets"))
        mean, scale = tensors["input_mean"], tensors["input_scale"]
        widths = [input_count, *map(len, biases)]
        if not weights or widths[-1] != output_count or mean.shape != scale.shape:
            raise ValueError(f"it must have {input_count} inputs and {output_count} outputs")
        if mean.shape != (input_count,) or [each.shape for each in weights] != list(pairwise(widths)):
            raise ValueError(f"its layers are not {' by '.join(map(str, widths))}")
        if not all(np.isfinite(each).all() for each in tensors.values()):
            raise ValueError("it has values that are not finite")
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise SceneError(f"{path}: is not a network of the kind {kind} trained by mocapfix ({reason}).") from error
    return Perceptron(mean, scale, weights, biases)


SIDE_CHAINS = (("UpLeg", "Leg", "Foot", "ToeBase"), ("Shoulder", "Arm", "ForeArm", "Hand", "FingerBase", "HandIndex1"))
BONE_ENDS = {"LowerBack": "Spine", "Spine": "Spine1", "Neck": "Neck1", "Neck1": "Head"} | {
    side + name: side + end for side in ("Left", "Right") for chain in SIDE_CHAINS for name, end in pairwise(chain)
}
"""joints that one bone leaves, and the joint at its end"""
REGISTERED_JOINT_SD_M = {
    "Hips": {"Hips": 0.0, "LeftUpLeg": 0.0, "RightUpLeg": 0.0, "Spine": 0.02, "Spine1": 0.05, "Neck": 0.1}
    | {"LeftArm": 0.12, "RightArm": 0.12, "LeftLeg": 0.15, "RightLeg": 0.15},
    "Spine1": {"Neck": 0.0, "LeftArm": 0.015, "RightArm": 0.015, "Neck1": 0.03},
}
"""joints by whose positions root and chest are registered, and how much each moves in their axes: metres per axis"""
MIN_THREADED_FRAMES = 64  # fewer are computed sooner than threads are given their work
HELD_JOINTS = ("LHipJoint", "RHipJoint")  # without length: redundant with the thighs


def build_transfer_tree(skeleton: Skeleton) -> pose_transfer.TransferTree:
    """Return a skeleton with the joints of CMU's for the kernels."""
    names = skeleton.names
    bone_end = np.array([names.index(BONE_ENDS[name]) if name in BONE_ENDS else -1 for name in names])
    clouds = [REGISTERED_JOINT_SD_M.get(name, {}) for name in names]
    offsets, is_held = np.ascontiguousarray(skeleton.offsets, float), np.array([name in HELD_JOINTS for name in names])
    cloud_joints = np.array([names.index(name) for cloud in clouds for name in cloud])
    variances, starts = np.array([sd**2 for cloud in clouds for sd in cloud.values()]), np.cumsum([0, *map(len, clouds)])
    return pose_transfer.TransferTree(skeleton.parents, offsets, bone_end, starts, cloud_joints, variances, is_held)


def transfer_poses(
    tree: pose_transfer.TransferTree, start: Poses, positions: Float[np.ndarray, "T J 3"], joint_sd: Float[np.ndarray, "T J"]
) -> tuple[pose_transfer.TransferredPoses, Float32[np.ndarray, "T F"]]:
    """Return start poses brought to joint positions in metres, NaN where unknown, and the inputs of the network."""
    frames, joints = positions.shape[:2]
    shapes = (frames, 3), (frames, joints, 3), (frames, joints, 3, 3), (frames, joints, 3), (frames, joints), (frames,)
    out = pose_transfer.TransferredPoses(*map(np.empty, shapes))
    features = np.empty((frames, joints * pose_transfer.FEATURES_PER_JOINT), np.float32)
    inputs = (np.ascontiguousarray(each, float) for each in (*start, positions, joint_sd))
    scale = float(np.linalg.norm(tree.offsets))
    _run(pose_transfer.transfer_pose_frames, frames, tree, *inputs, scale, out, features)
    return out, features


def correct_poses(
    tree: pose_transfer.TransferTree,
    start_rotations: Float[np.ndarray, "T J 3 3"],
    transferred: pose_transfer.TransferredPoses,
    corrections: Float32[np.ndarray, "T C"],
) -> Poses:
    """Return root positions in metres and local rotations, with the corrections of the network."""
    root, local = np.empty((len(corrections), 3)), np.empty(start_rotations.shape)
    inputs = np.ascontiguousarray(start_rotations, float), transferred, corrections
    _run(pose_transfer.correct_pose_frames, len(root), tree, *inputs, root, local)
    return root, local


def _run(kernel: Callable[..., None], frames: int, *arguments: object) -> None:
    """Call a kernel for all frames, in threads where that is worth it."""
    if frames < MIN_THREADED_FRAMES:
        kernel(*arguments, 0, frames)
    else:
        run_over_frames(kernel, frames, *arguments)


TRUNK_ACCELERATION_DENSITY = 0.6
"""m^2/s^3 by which the variance of a velocity grows per second: pelvis, trunk and head of recorded people"""
LIMB_ACCELERATION_DENSITY = 2.0  # the same of knees, elbows and shoulders
TIP_ACCELERATION_DENSITY = 5.0  # the same of hands and feet
TIP_NAME_PARTS = ("Foot", "Toe", "Hand", "Finger", "Thumb")
LIMB_NAME_PARTS = ("LeftLeg", "RightLeg", "Arm")
MAX_SMOOTHED_SD_M = 0.08  # a joint that is less certain is missing


def smooth_positions(
    positions: Float[np.ndarray, "T J 3"], joint_sd: Float[np.ndarray, "T J"], rate_hz: float
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J"]]:
    """Return joint positions smoothed over time, NaN where they are uncertain, and their standard deviations, in metres.

    Args:
        positions: Of the 31 joints in metres, NaN where unknown; short gaps are filled.
        joint_sd: Metres per axis.
    """
    smoothed, smoothed_sd = np.empty(positions.shape), np.empty(positions.shape[:2])
    inputs = (np.ascontiguousarray(each, float) for each in (positions, joint_sd))
    density = np.array([get_acceleration_density(name) for name in load_cmu31_skeleton().names])
    run_over_frames(
        pose_transfer.smooth_position_joints, positions.shape[1], *inputs, density, 1 / rate_hz, smoothed, smoothed_sd
    )
    smoothed[smoothed_sd > MAX_SMOOTHED_SD_M] = np.nan
    return smoothed, smoothed_sd


def get_acceleration_density(joint_name: str) -> float:
    """Return the density of a joint's random accelerations in m^2/s^3."""
    if any(part in joint_name for part in TIP_NAME_PARTS):
        return TIP_ACCELERATION_DENSITY
    return LIMB_ACCELERATION_DENSITY if any(part in joint_name for part in LIMB_NAME_PARTS) else TRUNK_ACCELERATION_DENSITY


@dataclass(frozen=True)
class PoseRegressor:
    """A network, applied to the poses of one skeleton."""

    network: Perceptron
    skeleton: Skeleton
    passes: int = 1  # number of evaluations for each frame

    def refine_poses(self, start: Poses, positions: Float[np.ndarray, "T J 3"], joint_sd: Float[np.ndarray, "T J"]) -> Poses:
        """Return poses, each from its own start pose.

        Args:
            positions: Of the joints in metres, NaN where unknown.
            joint_sd: Their standard deviations in metres per axis.
        """
        tree, poses = build_transfer_tree(self.skeleton), start
        for _ in range(self.passes):
            transferred, features = transfer_poses(tree, poses, positions, joint_sd)
            poses = correct_poses(tree, poses[1], transferred, self.network.evaluate(features))
        return poses
