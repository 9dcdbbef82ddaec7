"""Write the motion of a body as the data set AMASS does: pose parameters of SMPL-X in a NumPy file, without the model itself.

SMPL's joints turn relative to their parents from a T-pose in which the axes of all joints are those of the world: x to the left,
y up, z to the front. That is the standard pose of `body_frames`, so that R = S_parent^T S for the rotations S of the segments.
The world has Z up, hence the root also turns by 90 degrees about x, and a person whose root does no more faces -Y.

The model places its pelvis at J0 + trans, for J0 the place of the pelvis in the rest pose, which no rotation moves. `betas` are
zero, the mean body; the arrays joint_* have the person's own proportions, with which the joints can be placed.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion, list_fingers
from mocapfix.characters.character import build_cmu31_character, convert_motion
from mocapfix.characters.fingers import HandPoses, fit_finger
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import build_solve_tree, spread_rotations
from mocapfix.io.files import replace_atomically
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, compute_local_rotations
from mocapfix.stats.rigid_alignment import compute_rotation_vectors

MEAN_PELVIS_M = np.array([0.0031, -0.3514, 0.0120])
"""J0 of SMPL-X's neutral body with zero betas, as NVIDIA's Kimodo publishes its rest pose (SMPLX_REST_WORLD)"""
ROTATION_Z_UP = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # from axes with Y up to AMASS's
PART_STARTS = {"root_orient": 0, "pose_body": 1, "pose_jaw": 22, "pose_eye": 23, "pose_hand": 25}  # joints
BETA_COUNT = 16


class SmplMotion(NamedTuple):
    """The motion of SMPL-X's 55 joints, with Y up, and the proportions of the person."""

    skeleton: Skeleton  # in the T-pose; offsets are NaN where the person's body has no such joint
    is_solved: Bool[np.ndarray, " 55"]  # whether the markers show the joint
    pelvis: Float[np.ndarray, "T 3"]  # m
    local_rotations: Float[np.ndarray, "T 55 3 3"]


def pose_smpl(
    skeleton: Skeleton,
    motion: Motion,
    rate: float,
    solved_joints: Bool[np.ndarray, " 31"],
    hands: Mapping[str, HandPoses] = MappingProxyType({}),
) -> SmplMotion:
    """Return the motion of the 31-joint skeleton as that of SMPL-X's joints.

    Args:
        rate: Frames per second of the motion.
        solved_joints: The joints that the markers show.
        hands: Those with fingers, in the same frames, by side; wrists turn as their palms.
    """
    model = load_character("smplx")
    source, target = build_body_frame(build_cmu31_character(skeleton)), build_body_frame(model)
    segments, tree = compute_segment_motion(source, convert_motion(motion, rate)), build_solve_tree(target)
    world = spread_rotations(source, target, tree, segments) @ tree.standard_rotations.swapaxes(1, 2)
    names, parents, count = model.skeleton.names, model.skeleton.parents, len(tree.bones)
    rest = Skeleton(names, parents, *np.full((2, len(names), 3), np.nan))
    is_solved, local = np.zeros(len(names), bool), np.tile(np.eye(3), (len(world), len(names), 1, 1))
    segment_of_joint = [segment.partition(".") for segment in tree.skeleton.names]
    joints = [source.character.mapping.bones[segment][int(number or 0)] for segment, _, number in segment_of_joint]
    above = [joints[max(parent, 0)] for parent in parents[:count]]
    turns = np.stack([source.standard_rotations[joint] @ source.rest_rotation[joint].T for joint in above])
    rest.offsets[:count] = (turns @ (source.rest_position[joints] - source.rest_position[above])[..., None])[..., 0]
    is_solved[:count] = solved_joints[joints]
    for side, hand in hands.items():
        wrist = names.index(f"{side}_wrist")
        world[:, wrist] = hand.palm
        from_wrist = np.einsum("tji,tj->ti", hand.palm, hand.position - segments.position[f"{side}_hand"])
        for name, finger in list_fingers(model, side).items():
            bones = list(model.mapping.fingers[name])
            if (turned := fit_finger(hand, side, finger, len(bones))) is not None:
                local[:, bones] = np.concatenate([turned[:, :1], turned[:, :-1].swapaxes(-1, -2) @ turned[:, 1:]], axis=1)
                is_solved[bones] = finger in hand.fingers
            if len(offsets := hand.offsets.get(finger, ())) == len(bones):
                rest.offsets[bones] = offsets
                rest.offsets[bones[0]] += np.median(from_wrist, axis=0)
    local[:, :count] = compute_local_rotations(world, parents[:count])
    return SmplMotion(rest, is_solved, segments.position["pelvis"], local)


def write_amass(target: Path, moved: SmplMotion, rate: float) -> None:
    """Write a motion of `rate` frames per second. Raises WriteError if `target` is not writable."""
    local = moved.local_rotations.copy()
    local[:, 0] = ROTATION_Z_UP @ local[:, 0]
    vectors = compute_rotation_vectors(local)
    parts = np.split(vectors, list(PART_STARTS.values())[1:], axis=1)
    arrays = {name: part.reshape(len(vectors), -1) for name, part in zip(PART_STARTS, parts, strict=True)} | {
        "poses": vectors.reshape(len(vectors), -1),
        "trans": moved.pelvis @ ROTATION_Z_UP.T - MEAN_PELVIS_M,
        "betas": np.zeros(BETA_COUNT),
        "num_betas": np.array(BETA_COUNT),
        "gender": np.array("neutral"),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(float(rate)),  # the spellings of AMASS's two releases
        "mocap_framerate": np.array(float(rate)),
        "mocap_time_length": np.array(len(vectors) / rate),
        "mean_pelvis": MEAN_PELVIS_M,
        "joint_names": np.array(moved.skeleton.names),
        "joint_parents": moved.skeleton.parents,
        "joint_offsets": moved.skeleton.offsets,
        "joint_solved": moved.is_solved,
    }
    with replace_atomically(Path(target)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
