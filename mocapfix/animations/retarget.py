"""How the 31 joints lie in a file's body, whatever its rest pose is.

The two rest poses differ: a file's arms may hang, its legs stand straight. In a pose in which the file's figure stands, ours
is put likewise: hips, trunk and head turned to where it faces, each limb's bone laid along its own. There a joint of ours
stands to its counterpart by a rotation A, and as both move with the same part of the body it does always:
W = V A, for the world rotation W of ours and V of the file's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.animation import Animation
from mocapfix.animations.joint_mapping import JointMapping, find_ancestor, find_descendants, find_path
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

# MERGED: mocapfix.fitted
SIDE_PREFIXES = ("Left", "Right")
# bone of ours: the next joint, towards which it points
LIMB_BONE_ENDS = {
    side + a: side + b for side in SIDE_PREFIXES for a, b in (("UpLeg", "Leg"), ("Leg", "Foot"), ("Foot", "ToeBase"))
}
LIMB_BONE_ENDS |= {side + a: side + b for side in SIDE_PREFIXES for a, b in (("Arm", "ForeArm"), ("ForeArm", "Hand"))}
PARENT_ALIGNED_JOINTS = ("Hand", "FingerBase", "HandIndex1", "Thumb", "ToeBase")  # turned as what they hang on
MIN_UPRIGHT_COSINE = 0.8  # cosine: a figure stands where trunk, thighs and shins are within 37 degrees of upright
MAX_ALIGNMENT_FRAMES = 200  # frames that tell lengths and how it stands


@dataclass(frozen=True)
class SkeletonAlignment:
    """How the 31 joints lie in a file's body.

    joints    (31,) the file's joint for each of ours, -1 where there is none
    turns     (31, 3, 3) A: the axes of ours in the file's joint
    skeleton  the 31 joints with the file's lengths, in metres: it lies on the file's joints wherever these are rigid
    """

    file_joints: np.ndarray
    rotation_file_model: np.ndarray
    skeleton: Skeleton


def align_skeleton(animation: Animation, mapping: JointMapping) -> SkeletonAlignment | None:
    """-> how the 31 joints lie in the animation's body; None where the figure stands neither in the rest pose nor ever."""
    few = animation.replace_values(animation.values[:: max(1, animation.frame_count // MAX_ALIGNMENT_FRAMES)])
    moving = few.compute_world_poses()
    resting = animation.compute_rest_positions()[None], np.tile(np.eye(3), (1, len(animation.names), 1, 1))
    for positions, rotations in (resting, moving):
        straight = np.nan_to_num(_compute_uprightness(positions, mapping.file_joints), nan=-1.0)
        best = int(np.argmax(straight))
        if straight[best] > MIN_UPRIGHT_COSINE:
            stands = _StandingPose(animation, positions[best], rotations[best], mapping.file_joints)
            turns = _compute_axis_rotations(stands)
            return SkeletonAlignment(
                mapping.file_joints, turns, _build_aligned_skeleton(animation, *moving, mapping.file_joints, turns)
            )
    return None


@dataclass(frozen=True)
class _StandingPose:
    """A file's figure in a pose in which it stands: its joints' positions (J, 3) and rotations (J, 3, 3) in the world."""

    animation: Animation
    positions: np.ndarray
    rotations: np.ndarray
    file_joints: np.ndarray

    def compute_vector(self, first: str, second: str) -> np.ndarray:
        """-> (3,) metres: the way from one of the 31 joints to another, both of them known."""
        names = load_cmu31_body().skeleton.names
        return self.positions[self.file_joints[names.index(second)]] - self.positions[self.file_joints[names.index(first)]]

    def compute_bone(self, name: str) -> np.ndarray:
        """-> (3,) the way from a joint to the next, or to its end site where the figure ends there; zero where it is unknown."""
        names = load_cmu31_body().skeleton.names
        own = self.file_joints[names.index(name)]
        if own >= 0 and self.file_joints[names.index(LIMB_BONE_ENDS[name])] >= 0:
            return self.compute_vector(name, LIMB_BONE_ENDS[name])
        ends = self.animation.end_sites[own] if own >= 0 else np.empty((0, 3))
        return self.rotations[own] @ self.animation.rotation_y_up_file @ ends[0] if len(ends) else np.zeros(3)


def _compute_uprightness(positions: np.ndarray, file_joints: np.ndarray) -> np.ndarray:
    """-> (T,) how upright figures at places (T, J, 3) stand: the least cosine of trunk, thighs and shins with the upright."""
    names = load_cmu31_body().skeleton.names
    at = {name: positions[:, file_joints[names.index(name)]] for name in names if file_joints[names.index(name)] >= 0}
    arms = (at["LeftArm"] + at["RightArm"]) / 2
    ways = [arms - at["Hips"]]
    for side in SIDE_PREFIXES:
        ways.append(at[side + "UpLeg"] - at[side + "Leg"])
        if side + "Foot" in at:
            ways.append(at[side + "Leg"] - at[side + "Foot"])
    upward = [way[:, 1] / np.maximum(np.linalg.norm(way, axis=1), 1e-9) for way in ways]
    return np.min(upward, axis=0)


def _compute_axis_rotations(standing: _StandingPose) -> np.ndarray:
    """-> (31, 3, 3) A, of a figure that stands."""
    ours, joints = load_cmu31_body().skeleton, standing.file_joints
    across = standing.compute_vector("RightUpLeg", "LeftUpLeg")
    facing = Rotation.from_euler("y", np.arctan2(-across[2], across[0])).as_matrix()
    world = np.tile(facing, (len(ours.names), 1, 1))
    for joint, name in enumerate(ours.names):
        if name.endswith(PARENT_ALIGNED_JOINTS):
            world[joint] = world[ours.parents[joint]]
        elif name in LIMB_BONE_ENDS and (bone := standing.compute_bone(name)).any():
            world[joint] = compute_shortest_rotation(facing @ ours.offsets[ours.find_joint(LIMB_BONE_ENDS[name])], bone) @ facing
    known = joints >= 0
    turns = np.tile(np.eye(3), (len(ours.names), 1, 1))
    turns[known] = np.swapaxes(standing.rotations[joints[known]], 1, 2) @ world[known]
    return turns


def _build_aligned_skeleton(
    animation: Animation, positions: np.ndarray, rotations: np.ndarray, file_joints: np.ndarray, rotation_file_model: np.ndarray
) -> Skeleton:
    """-> the 31 joints with the lengths of the file's, whose joints are at positions (T, J, 3), turned (T, J, 3, 3).

    Where unknown joints lie between two known ones they are put at the lower one, so that it lies where it does however
    they turn. What has no counterpart at the body's tips has an average body's lengths, at this one's size.
    """
    ours, known = load_cmu31_body().skeleton, file_joints >= 0
    offsets, ends, own, average = ours.offsets.copy(), ours.ends.copy(), 0.0, 0.0
    offsets[0] = 0.0
    for joint in np.flatnonzero(known)[1:].tolist():
        above = find_ancestor(joint, ours.parents, known)
        between = find_path(joint, above, ours.parents)
        leading = rotations[:, file_joints[above]] @ rotation_file_model[above]
        apart = positions[:, file_joints[joint]] - positions[:, file_joints[above]]
        average += np.linalg.norm(ours.offsets[between].sum(0))
        offsets[between] = 0.0
        offsets[between[0]] = np.nanmean(np.einsum("tij,ti->tj", leading, apart), axis=0)
        own += np.linalg.norm(offsets[between[0]])
    for joint in range(len(offsets)):
        ends[joint] *= own / average
        if not find_descendants(joint, ours.parents, known):
            offsets[joint] *= own / average
    for joint in np.flatnonzero(known & ~np.isnan(ends[:, 0])):
        if len(there := animation.end_sites[file_joints[joint]]) and there[0].any():
            ends[joint] = animation.rotation_y_up_file @ there[0] * animation.unit_m @ rotation_file_model[joint]
    return replace(ours, offsets=offsets, ends=ends)


# MERGED: mocapfix.retarget
# Poses of a file's body as poses of the 31 joints, and back into the file's joints.
TRUNK_CHAIN_JOINTS = (
    "LowerBack",
    "Spine",
    "Spine1",
    "Neck",
    "Neck1",
    "Head",
)  # of a bend between two known ones each takes its part


def convert_to_cmu31(animation: Animation, alignment: SkeletonAlignment) -> tuple[np.ndarray, np.ndarray]:
    """-> root (T, 3) in metres and local rotations (T, 31, 3, 3) of `fit.skeleton`, in its axes: a T-pose facing +Z at rest.

    Joints without a counterpart rest on their parent, but those of the trunk and the neck, which share evenly in the turn
    between the two known joints they lie between.
    """
    positions, rotations = animation.compute_world_poses()
    return positions[:, alignment.file_joints[0]], convert_rotations_to_cmu31(rotations, alignment)


def convert_rotations_to_cmu31(rotations: np.ndarray, alignment: SkeletonAlignment) -> np.ndarray:
    """-> (T, 31, 3, 3) local rotations as `to_cmu31`, of the file's joints turned as rotations (T, J, 3, 3) in the world say."""
    parents, known = alignment.skeleton.parents, alignment.file_joints >= 0
    world = np.tile(np.eye(3), (len(rotations), len(parents), 1, 1))
    world[:, known] = rotations[:, alignment.file_joints[known]] @ alignment.rotation_file_model[known]
    local = np.tile(np.eye(3), (len(rotations), len(parents), 1, 1))
    for joint in np.flatnonzero(known).tolist():
        above = find_ancestor(joint, parents, known)
        turn = np.swapaxes(world[:, above], 1, 2) @ world[:, joint] if above >= 0 else world[:, joint]
        chain = _list_sharing_joints(joint, above, alignment.skeleton)
        part = turn if len(chain) == 1 else _scale_rotations(turn, 1 / len(chain))
        local[:, chain] = part[:, None]
    return local


def from_cmu31(
    animation: Animation, fit: SkeletonAlignment, joints: Sequence[int], frames: np.ndarray, rotations: np.ndarray
) -> np.ndarray:
    """-> (T, C) the animation's values with some of the 31 joints (n,) in some frames (m,) turned as local rotations
    (m, 31, 3, 3) say; the inverse of `to_cmu31` for these.

    A joint without a counterpart turns the next below it that has one, if there is one. What lies between two counterparts in
    the file's tree stays as it is, and the lower of them takes the whole turn: its orientation in the world is exact.
    """
    known = fit.file_joints >= 0
    local = animation.replace_values(animation.values[frames]).compute_local_rotations()
    turned = sorted({each for joint in joints for each in find_descendants(int(joint), fit.skeleton.parents, known)})
    new = np.empty((len(frames), len(turned), 3, 3))
    for at, joint in enumerate(turned):
        new[:, at] = compute_file_rotation(animation.parents, local, fit, joint, rotations)
    return animation.replace_rotations(fit.file_joints[turned], frames, new)


def compute_file_rotation(
    parents: np.ndarray, file_rotations: np.ndarray, alignment: SkeletonAlignment, joint: int, model_rotations: np.ndarray
) -> np.ndarray:
    """-> (m, 3, 3) the local rotation of the file's joint for one of ours, where ours turn as rotations (m, 31, 3, 3) and the
    file's, in a tree parents (J,), as local (m, J, 3, 3) say."""
    above, own = find_ancestor(joint, alignment.skeleton.parents, alignment.file_joints >= 0), alignment.file_joints[joint]
    turn = _multiply_rotations(model_rotations, find_path(joint, above, alignment.skeleton.parents))
    lead = alignment.rotation_file_model[above] if above >= 0 else np.eye(3)
    between = find_path(int(parents[own]), alignment.file_joints[above] if above >= 0 else -1, parents)
    return np.swapaxes(_multiply_rotations(file_rotations, between), 1, 2) @ lead @ turn @ alignment.rotation_file_model[joint].T


def _multiply_rotations(rotations: np.ndarray, path: list[int]) -> np.ndarray:
    """-> (m, 3, 3) the product of local rotations (m, J, 3, 3) along a way."""
    turn = np.tile(np.eye(3), (len(rotations), 1, 1))
    for joint in path:
        turn = turn @ rotations[:, joint]
    return turn


def _list_sharing_joints(joint: int, ancestor: int, skeleton: Skeleton) -> list[int]:
    """-> the joints that share in the turn from a known joint above to `joint`: those of the trunk, or it alone."""
    between = find_path(joint, ancestor, skeleton.parents)
    return between if all(skeleton.names[each] in TRUNK_CHAIN_JOINTS for each in between) else [joint]


def _scale_rotations(rotations: np.ndarray, fraction: float) -> np.ndarray:
    """-> (T, 3, 3) of rotations (T, 3, 3) the part of their angle, NaN where they are."""
    parts, there = rotations.copy(), np.isfinite(rotations).all((1, 2))
    parts[there] = Rotation.from_rotvec(Rotation.from_matrix(rotations[there]).as_rotvec() * fraction).as_matrix()
    return parts
