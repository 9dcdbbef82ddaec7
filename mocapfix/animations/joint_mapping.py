"""Mapping of the joints of an animation to the 31-joint skeleton by their names.

The naming conventions of programs are read from scenes/hierarchies, one file for each.

Takes of an animation's joints as points in the world, for code that processes points instead of rotations.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
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
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.take import Take

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
    """The names that some programs give to joints.

    name, title  short, and for people
    candidate_names  names of each of the 31 joints, the most likely first. Each joint of a file is assigned once, to the
                     first of the 31 joints, in this order, that has its name
    """

    name: str
    title: str
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
    """The 31 joints in a file's tree.

    file_joints  (31,) index of the file's joint for each, -1 if there is none; None if the file lacks required joints
    reason       sentence on what was found
    """

    file_joints: Int[np.ndarray, " 31"] | None
    reason: str


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


def find_ancestor(joint: int, parents: Int[np.ndarray, " J"], is_candidate: Bool[np.ndarray, " J"]) -> int:
    """Return the nearest candidate above a joint in a tree, -1 if there is none."""
    joint = int(parents[joint])
    while joint >= 0 and not is_candidate[joint]:
        joint = int(parents[joint])
    return joint


def find_path(joint: int, above: int, parents: Int[np.ndarray, " J"]) -> list[int]:
    """Return the joints from the child of `above` (-1: from the root) down to `joint` in a tree."""
    path: list[int] = []
    while joint != above:
        path.insert(0, int(joint))
        joint = int(parents[joint])
    return path


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


def build_joint_skeleton(animation: Animation) -> tuple[Skeleton, Float[np.ndarray, "T J 3"]]:
    """Return the file's own skeleton and the positions of its joints in the world, in metres."""
    offsets = animation.bone_offsets @ animation.rotation_y_up_file.T * animation.unit_m
    skeleton = Skeleton(animation.names, animation.parents, offsets, np.full(offsets.shape, np.nan))
    return skeleton, animation.compute_world_poses()[0]


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
