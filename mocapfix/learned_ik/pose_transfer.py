"""The closed form of learned inverse kinematics: start poses brought to joint positions, and the network's inputs."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32

from mocapfix.kernels.pose_transfer import (
    FEATURES_PER_JOINT,
    TransferredPoses,
    TransferTree,
    correct_pose_frames,
    transfer_pose_frames,
)
from mocapfix.skeleton import Skeleton
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.parallel import run_over_frames

BONE_ENDS = {
    "LowerBack": "Spine",
    "Spine": "Spine1",
    "Neck": "Neck1",
    "Neck1": "Head",
} | {
    side + name: side + end
    for side in ("Left", "Right")
    for name, end in (
        ("UpLeg", "Leg"),
        ("Leg", "Foot"),
        ("Foot", "ToeBase"),
        ("Shoulder", "Arm"),
        ("Arm", "ForeArm"),
        ("ForeArm", "Hand"),
        ("Hand", "FingerBase"),
        ("FingerBase", "HandIndex1"),
    )
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


def build_transfer_tree(skeleton: Skeleton) -> TransferTree:
    """Return a skeleton with the joints of CMU's for the kernels."""
    names = skeleton.names
    bone_end = np.array([names.index(BONE_ENDS[name]) if name in BONE_ENDS else -1 for name in names])
    clouds = [REGISTERED_JOINT_SD_M.get(name, {}) for name in names]
    return TransferTree(
        skeleton.parents,
        np.ascontiguousarray(skeleton.offsets, float),
        np.ones(len(names), bool),
        bone_end,
        np.cumsum([0, *map(len, clouds)]),
        np.array([names.index(name) for cloud in clouds for name in cloud]),
        np.array([sd**2 for cloud in clouds for sd in cloud.values()]),
        np.array([name in HELD_JOINTS for name in names]),
        np.zeros((0, 0, 3)),
    )


def transfer_poses(
    tree: TransferTree, start: Poses, positions: Float[np.ndarray, "T J 3"], joint_sd: Float[np.ndarray, "T J"]
) -> tuple[TransferredPoses, Float32[np.ndarray, "T F"]]:
    """Return start poses brought to joint positions in metres, NaN where unknown, and the inputs of the network."""
    frames, joints = positions.shape[:2]
    out = TransferredPoses(
        np.empty((frames, 3)),
        np.empty((frames, joints, 3)),
        np.empty((frames, joints, 3, 3)),
        np.empty((frames, joints, 3)),
        np.empty((frames, joints)),
        np.empty(frames),
    )
    features = np.empty((frames, joints * FEATURES_PER_JOINT), np.float32)
    inputs = (np.ascontiguousarray(each, float) for each in (*start, positions, joint_sd))
    scale = float(np.linalg.norm(tree.offsets))
    _run(transfer_pose_frames, frames, tree, *inputs, scale, out, features)
    return out, features


def correct_poses(
    tree: TransferTree,
    start_rotations: Float[np.ndarray, "T J 3 3"],
    transferred: TransferredPoses,
    corrections: Float32[np.ndarray, "T C"],
) -> Poses:
    """Return root positions in metres and local rotations, with the corrections of the network."""
    root, local = np.empty((len(corrections), 3)), np.empty(start_rotations.shape)
    inputs = np.ascontiguousarray(start_rotations, float), transferred, corrections
    _run(correct_pose_frames, len(root), tree, *inputs, root, local)
    return root, local


def _run(kernel: Callable[..., None], frames: int, *arguments: object) -> None:
    """Call a kernel for all frames, in threads where that is worth it."""
    if frames < MIN_THREADED_FRAMES:
        kernel(*arguments, 0, frames)
    else:
        run_over_frames(kernel, frames, *arguments)
