"""A character: a tree of bones with its rest pose, the body segments that its bones form, and its motion.

Inside the program lengths are metres, Y is up and axes are right-handed. A bone's local rotation maps its axes to its parent's
and includes the rest rotation: in the rest pose the local rotations are `rest_rotations`, not the identity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import SceneError
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, compose_transforms, decompose_transforms, is_below, list_path

SIDES = ("left", "right")
SIDE_SEGMENTS = ("clavicle", "upper_arm", "forearm", "hand", "thigh", "shin", "foot", "toe")
SEGMENTS = ("pelvis", "spine", "neck", "head", *(f"{side}_{segment}" for side in SIDES for segment in SIDE_SEGMENTS))
"""The body segments that bones form."""
LIMB_ENDS = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}
"""The segments of a limb, and the segments at which they end; both of the same side."""
TWISTING_SEGMENTS = tuple(f"{side}_{segment}" for side in SIDES for segment in LIMB_ENDS)  # segments that may have twist bones
SINGLE_BONE_SEGMENTS = (
    "pelvis", "head", *(f"{side}_{segment}" for side in SIDES for segment in ("clavicle", "hand", "foot", "toe")),
)  # fmt: skip
"""Segments of one bone; the others may have several: vertebrae, or parts of a limb that share its twist."""
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
FINGER_BONE_COUNTS = (2, 3)  # bones of a finger that turn, without metacarpal
REQUIRED_SEGMENTS = ("pelvis", *(f"{side}_{segment}" for side in SIDES for segment in (*LIMB_ENDS, "foot")))


def get_next_segment(segment: str) -> str:
    """Return the segment at which one of TWISTING_SEGMENTS ends."""
    side, _, name = segment.partition("_")
    return f"{side}_{LIMB_ENDS[name]}"


@dataclass(frozen=True)
class BoneMapping:
    """Which bones of a character form the segments of its body."""

    # segment (one of SEGMENTS) to the indices of its bones, from the pelvis outwards. The bones of a limb's segment lie one after
    # the other, and the last of them carries the next segment. Segments that a character lacks are missing
    bones: Mapping[str, tuple[int, ...]]
    # segment (one of TWISTING_SEGMENTS) to bones beside the chain that only take a share of a twist, from near to far
    twists: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    reason: str = ""  # sentence on how the mapping was found
    # finger of a side ("left_" and one of FINGERS) to its bones from the palm to the tip; those of the body do without them
    fingers: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    @property
    def missing_segments(self) -> list[str]:
        """The segments without which a character cannot be posed and that this mapping lacks."""
        return [segment for segment in REQUIRED_SEGMENTS if not self.bones.get(segment)]

    def renumber(self, place: Mapping[int, int] | Sequence[int]) -> "BoneMapping":
        """Return the mapping with the new index of each bone, which `place` gives by the old one."""
        bones, twists, fingers = (
            {segment: tuple(place[bone] for bone in chain) for segment, chain in group.items()}
            for group in (self.bones, self.twists, self.fingers)
        )
        return replace(self, bones=bones, twists=twists, fingers=fingers)

    def add_sentence(self, sentence: str) -> "BoneMapping":
        """Return the mapping with a sentence behind its reason."""
        return replace(self, reason=f"{self.reason} {sentence}")


@dataclass(frozen=True)
class Character:
    """A rigged figure: the skeleton of its J bones, and which of them form the segments of its body."""

    name: str  # short, part of the names of output files
    skeleton: Skeleton  # the bones in the rest pose, with the scales of the file multiplied out
    mapping: BoneMapping
    # length in metres of one unit of the file along each bone's own axes: translations of its children in the file are the
    # skeleton's offsets divided by it
    scales: Float[np.ndarray, " J"]
    root_scale: float = 1.0  # metres in a unit of the file, for translations of the roots
    rotation_y_up_file: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))  # to axes with Y up
    has_feet_flat: bool = True  # whether the soles lie flat in the rest pose; otherwise they do so when the shins are vertical
    source: "CharacterSource | None" = None  # the file it was read from, None for a preset
    # of feet, toes, hands and head P points of the mesh of which one touches the floor first, in the rest pose in the world, m
    hulls: Mapping[str, Float[np.ndarray, "P 3"]] = field(default_factory=dict)

    @property
    def origin(self) -> str:
        """The file it was read from, or its name, for messages."""
        return self.source.path if self.source else self.name


@dataclass(frozen=True)
class CharacterSource:
    """The file of a character, for writers that keep what is in it."""

    path: str
    data: bytes
    nodes: Int[np.ndarray, " _"]  # index of each bone's node in a glTF file; empty for other formats
    kind: str  # "gltf", "bvh" or "yaml"


def reparent_bones(character: Character, carriers: Mapping[int, int]) -> Character:
    """Return a character of the same rest pose in which some bones have other parents, which are not below them."""
    if not carriers:
        return character
    skeleton, (positions, rotations) = character.skeleton, character.skeleton.compute_rest_pose()
    parents, order = skeleton.parents.copy(), list[int]()
    parents[list(carriers)] = list(carriers.values())
    for bone in range(len(parents)):
        order += [each for each in list_path(bone, -1, parents) if each not in order]
    place = {bone: index for index, bone in enumerate(order)} | {-1: -1}
    parents = np.array([place[parent] for parent in parents[order].tolist()])
    positions, rotations = positions[order], rotations[order]
    offsets, rest_rotations = decompose_transforms(positions, rotations, parents)
    source = character.source
    return replace(
        character,
        skeleton=Skeleton(
            names=tuple(skeleton.names[bone] for bone in order),
            parents=parents,
            offsets=offsets,
            ends=skeleton.ends[order],
            rest_rotations=rest_rotations,
            hinge_axes=skeleton.hinge_axes[order],
            limits_rad=skeleton.limits_rad[order],
        ),
        mapping=character.mapping.renumber(place),
        scales=character.scales[order],
        source=replace(source, nodes=source.nodes[order]) if source is not None and len(source.nodes) else source,
    )


@dataclass(frozen=True)
class CharacterMotion:
    """The motion of a character over T frames."""

    pelvis_position: Float[np.ndarray, "T 3"]  # m: the head of the pelvis bone in its parent's axes (for a root: in the world)
    local_rotations: Float[np.ndarray, "T J 3 3"]  # bones that the motion does not turn keep their rest rotation
    rate: float  # frames per second
    # bone to its head (T, 3) in its parent's axes, in metres, of other bones that change their place: a root bone
    positions: Mapping[int, Float[np.ndarray, "T 3"]] = field(default_factory=dict)

    @property
    def frame_count(self) -> int:
        return len(self.pelvis_position)

    def select_frames(self, frames: slice) -> "CharacterMotion":
        """Return some of the frames."""
        positions = {bone: each[frames] for bone, each in self.positions.items()}
        return CharacterMotion(self.pelvis_position[frames], self.local_rotations[frames], self.rate, positions)


def compute_character_poses(
    character: Character, motion: CharacterMotion
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
    """Compute the positions in metres and the rotations of the bones in the world, in every frame."""
    positions = np.tile(character.skeleton.offsets, (motion.frame_count, 1, 1))
    for bone, position in {character.mapping.bones["pelvis"][0]: motion.pelvis_position, **motion.positions}.items():
        positions[:, bone] = position
    return compose_transforms(character.skeleton.parents, positions, motion.local_rotations)


MIN_TAIL_FRACTION = 0.5  # of the distance of a bone's farthest child: nearer children, such as a thumb, do not count for its tail


def compute_tail(children: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " 3"]:
    """Return the tail of a bone with children at these positions in its axes: the mean of those that are far from its head.

    It is NaN if no child is at a distance from the head.
    """
    distances = np.linalg.norm(children, axis=1)
    is_far = (distances > MIN_TAIL_FRACTION * distances.max(initial=0.0)) & (distances > 0)
    return children[is_far].mean(0) if is_far.any() else np.full(3, np.nan)


SEGMENT_JOINTS = {
    "clavicle": ("Shoulder",), "upper_arm": ("Arm",), "forearm": ("ForeArm", "Hand"), "hand": ("FingerBase",),
    "thigh": ("UpLeg",), "shin": ("Leg",), "foot": ("Foot",), "toe": ("ToeBase",),
}  # fmt: skip
"""The joints of each segment of a side, without the side. CMU's joint Hand lies in the forearm, at two thirds of the way from the
elbow to the wrist, which is at FingerBase: the middle of the wrist's markers is beside it, not beside Hand."""
TRUNK_JOINTS = {"pelvis": ("Hips",), "spine": ("LowerBack", "Spine", "Spine1"), "neck": ("Neck", "Neck1"), "head": ("Head",)}


def build_cmu31_character(skeleton: Skeleton) -> Character:
    """Return the 31-joint skeleton as a character. Its joints have the axes of the world in the rest pose."""
    bones = {segment: tuple(map(skeleton.find_joint, joints)) for segment, joints in TRUNK_JOINTS.items()}
    for side in SIDES:
        for segment, joints in SEGMENT_JOINTS.items():
            bones[f"{side}_{segment}"] = tuple(skeleton.find_joint(side.capitalize() + joint) for joint in joints)
    ends = skeleton.ends.copy()
    for joint in np.flatnonzero(~skeleton.is_leaf):
        ends[joint] = skeleton.offsets[skeleton.parents == joint].mean(0)
    mapping = BoneMapping(bones, reason="the 31 joints of the solved body")
    return Character("cmu31", replace(skeleton, ends=ends), mapping, np.ones(len(ends)), has_feet_flat=False)


def convert_motion(motion: Motion, rate: float) -> CharacterMotion:
    """Return the motion of the 31-joint skeleton as that of its character; `rate` in frames per second."""
    return CharacterMotion(motion.root_position, motion.local_rotations, rate)


SEGMENT_CHAINS = (
    ("pelvis", "spine", "neck", "head"),
    *(("pelvis", "spine", *(f"{side}_{segment}" for segment in ("clavicle", "upper_arm", "forearm", "hand"))) for side in SIDES),
    *(("pelvis", *(f"{side}_{segment}" for segment in ("thigh", "shin", "foot", "toe"))) for side in SIDES),
)
"""segments of the body from the pelvis outwards: the bones of each are below those of the segments before it"""


def build_bone_mapping(
    names: Sequence[str],
    parents: Int[np.ndarray, " J"],
    segments: Mapping[str, Sequence[str]],
    twists: Mapping[str, Sequence[str]],
    fingers: Mapping[str, Sequence[str]] | None = None,
    *,
    reason: str,
    source: str,
) -> BoneMapping:
    """Build the mapping of segments to bones from the names of bones.

    Args:
        names: The names of the J bones.
        parents: (J,) index of each bone's parent, -1 for roots.
        segments: Segment to the names of its bones, from the pelvis outwards.
        twists: Segment to the names of the twist bones beside its chain, from near to far.
        fingers: Finger, such as left_index, to the names of its bones from the palm to the tip.
        reason: Sentence on how the mapping was found.
        source: File that gives the names, for error messages.

    Raises:
        SceneError: If a segment or bone is unknown or missing, a bone is used twice, or a chain is out of order. The message
            gives the file and the key.
    """
    indices: dict[str, int] = {}
    for bone, name in enumerate(names):
        indices.setdefault(name, bone)
    fingers = fingers or {}
    _check_segment_names(segments, twists, fingers, source)
    uses: dict[str, str] = {}
    groups = {f"segments.{each}": bones for each, bones in segments.items()}
    groups |= {f"twists.{each}": bones for each, bones in twists.items()}
    groups |= {f"fingers.{each}": bones for each, bones in fingers.items()}
    for key, name in ((key, name) for key, bones in groups.items() for name in bones):
        if name not in indices:
            raise SceneError(f"{source}: {key}: there is no bone {name!r} in this character; check its spelling.")
        if name in uses:
            raise SceneError(f"{source}: {key}: the bone {name!r} is already in {uses[name]}; a bone has one place.")
        uses[name] = key
    bones = {segment: tuple(indices[name] for name in segments[segment]) for segment in SEGMENTS if segments.get(segment)}
    mapping = BoneMapping(
        bones,
        {segment: tuple(indices[name] for name in twists[segment]) for segment in TWISTING_SEGMENTS if twists.get(segment)},
        reason,
        {finger: tuple(indices[name] for name in chain) for finger, chain in fingers.items() if chain},
    )
    if missing := mapping.missing_segments:
        raise SceneError(f"{source}: segments.{missing[0]}: is missing; a body needs {', '.join(missing)}.")
    _check_order(names, parents, mapping, source)
    return mapping


def _check_segment_names(
    segments: Mapping[str, Sequence[str]], twists: Mapping[str, Sequence[str]], fingers: Mapping[str, Sequence[str]], source: str
) -> None:
    for segment, bones in segments.items():
        if segment not in SEGMENTS:
            raise SceneError(f"{source}: segments.{segment}: there is no such segment; the segments are {', '.join(SEGMENTS)}.")
        if segment in SINGLE_BONE_SEGMENTS and len(bones) > 1:
            raise SceneError(f"{source}: segments.{segment}: has {len(bones)} bones, but this segment is one bone; name one.")
    for segment in twists:
        if segment not in TWISTING_SEGMENTS:
            raise SceneError(
                f"{source}: twists.{segment}: there are no such twist bones; they are those of {', '.join(TWISTING_SEGMENTS)}."
            )
    known = [f"{side}_{finger}" for side in SIDES for finger in FINGERS]
    for name, bones in fingers.items():
        if name not in known or len(bones) not in (0, *FINGER_BONE_COUNTS):
            raise SceneError(f"{source}: fingers.{name}: must have two or three bones and be one of {', '.join(known)}.")


def _check_order(names: Sequence[str], parents: Int[np.ndarray, " J"], mapping: BoneMapping, source: str) -> None:
    groups, fingers = {**mapping.bones, **mapping.fingers}, [(f"{each.partition('_')[0]}_hand", each) for each in mapping.fingers]
    for chain in (*SEGMENT_CHAINS, *fingers):
        above = -1
        for segment in chain:
            keys = "fingers" if segment in mapping.fingers else "segments"
            for bone in groups.get(segment, ()):
                if above >= 0 and not is_below(bone, above, parents):
                    raise SceneError(
                        f"{source}: {keys}.{segment}: the bone {names[bone]!r} is not below {names[above]!r}; name the bones "
                        "from the pelvis outwards, each below the one before."
                    )
                above = bone
    for segment, twists in mapping.twists.items():
        chain = mapping.bones[segment]
        for bone in twists:
            if not is_below(bone, chain[0], parents):
                raise SceneError(
                    f"{source}: twists.{segment}: the bone {names[bone]!r} is not below {names[chain[0]]!r}, the first bone of "
                    "the segment; name twist bones that the segment carries."
                )


def build_bone_matrices(character: Character) -> Float[np.ndarray, "J 4 4"]:
    """Return the transforms of the bones to the world in the rest pose, from the unit of the file along their axes."""
    positions, rotations = character.skeleton.compute_rest_pose()
    matrices = np.tile(np.eye(4), (len(positions), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = rotations * character.scales[:, None, None], positions
    return matrices
