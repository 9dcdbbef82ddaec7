"""AMASS: npz of SMPL+H or SMPL-X poses, of which the first 22 joints are the body's.

`poses` (T, 3 x joints) rotation vectors, Z up; `mocap_framerate` Hz. All of SMPL's joints have the world's axes in its rest
pose, which faces as ours does but does not hold arms and legs quite as ours: a bone's rest direction differs by an angle, by
which the joint is turned. Hip stubs, upper neck, fingers, thumbs and toes have no counterpart and stay as they rest.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.stats.rigid_alignment import compute_shortest_rotation
from mocapfix.train.shard_recordings import Recording, compute_frame_step

LEFT_SMPL_JOINTS = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase"}
LEFT_SMPL_JOINTS |= {"collar": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"}
SMPL_JOINT_NAMES = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
)
SMPL_JOINT_NAMES += ("left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder")
SMPL_JOINT_NAMES += ("left_elbow", "right_elbow", "left_wrist", "right_wrist")
CMU31_NAME_OF_SMPL_JOINT = {
    "pelvis": "Hips",
    "spine1": "LowerBack",
    "spine2": "Spine",
    "spine3": "Spine1",
    "neck": "Neck",
    "head": "Head",
}
CMU31_NAME_OF_SMPL_JOINT |= {
    f"{side.lower()}_{key}": side + name for side in ("Left", "Right") for key, name in LEFT_SMPL_JOINTS.items()
}
# Where the bone beyond a joint points in SMPL's rest pose, on the left: measured on the mean body, to about a degree.
SMPL_REST_DIRECTIONS = {"UpLeg": (0.09, -0.99, -0.01), "Leg": (-0.03, -0.99, -0.11), "Foot": (0.19, -0.42, 0.89)}
SMPL_REST_DIRECTIONS |= {"Arm": (0.99, -0.05, -0.10), "ForeArm": (1.0, 0.03, 0.0)}


def read_amass_recordings(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMASS file; nothing of a file that is none (a shard, or a subject's shape)."""
    try:
        with np.load(path) as file:
            if "poses" not in file:
                return
            poses = np.asarray(file["poses"], float)
            rate = float(file["mocap_framerate" if "mocap_framerate" in file else "mocap_frame_rate"])
        poses = poses[:: compute_frame_step(rate), : 3 * len(SMPL_JOINT_NAMES)].reshape(-1, len(SMPL_JOINT_NAMES), 3)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise ReadError(f"{path}: is no AMASS file with poses of 22 joints and mocap_framerate ({error}).") from error
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    local[:, 0] = local[:, 0][:, [1, 2, 0]]  # Z up becomes Y up: (x, y, z) -> (y, z, x)
    yield Recording(path.stem, path.parent.name, map_smpl_rotations(local), rate / compute_frame_step(rate))


def map_smpl_rotations(local: np.ndarray) -> np.ndarray:
    """-> (T, 31, 3, 3) rotations of our joints, of SMPL's (T, 22, 3, 3).

    A joint that is turned by A to make its bone rest where SMPL's does has, in the world, SMPL's turn after A; so that
    locally it is A_parent^-1 R A.
    """
    skeleton = load_cmu31_body().skeleton
    turned, rest = np.tile(np.eye(3), (len(local), len(skeleton.names), 1, 1)), compute_smpl_rest_rotations(skeleton)
    for at, name in enumerate(SMPL_JOINT_NAMES):
        turned[:, skeleton.find_joint(CMU31_NAME_OF_SMPL_JOINT[name])] = local[:, at]
    parents = np.maximum(skeleton.parents, 0)
    return np.swapaxes(rest[parents], 1, 2) @ turned @ rest


def compute_smpl_rest_rotations(skeleton: Skeleton) -> np.ndarray:
    """-> (J, 3, 3) how each joint is turned to rest as SMPL's does; joints without a bone of their own go with their parent."""
    turns = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for j, name in enumerate(skeleton.names):
        side = next((side for side in ("Left", "Right") if name.startswith(side)), "")
        if (bone := name.removeprefix(side)) in SMPL_REST_DIRECTIONS:
            child = int(np.flatnonzero(skeleton.parents == j)[0])
            there = np.array(SMPL_REST_DIRECTIONS[bone]) * [1.0 if side == "Left" else -1.0, 1.0, 1.0]
            turns[j] = compute_shortest_rotation(skeleton.offsets[child], there)
        elif name.endswith(("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")):
            turns[j] = turns[skeleton.parents[j]]
    return turns
