"""AMASS recordings: npz of SMPL+H or SMPL-X poses, whose first 22 joints are those of the body.

`poses` (T, 3 x joints) holds rotation vectors, Z up, and `mocap_framerate` the rate in Hz. In SMPL's rest pose all joints have
the axes of the world. It faces the same way as the CMU skeleton, but arms and legs point in slightly different directions, by
which the rotations are corrected. Hip stubs, upper neck, fingers, thumbs and toes have no counterpart and keep their rest
rotation.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.stats.rigid_alignment import compute_shortest_rotation
from mocapfix.train.shard_recordings import Recording, compute_frame_step

SMPL_SIDE_JOINTS = {
    "hip": "UpLeg",
    "knee": "Leg",
    "ankle": "Foot",
    "foot": "ToeBase",
    "collar": "Shoulder",
    "shoulder": "Arm",
    "elbow": "ForeArm",
    "wrist": "Hand",
}
SMPL_JOINT_NAMES = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3"),
    *("left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder"),
    *("left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
CMU31_NAME_OF_SMPL_JOINT = {
    "pelvis": "Hips",
    "spine1": "LowerBack",
    "spine2": "Spine",
    "spine3": "Spine1",
    "neck": "Neck",
    "head": "Head",
} | {f"{side.lower()}_{key}": side + name for side in ("Left", "Right") for key, name in SMPL_SIDE_JOINTS.items()}
# Direction of the bone beyond a joint in SMPL's rest pose, on the left side: measured on the mean body, to about a degree.
SMPL_REST_DIRECTIONS = {
    "UpLeg": (0.09, -0.99, -0.01),
    "Leg": (-0.03, -0.99, -0.11),
    "Foot": (0.19, -0.42, 0.89),
    "Arm": (0.99, -0.05, -0.10),
    "ForeArm": (1.0, 0.03, 0.0),
}


def read_amass_recordings(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMASS file, and nothing if the file has no poses (a shard, or the shape of a subject).

    Raises ReadError if the file is invalid.
    """
    try:
        with np.load(path) as file:
            if "poses" not in file:
                return
            poses = np.asarray(file["poses"], float)
            rate_hz = float(file["mocap_framerate" if "mocap_framerate" in file else "mocap_frame_rate"])
        step = compute_frame_step(rate_hz)
        poses = poses[::step, : 3 * len(SMPL_JOINT_NAMES)].reshape(-1, len(SMPL_JOINT_NAMES), 3)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise ReadError(f"{path}: is not an AMASS file with poses of 22 joints and mocap_framerate ({error}).") from error
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    local[:, 0] = local[:, 0][:, [1, 2, 0]]  # from Z up to Y up: (x, y, z) -> (y, z, x)
    yield Recording(path.stem, path.parent.name, map_smpl_rotations(local), rate_hz / step)


def map_smpl_rotations(local: Float[np.ndarray, "T 22 3 3"]) -> Float[np.ndarray, "T 31 3 3"]:
    """Return the local rotations of the CMU joints, given those of the SMPL joints.

    Let A be the rotation of a CMU joint that points its bone in SMPL's rest direction. In the world, the CMU joint has SMPL's
    rotation times A; its local rotation is therefore A_parent^-1 R A.
    """
    skeleton = load_cmu31_body().skeleton
    rotations, rest = np.tile(np.eye(3), (len(local), len(skeleton.names), 1, 1)), compute_smpl_rest_rotations(skeleton)
    for i, name in enumerate(SMPL_JOINT_NAMES):
        rotations[:, skeleton.find_joint(CMU31_NAME_OF_SMPL_JOINT[name])] = local[:, i]
    parents = np.maximum(skeleton.parents, 0)
    return np.swapaxes(rest[parents], 1, 2) @ rotations @ rest


def compute_smpl_rest_rotations(skeleton: Skeleton) -> Float[np.ndarray, "J 3 3"]:
    """Return the world rotation of each joint in SMPL's rest pose; joints without a bone of their own rotate with their
    parent."""
    rotations = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for j, name in enumerate(skeleton.names):
        side = next((side for side in ("Left", "Right") if name.startswith(side)), "")
        if (bone := name.removeprefix(side)) in SMPL_REST_DIRECTIONS:
            child = int(np.flatnonzero(skeleton.parents == j)[0])
            direction = np.array(SMPL_REST_DIRECTIONS[bone]) * [1.0 if side == "Left" else -1.0, 1.0, 1.0]
            rotations[j] = compute_shortest_rotation(skeleton.offsets[child], direction)
        elif name.endswith(("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")):
            rotations[j] = rotations[skeleton.parents[j]]
    return rotations
