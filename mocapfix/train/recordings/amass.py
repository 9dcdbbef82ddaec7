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
from mocapfix.kernels.aligned import shortest_turn
from mocapfix.skeleton import Skeleton, cmu31
from mocapfix.train.recordings.recording import Recording, step

LEFT = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase"}
LEFT |= {"collar": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"}
NAMES = ("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3")
NAMES += ("left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder")
NAMES += ("left_elbow", "right_elbow", "left_wrist", "right_wrist")
JOINTS = {"pelvis": "Hips", "spine1": "LowerBack", "spine2": "Spine", "spine3": "Spine1", "neck": "Neck", "head": "Head"}
JOINTS |= {f"{side.lower()}_{key}": side + name for side in ("Left", "Right") for key, name in LEFT.items()}
# Where the bone beyond a joint points in SMPL's rest pose, on the left: measured on the mean body, to about a degree.
REST = {"UpLeg": (0.09, -0.99, -0.01), "Leg": (-0.03, -0.99, -0.11), "Foot": (0.19, -0.42, 0.89)}
REST |= {"Arm": (0.99, -0.05, -0.10), "ForeArm": (1.0, 0.03, 0.0)}


def read(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMASS file; nothing of a file that is none (a shard, or a subject's shape)."""
    try:
        with np.load(path) as file:
            if "poses" not in file:
                return
            poses = np.asarray(file["poses"], float)
            rate = float(file["mocap_framerate" if "mocap_framerate" in file else "mocap_frame_rate"])
        poses = poses[:: step(rate), : 3 * len(NAMES)].reshape(-1, len(NAMES), 3)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise ReadError(f"{path}: is no AMASS file with poses of 22 joints and mocap_framerate ({error}).") from error
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    local[:, 0] = local[:, 0][:, [1, 2, 0]]  # Z up becomes Y up: (x, y, z) -> (y, z, x)
    yield Recording(path.stem, path.parent.name, mapped(local), rate / step(rate))


def mapped(local: np.ndarray) -> np.ndarray:
    """-> (T, 31, 3, 3) rotations of our joints, of SMPL's (T, 22, 3, 3).

    A joint that is turned by A to make its bone rest where SMPL's does has, in the world, SMPL's turn after A; so that
    locally it is A_parent^-1 R A.
    """
    skeleton = cmu31().skeleton
    turned, rest = np.tile(np.eye(3), (len(local), len(skeleton.names), 1, 1)), resting(skeleton)
    for at, name in enumerate(NAMES):
        turned[:, skeleton.index(JOINTS[name])] = local[:, at]
    parents = np.maximum(skeleton.parents, 0)
    return np.swapaxes(rest[parents], 1, 2) @ turned @ rest


def resting(skeleton: Skeleton) -> np.ndarray:
    """-> (J, 3, 3) how each joint is turned to rest as SMPL's does; joints without a bone of their own go with their parent."""
    turns = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for j, name in enumerate(skeleton.names):
        side = next((side for side in ("Left", "Right") if name.startswith(side)), "")
        if (bone := name.removeprefix(side)) in REST:
            child = int(np.flatnonzero(skeleton.parents == j)[0])
            there = np.array(REST[bone]) * [1.0 if side == "Left" else -1.0, 1.0, 1.0]
            turns[j] = shortest_turn(skeleton.offsets[child], there)
        elif name.endswith(("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")):
            turns[j] = turns[skeleton.parents[j]]
    return turns
