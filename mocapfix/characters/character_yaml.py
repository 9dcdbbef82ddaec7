"""YAML files of characters: their bones, rest pose, segments and joint limits; mappings of bones to edit; and rigs of programs.

The characters in scenes/rigs have this form, and so have armatures that the Blender add-on writes. Positions are in metres in the
world, Y up, in a rest pose that faces +Z, so that the character's left is +X, whatever axes and units its program has. A rig has
no lengths of its own: it names the joints of the solved skeleton that a program expects in a BVH.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import scipy
from jaxtyping import Float, Int
from pydantic import BeforeValidator, Field, FiniteFloat, PositiveFloat

from mocapfix.characters.character import REQUIRED_SEGMENTS, SEGMENTS, BoneMapping, Character, CharacterSource, build_bone_mapping
from mocapfix.errors import SceneError
from mocapfix.io.files import replace_atomically
from mocapfix.io.shipped import MAX_LINE_LENGTH, InlineSequence, dump_yaml, find_shipped_folder
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.model.skeleton import UNLIMITED_RAD, Skeleton, decompose_transforms
from mocapfix.options import RIG_NAMES

ROTATION_Y_UP_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""from axes with Z up, in which the character faces -Y (Blender, Unreal's FBX), to axes with Y up, in which it faces +Z"""
MIN_TAIL_LENGTH_M = 1e-6  # shorter bones have no direction
MIN_SIDE_SINE = 1e-3
"""sine of the angle between a bone and the direction of its second axis, below which that direction determines no rotation"""


OwnAxis = Literal["X", "Y", "Z", "-X", "-Y", "-Z"]
BoneNames = Annotated[tuple[str, ...], BeforeValidator(lambda value: (value,) if isinstance(value, str) else value)]
Position = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
AngleRange = tuple[FiniteFloat, FiniteFloat]
Quaternion = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class _AxesModel(StrictModel):
    """The bones' own axes by a rule: `along` points to the tail, `second` as near to the world's direction `toward` as it can."""

    along: OwnAxis
    second: OwnAxis
    toward: Position


class _CharacterBone(StrictModel):
    name: str = Field(min_length=1)
    parent: str | None
    head: Position
    tail: Position | None = None
    along: OwnAxis | None = None
    second: OwnAxis | None = None
    toward: Position | None = None
    rotation: Quaternion | None = None
    scale_m: PositiveFloat | None = None


class _LimitModel(StrictModel):
    x: AngleRange
    y: AngleRange
    z: AngleRange


class _CharacterModel(StrictModel):
    kind: Literal["character"]
    name: str = Field(pattern=r"^\w[\w.-]*$")
    title: str = ""
    unit_m: PositiveFloat = 1.0
    up: Literal["Y", "Z"] = "Y"
    file_rotation: Quaternion | None = None
    feet_flat: bool = True
    axes: _AxesModel | None = None
    bones: tuple[_CharacterBone, ...] = Field(min_length=1)
    segments: dict[str, BoneNames] = Field(default_factory=dict)
    twists: dict[str, BoneNames] = Field(default_factory=dict)
    limits: dict[str, _LimitModel] = Field(default_factory=dict)


def read_character_yaml(path: str | Path) -> Character:
    """Read a character from a YAML file.

    A tail that is not given is at the head of the first child; a tail at the bone's own head is none. The own axes of a bone are
    those of `rotation` if given; otherwise they follow the rule `axes` of the file, whose keys a bone may replace. Under a rule,
    a bone without a tail has the axes of its parent. Without a rule the axes are parallel to the world's.

    Returns:
        The character. Its mapping is empty if the file has no segments.

    Raises:
        SceneError: If the file is invalid. The message gives the file and the key.
    """
    path = Path(path)
    model = read_yaml_model(_CharacterModel, path)
    names, parents = _check_tree(path, model)
    heads = np.array([bone.head for bone in model.bones])
    tails = _find_tails(model, parents, heads)
    rotations = _compute_world_rotations(path, model, parents, heads, tails)
    mapping = BoneMapping({})
    if model.segments:
        reason = f"{model.title or model.name}: its file names the segments' bones."
        mapping = build_bone_mapping(names, parents, model.segments, model.twists, reason=reason, source=str(path))
    offsets, rest_rotations = decompose_transforms(heads, rotations, parents)
    rotation_y_up_file = ROTATION_Y_UP_Z_UP if model.up == "Z" else np.eye(3)
    if model.file_rotation is not None:
        rotation_y_up_file = _read_quaternion(path, "file_rotation", model.file_rotation)
    return Character(
        name=model.name,
        skeleton=Skeleton(
            names,
            parents,
            offsets=offsets,
            ends=np.einsum("jba,jb->ja", rotations, tails - heads),
            rest_rotations=rest_rotations,
            limits_rad=_read_limits(path, model, names),
        ),
        mapping=mapping,
        scales=np.array([bone.scale_m or model.unit_m for bone in model.bones]),
        root_scale=model.unit_m,
        rotation_y_up_file=rotation_y_up_file.copy(),
        has_feet_flat=model.feet_flat,
        source=CharacterSource(str(path), path.read_bytes(), np.zeros(0, int), "yaml"),
    )


def _check_tree(path: Path, model: _CharacterModel) -> tuple[tuple[str, ...], Int[np.ndarray, " J"]]:
    """Return names and parents, after checking that bones are unique and listed after their parents."""
    indices: dict[str, int] = {}
    for bone, each in enumerate(model.bones):
        if each.name in indices:
            raise SceneError(f"{path}: bones.{bone}: the name {each.name!r} is used twice; bones have names of their own.")
        if each.parent is not None and each.parent not in indices:
            raise SceneError(f"{path}: bones.{bone}: the parent {each.parent!r} of {each.name!r} must be listed before it.")
        indices[each.name] = bone
    parents = [-1 if each.parent is None else indices[each.parent] for each in model.bones]
    return tuple(indices), np.array(parents)


def _find_tails(model: _CharacterModel, parents: Int[np.ndarray, " J"], heads: Float[np.ndarray, "J 3"]) -> np.ndarray:
    tails = np.full_like(heads, np.nan)
    for bone, each in enumerate(model.bones):
        children = np.flatnonzero(parents == bone)
        if each.tail is not None:
            tails[bone] = each.tail
        elif len(children):
            tails[bone] = heads[children[0]]
    tails[np.linalg.norm(tails - heads, axis=1) < MIN_TAIL_LENGTH_M] = np.nan
    return tails


def _compute_world_rotations(
    path: Path,
    model: _CharacterModel,
    parents: Int[np.ndarray, " J"],
    heads: Float[np.ndarray, "J 3"],
    tails: Float[np.ndarray, "J 3"],
) -> Float[np.ndarray, "J 3 3"]:
    """Compute the rotations from the bones' own axes to the world's."""
    rotations = np.tile(np.eye(3), (len(heads), 1, 1))
    for bone, each in enumerate(model.bones):
        if each.rotation is not None:
            rotations[bone] = _read_quaternion(path, f"bones.{bone}.rotation", each.rotation)
        elif model.axes is not None:
            vector = tails[bone] - heads[bone]
            if not np.isnan(vector).any():
                rule = (each.along or model.axes.along, each.second or model.axes.second, each.toward or model.axes.toward)
                rotations[bone] = _apply_axes_rule(f"{path}: bones.{bone} ({each.name})", rule, vector)
            elif parents[bone] >= 0:
                rotations[bone] = rotations[parents[bone]]
        elif each.along or each.second or each.toward:
            raise SceneError(f"{path}: bones.{bone}: `along`, `second` and `toward` replace those of `axes`; give this key too.")
    return rotations


def _apply_axes_rule(
    place: str, rule: tuple[OwnAxis, OwnAxis, Position], vector: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the rotation whose first own axis points along a vector and whose second points toward a direction."""
    along, second, toward = _build_own_axis(rule[0]), _build_own_axis(rule[1]), np.array(rule[2])
    direction = vector / np.linalg.norm(vector)
    toward = toward / max(float(np.linalg.norm(toward)), MIN_TAIL_LENGTH_M)
    side = toward - direction * (direction @ toward)
    if np.linalg.norm(side) < MIN_SIDE_SINE or along @ second != 0:
        raise SceneError(f"{place}: its second axis is along the bone; give the bone another `toward`, or a `rotation`.")
    side /= np.linalg.norm(side)
    own = np.stack([along, second, np.cross(along, second)], 1)
    world = np.stack([direction, side, np.cross(direction, side)], 1)
    return world @ own.T


def _build_own_axis(axis: OwnAxis) -> Float[np.ndarray, " 3"]:
    return np.eye(3)["XYZ".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)


def _read_limits(path: Path, model: _CharacterModel, names: tuple[str, ...]) -> Float[np.ndarray, "J 3 2"]:
    limits_rad = np.tile(UNLIMITED_RAD, (len(names), 1, 1))
    for name, limit in model.limits.items():
        if name not in names:
            raise SceneError(f"{path}: limits.{name}: there is no such bone in this file; check its spelling.")
        limits_deg = np.array([limit.x, limit.y, limit.z])
        limits_rad[names.index(name)] = np.deg2rad(limits_deg)
        for axis, (least, greatest) in zip("xyz", limits_deg, strict=True):
            if not least <= 0.0 <= greatest:
                raise SceneError(f"{path}: limits.{name}.{axis}: must be the least and the greatest angle, with 0 between them.")
    return limits_rad


def _read_quaternion(path: Path, key: str, values: Quaternion) -> Float[np.ndarray, "3 3"]:
    if not np.linalg.norm(values) > 0.5:
        raise SceneError(f"{path}: {key}: is no rotation; give a quaternion of length 1, [w, x, y, z].")
    return scipy.spatial.transform.Rotation.from_quat(values, scalar_first=True).as_matrix()


MAPPING_FILE_HEADER = """\
# The bones of {name} that form the segments of its body, for mocapfix. {reason}
# Correct a wrong bone here, and give the file with the same character: --character FILE --character-map THIS_FILE
# segments: the names of their bones. Spine, neck and the parts of limbs may have several, from the pelvis outwards, each below
#   the one before; an empty list [] is a segment that the character lacks.
#   Needed: {required}.
# twists: bones beside a limb that only take a share of its twist, from near to far.
# feet_flat: whether the soles lie flat in the rest pose; false: they do when the shins are vertical. Correct it where the feet of
#   the result are tilted to the side.
# All other bones keep their rest pose: fingers, face, hair, clothes. They are listed at the end.
"""
FINGERS_COMMENT = "# fingers: two or three bones that follow those of a take, from palm to tip; [] keeps the rest pose.\n"


class _MappingModel(StrictModel):
    segments: dict[str, BoneNames]
    twists: dict[str, BoneNames] = Field(default_factory=dict)
    fingers: dict[str, BoneNames] | None = None  # found by their names if the file does not give them
    feet_flat: bool | None = None


def write_mapping_file(target: str | Path, character: Character) -> None:
    """Write the mapping of a character as YAML, with the names of its bones and comments on its use.

    Raises:
        WriteError: If the folder cannot be written; an existing file is then left unchanged.
    """
    names, mapping = character.skeleton.names, character.mapping
    data: dict[str, Any] = {
        "segments": {segment: _list_names(names, mapping.bones, segment) for segment in SEGMENTS},
        "twists": {segment: _list_names(names, mapping.twists, segment) for segment in mapping.twists},
        "feet_flat": bool(character.has_feet_flat),
    }
    required = dict.fromkeys(segment.removeprefix("left_").removeprefix("right_") for segment in REQUIRED_SEGMENTS)
    header = MAPPING_FILE_HEADER.format(
        name=_flatten(character.name), reason=_flatten(mapping.reason), required=", ".join(required)
    )
    if mapping.fingers:
        data["fingers"] = {finger: _list_names(names, mapping.fingers, finger) for finger in mapping.fingers}
        header = header.replace("fingers, face", "face") + FINGERS_COMMENT
    with replace_atomically(Path(target)) as new_file:
        text = header + dump_yaml(data) + _comment_unmapped_bones(names, mapping)
        new_file.write_text(text, encoding="utf-8", newline="\n")


def read_mapping_file(path: str | Path, character: Character) -> BoneMapping:
    """Read the mapping of a character's bones from a file that `write_mapping_file` wrote, possibly edited since.

    Raises:
        SceneError: If the file is invalid, names a bone that the character lacks, a bone twice or one that is not below the bone
            before it, or lacks a segment that a body needs. The message gives the file and the key.
    """
    path = Path(path)
    model = read_yaml_model(_MappingModel, path)
    return build_bone_mapping(
        character.skeleton.names,
        character.skeleton.parents,
        model.segments,
        model.twists,
        model.fingers,
        reason=f"The mapping file {path.name}.",
        source=str(path),
    )


def has_fingers(path: str | Path) -> bool:
    """Return whether a mapping file gives the bones of fingers. Raises SceneError."""
    return read_yaml_model(_MappingModel, Path(path)).fingers is not None


def read_feet_flat(path: str | Path) -> bool | None:
    """Read whether the soles lie flat in the rest pose from a mapping file, None if it lacks this. Raises SceneError."""
    return read_yaml_model(_MappingModel, Path(path)).feet_flat


def apply_mapping_file(path: str | Path, character: Character) -> Character:
    """Return a character with the mapping of a file, and its feet as the file gives them. Raises as `read_mapping_file`."""
    mapping, feet_flat = read_mapping_file(path, character), read_feet_flat(path)
    return replace(character, mapping=mapping, has_feet_flat=character.has_feet_flat if feet_flat is None else feet_flat)


def _list_names(names: tuple[str, ...], group: Mapping[str, tuple[int, ...]], segment: str) -> InlineSequence:
    return InlineSequence(names[bone] for bone in group.get(segment, ()))


def _comment_unmapped_bones(names: tuple[str, ...], mapping: BoneMapping) -> str:
    """Return comment lines that name the bones without a segment."""
    used = {bone for group in (mapping.bones, mapping.twists, mapping.fingers) for chain in group.values() for bone in chain}
    lines = ["# bones without a segment:"]
    for bone, name in enumerate(names):
        if bone not in used:
            if len(lines[-1]) + len(name) > MAX_LINE_LENGTH - 2:
                lines.append("#")
            lines[-1] += f" {_flatten(name)},"
    return "\n".join(lines).rstrip(",") + "\n"


def _flatten(text: str) -> str:
    """Return a text on one line, as a comment must be: names in files may have any character."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())


class RigJoint(StrictModel):
    """One joint of a rig."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")  # as the program expects it
    parent: str | None  # name of the rig's joint above it; None for the root, which comes first
    joint: str = ""  # the skeleton's joint at the same position; by default the one of the same name
    axes: str = ""  # the skeleton's joint with the same rotation; by default `joint`
    # for the last bone of a chain, the skeleton's joint whose end site (or position, if it has none) ends the bone; by default
    # `axes`
    end: str = ""

    def model_post_init(self, _: object) -> None:
        """Fill in the defaults."""
        joint = self.joint or self.name
        axes = self.axes or joint
        for key, value in (("joint", joint), ("axes", axes), ("end", self.end or axes)):
            object.__setattr__(self, key, value)


class Rig(StrictModel):
    """The skeleton that a program expects."""

    name: str = ""  # name of the file, as in --bvh-for
    program: str  # name of the program
    unit_m: PositiveFloat  # length of a unit of the written file in metres
    # order of a joint's rotation channels, the outermost first: "ZYX" is R = Rz Ry Rx
    rotations: Literal["ZYX", "ZXY", "YXZ", "YZX", "XYZ", "XZY"]
    rest: Literal["t-pose", "arms-down", "skeleton"]  # pose in which all rotations are zero; "skeleton" for its own rest pose
    first_frame: Literal["t-pose", "motion"]  # whether a T-pose that faces +Z and stands on the floor precedes the motion
    # the names of fingers, of takes that show them: VRM's, those of HumanIK, or no fingers
    fingers: Literal["names", "numbers", "none"] = "none"
    note: str  # what users of the file need to know, for the report
    joints: tuple[RigJoint, ...] = Field(min_length=1)  # parents before children

    @property
    def parents(self) -> list[int]:
        """Index of each joint's parent, -1 for the root."""
        names = [joint.name for joint in self.joints]
        return [names.index(joint.parent) if joint.parent else -1 for joint in self.joints]


def load_rig(name: str | Path) -> Rig:
    """Load a shipped rig by name, or one from a YAML file.

    Raises:
        SceneError: If there is no rig of the name, or if the file is not valid, with the key that is wrong.
    """
    shipped_folder = find_shipped_folder("scenes") / "rigs"
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else shipped_folder / f"{name}.yaml"
    if path.parent == shipped_folder and path.stem not in RIG_NAMES:
        raise SceneError(f"There is no rig {str(name)!r}; choose one of {', '.join(RIG_NAMES)}, or give a .yaml file.")
    rig = read_yaml_model(Rig, path)
    known: set[str | None] = set()
    for joint in rig.joints:
        is_ordered = joint.parent in known if known else joint.parent is None
        if joint.name in known or not is_ordered:
            raise SceneError(
                f"{path}: joints: {joint.name}: must be listed once, after its parent; only the first joint is a root."
            )
        known.add(joint.name)
    if rig.fingers != "none" and (missing := {"LeftHand", "RightHand"} - {joint.joint for joint in rig.joints}):
        raise SceneError(f"{path}: fingers: need a joint at {sorted(missing)[0]}; add it, or leave out the fingers.")
    return rig.model_copy(update={"name": path.stem})
