"""The joints of an animation: as those of the 31-joint skeleton, by their names; and as points in the world.

The naming conventions of programs are read from scenes/hierarchies, one file for each.

The rest poses of a file and of the 31-joint skeleton differ: a file's arms may hang, its legs may be parallel. The alignment is
computed from a pose in which the file's figure is upright. The model is posed like it: hips, trunk and head face the same way,
and each bone of the limbs points along the file's bone. In that pose, the axes of a model joint are rotated by A relative to
those of its counterpart. A is constant, since both move with the same part of the body, so that W = V A for the world rotations
W of the model's joint and V of the file's joint.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import takewhile
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field

from mocapfix.errors import format_name_list
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import JointName, StrictModel, find_by_name, read_yaml_model
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import Skeleton, find_ancestor, list_path, load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

IGNORED_CHARACTERS = re.compile(r"[\W_]+")  # in joint names
REQUIRED_JOINTS = ("Hips", "Spine1") + tuple(
    side + bone for side in ("Left", "Right") for bone in ("UpLeg", "Leg", "Arm", "ForeArm")
)
MIN_COMMON_PREFIX_LENGTH = 3  # letters: a shorter prefix of all names is regarded as chance
PREFIX_MIN_JOINTS = len(REQUIRED_JOINTS)  # joints of a tree whose names' common prefix is ignored


class _NamingConventionFile(StrictModel):
    name: str
    title: str
    joints: dict[JointName, tuple[str, ...]] = Field(min_length=1)


@dataclass(frozen=True)
class NamingConvention:
    """The names that some programs give to joints."""

    name: str  # name, title: short, and for people
    title: str
    # names of each of the 31 joints, the most likely first. Each joint of a file is assigned once, to the first of the 31
    # joints, in this order, that has its name
    candidate_names: dict[str, tuple[str, ...]]

    def match_joints(self, names: Sequence[str], parents: Int[np.ndarray, " J"]) -> Int[np.ndarray, " 31"]:
        """Return, for each of the 31 joints, the index of a file's joint, -1 if there is none.

        names, parents  of the file's joints
        """
        index_by_name: dict[str, int] = {}
        for spelling in (normalise_names(names), [_normalise_name(name) for name in names]):
            for joint, name in enumerate(spelling):
                index_by_name.setdefault(name, joint)
        model = load_cmu31_body().skeleton
        file_joints = np.full(len(model.names), -1)
        for model_joint, candidates in self.candidate_names.items():
            known = (index_by_name[name] for name in map(_normalise_name, candidates) if name in index_by_name)
            file_joints[model.find_joint(model_joint)] = next((joint for joint in known if joint not in file_joints), -1)
        return _discard_misplaced_joints(file_joints, parents, model.parents)


@dataclass(frozen=True)
class JointMapping:
    """The 31 joints in a file's tree."""

    # (31,) index of the file's joint for each, -1 if there is none; None if the file lacks required joints
    file_joints: Int[np.ndarray, " 31"] | None
    reason: str  # sentence on what was found


def map_joints(names: Sequence[str], parents: Int[np.ndarray, " J"], convention: str | Path | None = None) -> JointMapping:
    """Map the joints of a tree to the 31-joint skeleton, by the naming convention that matches the most or by the given one.

    Case, punctuation, namespaces ("Jim:Hips") and a prefix of all names are ignored. Hips, thorax, both legs and both arms
    are required.

    convention  name of a shipped naming convention, or a YAML file. Raises SceneError if there is no such convention.
    """
    conventions = (load_naming_convention(convention),) if convention is not None else load_shipped_conventions()
    matches = [(each, each.match_joints(names, parents)) for each in conventions]
    best, file_joints = max(matches, key=lambda match: (not _find_missing_joints(match[1]), (match[1] >= 0).sum()))
    count = int((file_joints >= 0).sum())
    if missing := _find_missing_joints(file_joints):
        nearest = (
            f"the nearest convention, {best.title}, lacks {format_name_list(missing)}" if count else "no joint name is known"
        )
        return JointMapping(
            None, f"The joint names are not those of a body: {nearest}; give a YAML file of the names (--hierarchy)."
        )
    return JointMapping(file_joints, f"{best.title}: found {count} of the {len(file_joints)} joints.")


def _find_missing_joints(file_joints: Int[np.ndarray, " 31"]) -> list[str]:
    names = load_cmu31_body().skeleton.names
    return [name for name in REQUIRED_JOINTS if file_joints[names.index(name)] < 0]


def _discard_misplaced_joints(
    file_joints: Int[np.ndarray, " 31"], parents: Int[np.ndarray, " J"], model_parents: Int[np.ndarray, " 31"]
) -> Int[np.ndarray, " 31"]:
    """Discard matches that are not below the match of the nearest model joint above them."""
    kept = file_joints.copy()
    for model_joint, file_joint in enumerate(file_joints):
        above = find_ancestor(model_joint, model_parents, kept >= 0)
        if above >= 0 and file_joint >= 0:
            ancestor = file_joint
            while ancestor >= 0 and ancestor != kept[above]:
                ancestor = parents[ancestor]
            kept[model_joint] = file_joint if ancestor >= 0 else -1
    return kept


def find_descendants(joint: int, parents: Int[np.ndarray, " J"], is_candidate: Bool[np.ndarray, " J"]) -> list[int]:
    """Return a joint if it is a candidate, otherwise the nearest candidates below it."""
    if is_candidate[joint]:
        return [joint]
    children = np.flatnonzero(parents == joint).tolist()
    return [each for child in children for each in find_descendants(child, parents, is_candidate)]


def normalise_names(names: Sequence[str]) -> list[str]:
    """Return joint names without namespaces, punctuation, case and the prefix of all names (such as "mixamorig")."""
    bare = [_normalise_name(re.split(r"[:|]", name)[-1]) for name in names]
    # The root is excluded because its whole name may be the prefix, such as Bip01.
    common = takewhile(lambda letters: len(set(letters)) == 1, zip(*bare[1:], strict=False))
    prefix = "".join(letters[0] for letters in common)
    if len(prefix) < MIN_COMMON_PREFIX_LENGTH or len(bare) < PREFIX_MIN_JOINTS:
        return bare
    return [name.removeprefix(prefix) or name for name in bare]


def _normalise_name(name: str) -> str:
    return IGNORED_CHARACTERS.sub("", name).lower()


@cache
def load_shipped_conventions() -> tuple[NamingConvention, ...]:
    """Load the shipped naming conventions, sorted by name."""
    return tuple(_read_naming_convention(path) for path in sorted((find_shipped_folder("scenes") / "hierarchies").glob("*.yaml")))


def load_naming_convention(name_or_path: str | Path) -> NamingConvention:
    """Load a shipped naming convention by name, or one from a YAML file.

    Raises SceneError, which lists the shipped ones if there is none of the name, or names the wrong key of a file.
    """
    shipped = {each.name: each for each in load_shipped_conventions()}
    return find_by_name(name_or_path, shipped, "naming convention", _read_naming_convention)


def _read_naming_convention(path: Path) -> NamingConvention:
    model = read_yaml_model(_NamingConventionFile, path)
    return NamingConvention(model.name, model.title, dict(model.joints))


def build_joint_take(animation: Animation) -> Take:
    """Build the take of an animation's joint positions."""
    return _build_point_take(animation, animation.compute_world_poses()[0], animation.names)


def build_tip_take(animation: Animation) -> Take:
    """Build the take of an animation's joint tips, followed by the position of the joint that moves the figure.

    The tip of a joint is the mean of its children and end sites. A rotation error of a joint displaces its tip but not the
    joint itself, so faults and changes refer to tips.
    """
    positions, rotations = animation.compute_world_poses()
    points = np.empty((animation.frame_count, len(animation.names) + 1, 3))
    for joint in range(len(animation.names)):
        end_offsets = animation.end_sites[joint] @ animation.rotation_y_up_file.T * animation.unit_m
        end_positions = positions[:, [joint]] + end_offsets @ np.swapaxes(rotations[:, joint], -1, -2)
        outer = np.concatenate([positions[:, animation.parents == joint], end_positions], axis=1)
        points[:, joint] = outer.mean(1) if outer.shape[1] else positions[:, joint]
    points[:, -1] = positions[:, animation.moving_joint]
    return _build_point_take(animation, points, list_track_names(animation.names, animation.moving_joint))


def list_track_names(joint_names: tuple[str, ...], moving_joint: int = 0) -> tuple[str, ...]:
    """Return the names of an animation's J + 1 tracks: the rotations of its joints and the position of the one that moves it."""
    return (*joint_names, f"{joint_names[moving_joint]} position")


def compute_joint_point_sd(animation: Animation, points: Take, variance: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T M"]:
    """Compute the standard deviations per axis, in metres, of an animation's joints or tips from those of its tracks.

    points    as from `build_joint_take` or `build_tip_take`
    variance  per axis, of the joints' rotations (rad^2) and of the root's position (m^2), as the last of N = J + 1 tracks

    A small rotation about an axis moves a point by the angle times the point's distance from the axis.
    """
    frames = np.flatnonzero(variance.any(1))
    positions, frame_variance = animation.replace_values(animation.values[frames]).compute_world_poses()[0], variance[frames]
    squared = np.tile(frame_variance[:, -1:], (1, len(points.labels)))
    for joint in range(len(animation.parents)):
        ancestor = joint
        while ancestor >= 0:
            squared_distance = ((points.markers[frames, joint] - positions[:, ancestor]) ** 2).sum(-1)
            squared[:, joint] += frame_variance[:, ancestor] * squared_distance * 2 / 3
            ancestor = animation.parents[ancestor]
    sd = np.zeros(points.visible.shape)
    sd[frames] = np.sqrt(squared)
    return sd


def _build_point_take(animation: Animation, points: Float[np.ndarray, "T M 3"], labels: tuple[str, ...]) -> Take:
    return Take(
        points,
        labels,
        animation.rate,
        animation.first_frame,
        animation.path,
        notes=animation.notes,
        point_kind="joint",
    )


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
    """How the 31 joints lie in the body of a file."""

    file_joints: Int[np.ndarray, " 31"]  # index of the file's joint for each, -1 if there is none
    rotation_file_model: Float[np.ndarray, "31 3 3"]  # A: the axes of each model joint in those of the file's joint
    # the 31-joint skeleton with the file's bone lengths in metres. Its joints coincide with the file's as far as these are at a
    # constant distance from each other
    skeleton: Skeleton


def align_skeleton(animation: Animation, file_joints: Int[np.ndarray, " 31"]) -> SkeletonAlignment | None:
    """Align the 31-joint skeleton with an animation. Returns None if the figure is never upright, not even in its rest pose.

    file_joints  as in `JointMapping`, with the required joints
    """
    sampled = animation.replace_values(animation.values[:: max(1, animation.frame_count // MAX_ALIGNMENT_FRAMES)])
    moving_poses = sampled.compute_world_poses()
    rest_poses = animation.skeleton.rest_positions[None], np.tile(np.eye(3), (1, len(animation.names), 1, 1))
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
    from scipy.spatial.transform import Rotation  # slow to import

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
        path = list_path(joint, above, model.parents)
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
    rotation_above_joint = _multiply_rotations(model_rotations, list_path(joint, above, alignment.skeleton.parents))
    rotation_file_above = alignment.rotation_file_model[above] if above >= 0 else np.eye(3)
    path = list_path(int(parents[file_joint]), int(alignment.file_joints[above]) if above >= 0 else -1, parents)
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
    path = list_path(joint, ancestor, skeleton.parents)
    return path if all(skeleton.names[each] in TRUNK_CHAIN_JOINTS for each in path) else [joint]


def _scale_rotations(rotations: Float[np.ndarray, "T 3 3"], fraction: float) -> Float[np.ndarray, "T 3 3"]:
    """Return rotations about the same axes by a fraction of the angles, NaN where the rotations are."""
    from scipy.spatial.transform import Rotation  # slow to import

    scaled, is_known = rotations.copy(), np.isfinite(rotations).all((1, 2))
    scaled[is_known] = Rotation.from_rotvec(Rotation.from_matrix(rotations[is_known]).as_rotvec() * fraction).as_matrix()
    return scaled
