"""Conversion of poses between an animation's joints and the 31-joint skeleton of the body model.

The rest poses of the two differ: a file's arms may hang, its legs may be parallel. The alignment is computed from a pose in
which the file's figure is upright. The model is posed like it: hips, trunk and head face the same way, and each bone of the
limbs points along the file's bone. In that pose, the axes of a model joint are rotated by A relative to those of its
counterpart. A is constant, since both move with the same part of the body, so that W = V A for the world rotations W of the
model's joint and V of the file's joint.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.animations.joint_mapping import find_ancestor, find_descendants, find_path
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

SIDE_PREFIXES = ("Left", "Right")
LIMB_BONES = (("UpLeg", "Leg"), ("Leg", "Foot"), ("Foot", "ToeBase"), ("Arm", "ForeArm"), ("ForeArm", "Hand"))
# By model joint: the next joint of the limb, to which its bone points.
LIMB_BONE_ENDS = {side + start: side + end for side in SIDE_PREFIXES for start, end in LIMB_BONES}
PARENT_ALIGNED_JOINTS = ("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")  # suffixes of joints with their parent's axes
# A rotation between two of these joints is shared evenly by those on the path between them.
TRUNK_CHAIN_JOINTS = ("LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head")
MIN_UPRIGHT_COSINE = 0.8  # a figure is upright if trunk, thighs and shins are within 37 degrees of the vertical
MIN_VECTOR_LENGTH_M = 1e-9  # below which a vector has no direction
MAX_ALIGNMENT_FRAMES = 200  # frames from which the upright pose and the bone lengths are taken


@dataclass(frozen=True)
class SkeletonAlignment:
    """How the 31 joints lie in the body of a file.

    file_joints  (31,) index of the file's joint for each, -1 if there is none
    rotation_file_model  (31, 3, 3) A: the axes of each model joint in those of the file's joint
    skeleton     the 31-joint skeleton with the file's bone lengths in metres. Its joints coincide with the file's as far as
                 these are at a constant distance from each other
    """

    file_joints: Int[np.ndarray, " 31"]
    rotation_file_model: Float[np.ndarray, "31 3 3"]
    skeleton: Skeleton


def align_skeleton(animation: Animation, file_joints: Int[np.ndarray, " 31"]) -> SkeletonAlignment | None:
    """Align the 31-joint skeleton with an animation. Returns None if the figure is never upright, not even in its rest pose.

    file_joints  as in `JointMapping`, with the required joints
    """
    sampled = animation.replace_values(animation.values[:: max(1, animation.frame_count // MAX_ALIGNMENT_FRAMES)])
    moving_poses = sampled.compute_world_poses()
    rest_poses = animation.compute_rest_positions()[None], np.tile(np.eye(3), (1, len(animation.names), 1, 1))
    for positions, rotations in (rest_poses, moving_poses):
        uprightness = np.nan_to_num(_compute_uprightness(positions, file_joints), nan=-1.0)
        frame = int(np.argmax(uprightness))
        if uprightness[frame] > MIN_UPRIGHT_COSINE:
            pose = _StandingPose(animation, positions[frame], rotations[frame], file_joints)
            rotation_file_model = _compute_axis_rotations(pose)
            skeleton = _build_aligned_skeleton(animation, *moving_poses, file_joints, rotation_file_model)
            return SkeletonAlignment(file_joints, rotation_file_model, skeleton)
    return None


@dataclass(frozen=True)
class _StandingPose:
    """An upright pose of a file's figure: the positions (J, 3) and rotations (J, 3, 3) of its joints in the world."""

    animation: Animation
    positions: Float[np.ndarray, "J 3"]
    rotations: Float[np.ndarray, "J 3 3"]
    file_joints: Int[np.ndarray, " 31"]

    def compute_vector(self, start: str, end: str) -> Float[np.ndarray, " 3"]:
        """Compute the vector in metres from one model joint to another, both with counterparts."""
        names = load_cmu31_body().skeleton.names
        return self.positions[self.file_joints[names.index(end)]] - self.positions[self.file_joints[names.index(start)]]

    def compute_bone(self, name: str) -> Float[np.ndarray, " 3"]:
        """Compute the vector from a model joint to the end of its bone; zero if it is unknown.

        The end is the next joint's counterpart, or the file's end site where the tree ends.
        """
        names = load_cmu31_body().skeleton.names
        file_joint = self.file_joints[names.index(name)]
        if file_joint < 0:
            return np.zeros(3)
        if self.file_joints[names.index(LIMB_BONE_ENDS[name])] >= 0:
            return self.compute_vector(name, LIMB_BONE_ENDS[name])
        end_sites = self.animation.end_sites[file_joint]
        if not len(end_sites):
            return np.zeros(3)
        return self.rotations[file_joint] @ self.animation.rotation_y_up_file @ end_sites[0]


def _compute_uprightness(positions: Float[np.ndarray, "T J 3"], file_joints: Int[np.ndarray, " 31"]) -> Float[np.ndarray, " T"]:
    """Compute how upright a figure is: the least cosine of trunk, thighs and shins with the vertical."""
    names = load_cmu31_body().skeleton.names
    known = {
        name: positions[:, file_joint] for name, file_joint in zip(names, file_joints.tolist(), strict=True) if file_joint >= 0
    }
    upward = [(known["LeftArm"] + known["RightArm"]) / 2 - known["Hips"]]
    for side in SIDE_PREFIXES:
        upward.append(known[side + "UpLeg"] - known[side + "Leg"])
        if side + "Foot" in known:
            upward.append(known[side + "Leg"] - known[side + "Foot"])
    cosines = [each[:, 1] / np.maximum(np.linalg.norm(each, axis=1), MIN_VECTOR_LENGTH_M) for each in upward]
    return np.min(cosines, axis=0)


def _compute_axis_rotations(pose: _StandingPose) -> Float[np.ndarray, "31 3 3"]:
    """Compute A from an upright pose, the identity for joints without counterparts."""
    model = load_cmu31_body().skeleton
    leftward = pose.compute_vector("RightUpLeg", "LeftUpLeg")
    facing = Rotation.from_euler("y", np.arctan2(-leftward[2], leftward[0])).as_matrix()
    rotation_world_model = np.tile(facing, (len(model.names), 1, 1))
    for joint, name in enumerate(model.names):
        if name.endswith(PARENT_ALIGNED_JOINTS):
            rotation_world_model[joint] = rotation_world_model[model.parents[joint]]
        elif name in LIMB_BONE_ENDS and (bone := pose.compute_bone(name)).any():
            model_bone = facing @ model.offsets[model.find_joint(LIMB_BONE_ENDS[name])]
            rotation_world_model[joint] = compute_shortest_rotation(model_bone, bone) @ facing
    is_known = pose.file_joints >= 0
    rotation_file_model = np.tile(np.eye(3), (len(model.names), 1, 1))
    rotation_world_file = pose.rotations[pose.file_joints[is_known]]
    rotation_file_model[is_known] = np.swapaxes(rotation_world_file, 1, 2) @ rotation_world_model[is_known]
    return rotation_file_model


def _build_aligned_skeleton(
    animation: Animation,
    positions: Float[np.ndarray, "T J 3"],
    rotations: Float[np.ndarray, "T J 3 3"],
    file_joints: Int[np.ndarray, " 31"],
    rotation_file_model: Float[np.ndarray, "31 3 3"],
) -> Skeleton:
    """Return the 31-joint skeleton with the bone lengths of a file, whose joints have these poses in the world.

    Joints without counterpart between two that have one coincide with the lower one, so that it is where the file has it
    whatever their rotations. Joints without counterpart at the ends of the body have the lengths of the average body, scaled
    to this one's size.
    """
    model, is_known = load_cmu31_body().skeleton, file_joints >= 0
    offsets, ends, file_length, model_length = model.offsets.copy(), model.ends.copy(), 0.0, 0.0
    offsets[0] = 0.0
    for joint in np.flatnonzero(is_known)[1:].tolist():
        above = find_ancestor(joint, model.parents, is_known)
        path = find_path(joint, above, model.parents)
        rotation_above = rotations[:, file_joints[above]] @ rotation_file_model[above]
        vector_world = positions[:, file_joints[joint]] - positions[:, file_joints[above]]
        model_length += np.linalg.norm(model.offsets[path].sum(0))
        offsets[path] = 0.0
        offsets[path[0]] = np.nanmean(np.einsum("tij,ti->tj", rotation_above, vector_world), axis=0)
        file_length += np.linalg.norm(offsets[path[0]])
    for joint in range(len(offsets)):
        ends[joint] *= file_length / model_length
        if not find_descendants(joint, model.parents, is_known):
            offsets[joint] *= file_length / model_length
    for joint in np.flatnonzero(is_known & ~np.isnan(ends[:, 0])):
        if len(end_sites := animation.end_sites[file_joints[joint]]) and end_sites[0].any():
            ends[joint] = animation.rotation_y_up_file @ end_sites[0] * animation.unit_m @ rotation_file_model[joint]
    return replace(model, offsets=offsets, ends=ends)


def convert_to_cmu31(
    animation: Animation, alignment: SkeletonAlignment
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 31 3 3"]]:
    """Convert an animation to root positions in metres and local rotations of the skeleton of an alignment.

    The rotations are relative to its rest pose, a T-pose that faces +Z. Joints without counterpart keep their rest rotation,
    except in the trunk and neck, where the rotation between two joints with counterparts is shared evenly.
    """
    positions, rotations = animation.compute_world_poses()
    return positions[:, alignment.file_joints[0]], convert_rotations_to_cmu31(rotations, alignment)


def convert_rotations_to_cmu31(
    rotations: Float[np.ndarray, "T J 3 3"], alignment: SkeletonAlignment
) -> Float[np.ndarray, "T 31 3 3"]:
    """Convert the world rotations of a file's joints to local rotations as in `convert_to_cmu31`."""
    parents, is_known = alignment.skeleton.parents, alignment.file_joints >= 0
    world = np.tile(np.eye(3), (len(rotations), len(parents), 1, 1))
    world[:, is_known] = rotations[:, alignment.file_joints[is_known]] @ alignment.rotation_file_model[is_known]
    local = np.tile(np.eye(3), (len(rotations), len(parents), 1, 1))
    for joint in np.flatnonzero(is_known).tolist():
        above = find_ancestor(joint, parents, is_known)
        rotation = np.swapaxes(world[:, above], 1, 2) @ world[:, joint] if above >= 0 else world[:, joint]
        chain = _list_sharing_joints(joint, above, alignment.skeleton)
        share = rotation if len(chain) == 1 else _scale_rotations(rotation, 1 / len(chain))
        local[:, chain] = share[:, None]
    return local


def compute_file_rotation(
    parents: Int[np.ndarray, " J"],
    file_rotations: Float[np.ndarray, "T J 3 3"],
    alignment: SkeletonAlignment,
    joint: int,
    model_rotations: Float[np.ndarray, "T 31 3 3"],
) -> Float[np.ndarray, "T 3 3"]:
    """Compute the local rotation of the counterpart of a model joint in a file.

    parents, file_rotations  tree and local rotations of the file's joints, of which those above the counterpart are used
    model_rotations  local rotations of the 31 joints
    """
    above = find_ancestor(joint, alignment.skeleton.parents, alignment.file_joints >= 0)
    file_joint = alignment.file_joints[joint]
    rotation_above_joint = _multiply_rotations(model_rotations, find_path(joint, above, alignment.skeleton.parents))
    rotation_file_above = alignment.rotation_file_model[above] if above >= 0 else np.eye(3)
    path = find_path(int(parents[file_joint]), int(alignment.file_joints[above]) if above >= 0 else -1, parents)
    rotation_parent = np.swapaxes(_multiply_rotations(file_rotations, path), 1, 2)
    return rotation_parent @ rotation_file_above @ rotation_above_joint @ alignment.rotation_file_model[joint].T


def _multiply_rotations(rotations: Float[np.ndarray, "T J 3 3"], path: list[int]) -> Float[np.ndarray, "T 3 3"]:
    """Return the product of the local rotations along a path of joints."""
    product = np.tile(np.eye(3), (len(rotations), 1, 1))
    for joint in path:
        product = product @ rotations[:, joint]
    return product


def _list_sharing_joints(joint: int, ancestor: int, skeleton: Skeleton) -> list[int]:
    """Return the joints that share the rotation between an ancestor and a joint: those of the trunk, or the joint alone."""
    path = find_path(joint, ancestor, skeleton.parents)
    return path if all(skeleton.names[each] in TRUNK_CHAIN_JOINTS for each in path) else [joint]


def _scale_rotations(rotations: Float[np.ndarray, "T 3 3"], fraction: float) -> Float[np.ndarray, "T 3 3"]:
    """Return rotations about the same axes by a fraction of the angles, NaN where the rotations are."""
    scaled, is_known = rotations.copy(), np.isfinite(rotations).all((1, 2))
    scaled[is_known] = Rotation.from_rotvec(Rotation.from_matrix(rotations[is_known]).as_rotvec() * fraction).as_matrix()
    return scaled
