"""Rotations of one skeleton as those of another whose joints turn with the same parts: of animations, and on rigs.

The axes of a joint are rotated by a constant A relative to those of its counterpart, since both move with the same part: W = V A
for the world rotations W of the joint and V of its counterpart.

Rest poses differ: a file's arms may hang, its legs may be parallel. For an animation, A follows from a pose in which its figure
is upright, with the 31-joint skeleton posed like it: hips, trunk and head face the same way, and each bone of the limbs points
along the file's bone. In a pose of the motion elbows and knees show how limbs are twisted: they bend about one axis.

A rig is the skeleton as another program expects it, with its joint names, tree, rest pose and unit. The rotation of a joint that
it omits is composed into those of the joint's children, so that their rotations in the world do not change. A child's position in
its remaining parent is constant only if the omitted joint never rotates or has no offset to the child; otherwise the joint cannot
be omitted. A is the inverse of the rotation of a joint's axes from the skeleton's rest pose to that of the rig, such as a T-pose.
CMU's joint Hand lies in the forearm, FingerBase at the wrist. A rig without FingerBase has its hand's joint at the wrist.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from mocapfix.characters.character_yaml import Rig
from mocapfix.errors import WriteError
from mocapfix.io.shipped import read_shipped_yaml
from mocapfix.model.animation import Animation
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, compute_local_rotations, find_ancestor, list_path, load_cmu31_body
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.stats.rigid_alignment import compute_shortest_rotation, compute_shortest_rotations, scale_rotations

SIDE_PREFIXES = ("Left", "Right")
LIMB_BONES = (("UpLeg", "Leg"), ("Leg", "Foot"), ("Foot", "ToeBase"), ("Arm", "ForeArm"), ("ForeArm", "Hand"))
LIMB_BONE_ENDS = {side + start: side + end for side in SIDE_PREFIXES for start, end in LIMB_BONES}
"""by joint: the next joint of the limb, to which its bone points"""
PARENT_ALIGNED_JOINTS = ("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")  # suffixes of joints with their parent's axes
TRUNK_CHAIN_JOINTS = ("LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head")
"""joints that share the rotation between two of them evenly"""
LIMB_BEND_AXES = {"LeftForeArm": (0, -1, 0), "RightForeArm": (0, 1, 0), "LeftLeg": (1, 0, 0), "RightLeg": (1, 0, 0)}
"""by joint: the axis about which a limb bends there, in the axes of its joints: in a T-pose elbows bend forwards"""
MIN_BENT_SINE, MIN_BENT_FRAMES = 0.34, 5  # a limb that is bent by 20 degrees shows the axis; in fewer frames it may be a fault
MIN_BEND_CONSISTENCY = 0.8  # length of the sum of these axes over the frames, as a share of that of parallel ones
MIN_UPRIGHT_COSINE = 0.8  # a figure is upright if trunk, thighs and shins are within 37 degrees of the vertical
MIN_VECTOR_LENGTH_M = 1e-9  # below which a vector has no direction
MAX_ALIGNMENT_FRAMES = 200  # frames from which the upright pose and the bone lengths are taken


@dataclass(frozen=True)
class SkeletonAlignment:
    """How the joints of a skeleton follow those of another one, the source."""

    skeleton: Skeleton
    source_joints: Int[np.ndarray, " J"]  # index of the source's joint for each, -1 if there is none
    rotation_source_joint: Float[np.ndarray, "J 3 3"]  # A: the axes of each joint in those of the source's joint
    upright_frame: int = -1  # the source's frame from which A follows, -1 for its rest pose

    @property
    def is_sharing(self) -> Bool[np.ndarray, " J"]:
        """The joints that share the rotation between two of them evenly: those of the trunk and neck of the 31-joint skeleton."""
        is_cmu31 = self.skeleton.names == load_cmu31_body().skeleton.names
        return np.array([is_cmu31 and name in TRUNK_CHAIN_JOINTS for name in self.skeleton.names])

    @property
    def is_mapped(self) -> Bool[np.ndarray, " J"]:
        """The joints that have a counterpart."""
        return self.source_joints >= 0

    @property
    def body(self) -> Skeleton:
        """The skeleton with the wrists, which are its joints FingerBase, at the hands of a source that has no such joints."""
        offsets, names = self.skeleton.offsets.copy(), self.skeleton.names
        for joint in np.flatnonzero([name.endswith("FingerBase") for name in names]):
            if not self.is_mapped[joint]:
                offsets[self.skeleton.parents == joint] += offsets[joint]
                offsets[joint] = 0.0
        return replace(self.skeleton, offsets=offsets)

    @property
    def carriers(self) -> Int[np.ndarray, " J"]:
        """The source's joint with which each joint moves: its counterpart, or that of the nearest joint above that has one."""
        count = len(self.source_joints)
        return self.source_joints[[j if self.is_mapped[j] else self.find_mapped_ancestor(j) for j in range(count)]]

    def find_mapped_ancestor(self, joint: int) -> int:
        """Return the nearest joint above one that has a counterpart, -1 if there is none."""
        return find_ancestor(joint, self.skeleton.parents, self.is_mapped)

    def convert_poses(
        self, positions: Float[np.ndarray, "T S 3"], rotations: Float[np.ndarray, "T S 3 3"]
    ) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T J 3 3"]]:
        """Convert poses of the source's joints in the world to root positions and local rotations of the skeleton."""
        return positions[:, self.source_joints[0]], self.convert_rotations(rotations)

    def convert_rotations(self, rotations: Float[np.ndarray, "T S 3 3"]) -> Float[np.ndarray, "T J 3 3"]:
        """Convert the world rotations of the source's joints to local rotations of the skeleton.

        Joints without counterpart keep their rest rotation, except those that share the rotation of a joint below them.
        """
        local = np.tile(self.skeleton.rest_rotations, (len(rotations), 1, 1, 1))
        world, is_parent = np.empty(local.shape), ~self.skeleton.is_leaf
        for joint, parent in enumerate(self.skeleton.parents.tolist()):
            above = world[:, parent] if parent >= 0 else np.eye(3)[None]
            if self.is_mapped[joint]:
                world[:, joint] = rotations[:, self.source_joints[joint]] @ self.rotation_source_joint[joint]
                local[:, joint] = above.swapaxes(1, 2) @ world[:, joint]
                path = list_path(joint, self.find_mapped_ancestor(joint), self.skeleton.parents)
                if len(path) > 1 and self.is_sharing[path].all():
                    local[:, path] = scale_rotations(local[:, joint], 1 / len(path))[:, None]
            elif is_parent[joint]:
                world[:, joint] = above @ local[:, joint]
        return local

    def convert_rotation_back(
        self,
        joint: int,
        local_rotations: Float[np.ndarray, "T J 3 3"],
        source_parents: Int[np.ndarray, " S"],
        source_rotations: Float[np.ndarray, "T S 3 3"],
    ) -> Float[np.ndarray, "T 3 3"]:
        """Compute the local rotation of the counterpart of a joint from the rotations of the skeleton.

        Args:
            joint: A joint with a counterpart.
            local_rotations: Of the skeleton.
            source_parents: The tree of the source.
            source_rotations: Its local rotations, of which those above the counterpart are used.
        """
        above, source_joint = self.find_mapped_ancestor(joint), int(self.source_joints[joint])
        source_above = int(self.source_joints[above]) if above >= 0 else -1
        path = list_path(int(source_parents[source_joint]), source_above, source_parents)
        rotation = self.rotation_source_joint[above] if above >= 0 else np.eye(3)
        for each in list_path(joint, above, self.skeleton.parents):
            rotation = rotation @ local_rotations[:, each]
        for each in path:
            rotation = source_rotations[:, each].swapaxes(1, 2) @ rotation
        return rotation @ self.rotation_source_joint[joint].T


def align_skeleton(animation: Animation, file_joints: Int[np.ndarray, " 31"]) -> SkeletonAlignment | None:
    """Align the 31-joint skeleton with an animation. Returns None if the figure is never upright, not even in its rest pose.

    The joints coincide with the file's, given as in `JointMapping`, as far as these are at a constant distance from each other.
    """
    step = max(1, animation.frame_count // MAX_ALIGNMENT_FRAMES)
    sampled = animation.replace_values(animation.values[::step])
    names, moving_poses = load_cmu31_body().skeleton.names, sampled.compute_world_poses()
    rest_pose = [each[None] for each in animation.skeleton.compute_rest_pose()]
    for (positions, rotations), is_moving in ((rest_pose, False), (moving_poses, True)):
        places = {name: positions[:, joint] for name, joint in zip(names, file_joints.tolist(), strict=True) if joint >= 0}
        uprightness = np.nan_to_num(_compute_uprightness(places), nan=-1.0)
        frame = int(np.argmax(uprightness))
        if uprightness[frame] > MIN_UPRIGHT_COSINE:
            pose = {name: place[frame] for name, place in places.items()}
            bend_axes = _measure_bend_axes(places, rotations, file_joints) if is_moving else {}
            rotation_file_model = _compute_axis_rotations(animation.skeleton, file_joints, pose, rotations[frame], bend_axes)
            skeleton = _build_aligned_skeleton(animation.skeleton, *moving_poses, file_joints, rotation_file_model)
            return SkeletonAlignment(skeleton, file_joints, rotation_file_model, frame * step if is_moving else -1)
    return None


def _compute_uprightness(places: Mapping[str, Float[np.ndarray, "T 3"]]) -> Float[np.ndarray, " T"]:
    """Compute how upright a figure is: the least cosine of trunk, thighs and shins with the vertical."""
    upward = [(places["LeftArm"] + places["RightArm"]) / 2 - places["Hips"]]
    for side in SIDE_PREFIXES:
        upward.append(places[side + "UpLeg"] - places[side + "Leg"])
        if side + "Foot" in places:
            upward.append(places[side + "Leg"] - places[side + "Foot"])
    return np.min([each[:, 1] / np.maximum(np.linalg.norm(each, axis=1), MIN_VECTOR_LENGTH_M) for each in upward], axis=0)


def _measure_bend_axes(
    places: Mapping[str, Float[np.ndarray, "T 3"]], rotations: Float[np.ndarray, "T J 3 3"], file_joints: Int[np.ndarray, " 31"]
) -> dict[str, tuple[Float[np.ndarray, " 3"], tuple[int, ...]]]:
    """Return by joint of a limb the axis about which it bends: in the axes of the file's joint, and of the model's."""
    model, found = load_cmu31_body().skeleton, {}
    for lower, axis in LIMB_BEND_AXES.items():
        upper, end = model.names[model.parents[model.find_joint(lower)]], LIMB_BONE_ENDS[lower]
        one, other = places[lower] - places[upper], places.get(end, places[lower]) - places[lower]
        normal, length = np.cross(one, other), np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
        is_bent = np.linalg.norm(normal, axis=1) > MIN_BENT_SINE * length
        for name in (upper, lower) if is_bent.sum() >= MIN_BENT_FRAMES else ():
            own = np.einsum("tji,tj->ti", rotations[is_bent, file_joints[model.find_joint(name)]], normal[is_bent])
            if np.linalg.norm(own.sum(0)) > MIN_BEND_CONSISTENCY * np.linalg.norm(own, axis=1).sum():
                found[name] = own.sum(0), axis
    return found


def _compute_axis_rotations(
    source: Skeleton,
    file_joints: Int[np.ndarray, " 31"],
    pose: Mapping[str, Float[np.ndarray, " 3"]],
    rotations: Float[np.ndarray, "J 3 3"],
    bend_axes: Mapping[str, tuple[Float[np.ndarray, " 3"], tuple[int, ...]]],
) -> Float[np.ndarray, "31 3 3"]:
    """Compute A from places by joint and world rotations of an upright pose; the identity for joints without counterparts."""
    model = load_cmu31_body().skeleton
    leftward = pose["LeftUpLeg"] - pose["RightUpLeg"]
    facing = scipy.spatial.transform.Rotation.from_euler("y", np.arctan2(-leftward[2], leftward[0])).as_matrix()
    rotation_world_model, rotation_file_model = (np.tile(each, (len(model.names), 1, 1)) for each in (facing, np.eye(3)))
    for joint, (name, file_joint) in enumerate(zip(model.names, file_joints.tolist(), strict=True)):
        if name.endswith(PARENT_ALIGNED_JOINTS):
            rotation_world_model[joint] = rotation_world_model[model.parents[joint]]
        elif name in LIMB_BONE_ENDS and name in pose:
            end = LIMB_BONE_ENDS[name]
            bone = pose[end] - pose[name] if end in pose else np.nan_to_num(rotations[file_joint] @ source.ends[file_joint])
            start = rotation_world_model[model.parents[joint]] if name.endswith("Foot") else facing  # at rest it lies as the shin
            turned = compute_shortest_rotation(start @ model.offsets[model.find_joint(end)], bone) @ start
            if name in bend_axes:
                axes = turned @ bend_axes[name][1], rotations[file_joint] @ bend_axes[name][0]
                turned = compute_shortest_rotation(*(axis - bone * (axis @ bone) / (bone @ bone) for axis in axes)) @ turned
            rotation_world_model[joint] = turned
        if file_joint >= 0:
            rotation_file_model[joint] = rotations[file_joint].T @ rotation_world_model[joint]
    return rotation_file_model


def _build_aligned_skeleton(
    source: Skeleton,
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
    offsets, lengths_m = model.offsets.copy(), np.zeros(2)  # of the model and the file
    offsets[0], is_beyond = 0.0, ~is_known
    for joint in np.flatnonzero(is_known)[1:].tolist():
        above = find_ancestor(joint, model.parents, is_known)
        path = list_path(joint, above, model.parents)
        rotation_above = rotations[:, file_joints[above]] @ rotation_file_model[above]
        vector_world = positions[:, file_joints[joint]] - positions[:, file_joints[above]]
        vector = np.nanmean(np.einsum("tij,ti->tj", rotation_above, vector_world), axis=0)
        lengths_m += np.linalg.norm(model.offsets[path].sum(0)), np.linalg.norm(vector)
        offsets[path], is_beyond[path] = 0.0, False
        offsets[path[0]] = vector
    scale = lengths_m[1] / lengths_m[0]
    offsets[is_beyond] *= scale
    ends = model.ends * scale
    for joint in np.flatnonzero(is_known & model.is_leaf):
        if (end := np.nan_to_num(source.ends[file_joints[joint]])).any():
            ends[joint] = end @ rotation_file_model[joint]
    return replace(model, offsets=offsets, ends=ends)


MAX_JOINT_ERROR_M = 1e-4  # distance of a rig's joint from that of the skeleton


def retarget_to_rig(rig: Rig, skeleton: Skeleton, motion: Motion) -> tuple[Skeleton, Motion]:
    """Return the rig's skeleton with the bone lengths of a skeleton, and the motion on it, after a T-pose if the rig wants one.

    A rig that names no joint FingerBase gets the skeleton's Hand at the wrist (`place_hands_at_wrists`).

    Raises:
        WriteError: If the skeleton lacks a joint, or if a joint rotates that the rig omits.
    """
    joints = _find_joints(rig, skeleton, [joint.joint for joint in rig.joints])
    if not any(joint.joint.endswith("FingerBase") for joint in rig.joints):
        skeleton, motion = place_hands_at_wrists(skeleton, motion)
    alignment = _align_rig(rig, skeleton, joints)
    positions, rotations = compute_world_poses(skeleton, motion)
    local_rotations = alignment.convert_rotations(rotations)
    rig_motion = replace(motion, root_position=np.ascontiguousarray(positions[:, joints[0]]), local_rotations=local_rotations)
    rig_positions, _ = compute_world_poses(alignment.skeleton, rig_motion)
    error_m = np.linalg.norm(rig_positions - positions[:, joints], axis=-1).max(0)
    if error_m.max() > MAX_JOINT_ERROR_M:
        name = rig.joints[int(error_m.argmax())].name
        raise WriteError(
            f"A BVH for {rig.program} cannot be written: {name} would be off by {error_m.max() * 1e3:.1f} mm, because a joint "
            "above it rotates that this rig omits; choose another rig, or the plain BVH."
        )
    if rig.first_frame == "t-pose":
        t_pose = pose_skeleton(skeleton, "t-pose").compute_rest_pose()[1]
        rig_motion = _prepend_pose(alignment.skeleton, rig_motion, alignment.convert_rotations(t_pose[None])[0], rig.rotations)
    return alignment.skeleton, rig_motion


def place_hands_at_wrists(skeleton: Skeleton, motion: Motion) -> tuple[Skeleton, Motion]:
    """Return the skeleton with its joints Hand at the wrists, where the joints FingerBase are, and the motion on it.

    A forearm points from the elbow to the wrist of the motion and has the length of the rest pose, a hand rotates as FingerBase
    does, and all other joints as before. Where the solved Hand bends, the wrist of the motion is nearer to the elbow than in the
    rest pose; by so much the new joint lies beyond it.
    """
    positions, rotations = compute_world_poses(skeleton, motion)
    rest_positions, rest_rotations = skeleton.compute_rest_pose()
    offsets, rest_rotations = skeleton.offsets.copy(), rest_rotations.copy()
    for wrist in [joint for joint, name in enumerate(skeleton.names) if name.endswith("FingerBase")]:
        hand = skeleton.parents[wrist]
        elbow, below = skeleton.parents[hand], skeleton.parents == hand
        offsets[hand] = (rest_positions[wrist] - rest_positions[elbow]) @ rest_rotations[elbow]
        offsets[below] = (rest_positions[below] - rest_positions[wrist]) @ rest_rotations[wrist]
        rest_rotations[hand], rotations[:, hand] = rest_rotations[wrist], rotations[:, wrist]
        forearm = positions[:, wrist] - positions[:, elbow]
        rotations[:, elbow] = compute_shortest_rotations(rotations[:, elbow] @ offsets[hand], forearm) @ rotations[:, elbow]
    placed = replace(skeleton, offsets=offsets, rest_rotations=compute_local_rotations(rest_rotations, skeleton.parents))
    return placed, replace(motion, local_rotations=compute_local_rotations(rotations, skeleton.parents))


def _find_joints(rig: Rig, skeleton: Skeleton, names: list[str]) -> Int[np.ndarray, " R"]:
    """Return the indices of joints of the skeleton. Raises WriteError if it lacks one."""
    if missing := [name for name in names if name not in skeleton.names]:
        raise WriteError(f"A BVH for {rig.program} cannot be written: the skeleton has no joint {missing[0]}.")
    return np.array([skeleton.find_joint(name) for name in names])


def _align_rig(rig: Rig, skeleton: Skeleton, joints: Int[np.ndarray, " R"]) -> SkeletonAlignment:
    """Return the rig's skeleton: the places of the skeleton's R joints in its rest pose, and end sites for its leaves."""
    axes = _find_joints(rig, skeleton, [joint.axes for joint in rig.joints])
    ends = _find_joints(rig, skeleton, [joint.end for joint in rig.joints])
    parents, names = np.array(rig.parents), tuple(joint.name for joint in rig.joints)
    posed = pose_skeleton(skeleton, rig.rest)
    positions, rotations = posed.compute_rest_pose()
    tips = np.where(np.isnan(skeleton.ends), positions, posed.compute_rest_ends())
    offsets = positions[joints] - positions[joints[parents]]
    offsets[0] = 0.0
    rig_skeleton = Skeleton(names, parents, offsets, tips[ends] - positions[joints])
    rig_skeleton.ends[~rig_skeleton.is_leaf] = np.nan
    return SkeletonAlignment(rig_skeleton, axes, rotations[axes].swapaxes(-1, -2))


def pose_skeleton(skeleton: Skeleton, pose_name: str) -> Skeleton:
    """Return a skeleton in another rest pose, in which its bones have the directions of a shipped pose, such as "t-pose"."""
    bones = read_shipped_yaml("rigs/poses.yaml")[pose_name]
    rotations = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for joint, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        if parent >= 0:
            rotations[joint] = rotations[parent]
        end, direction = bones.get(name, (None, None))
        if end in skeleton.names:
            current = rotations[joint] @ skeleton.offsets[skeleton.find_joint(end)]
            rotations[joint] = compute_shortest_rotation(current, np.array(direction, float)) @ rotations[joint]
    return replace(skeleton, rest_rotations=compute_local_rotations(rotations, skeleton.parents))


def _prepend_pose(skeleton: Skeleton, motion: Motion, local_rotations: Float[np.ndarray, "J 3 3"], order: str) -> Motion:
    """Return the motion after one frame of a pose that stands on the floor below the motion's first position.

    Its angles are whole degrees, by which readers of CMU's files distinguish the pose from the motion.
    """
    angles = np.round(scipy.spatial.transform.Rotation.from_matrix(local_rotations).as_euler(order, degrees=True))
    local_rotations = scipy.spatial.transform.Rotation.from_euler(order, angles, degrees=True).as_matrix()
    posed = replace(skeleton, rest_rotations=local_rotations)
    lowest = min(posed.rest_positions[:, 1].min(), np.nanmin(posed.compute_rest_ends()[:, 1]))
    first = motion.select_frames(np.zeros(1, int))
    root_position = np.array([[first.root_position[0, 0], -lowest, first.root_position[0, 2]]])
    pose = replace(first, root_position=root_position, local_rotations=local_rotations[None])
    return Motion(*(np.concatenate([getattr(pose, name), values]) for name, values in vars(motion).items()))
