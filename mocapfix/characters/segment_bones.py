"""Check which bones a person or a file gives to the segments of a body, and build the mapping."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Int

from mocapfix.characters.character import (
    SEGMENTS,
    SIDES,
    SINGLE_BONE_SEGMENTS,
    TWISTING_SEGMENTS,
    BoneMapping,
)
from mocapfix.errors import SceneError

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
        reason: Sentence on how the mapping was found.
        source: File that gives the names, for error messages.

    Raises:
        SceneError: If a segment or bone is unknown or missing, a bone is used twice, or a chain is out of order. The message
            gives the file and the key.
    """
    indices: dict[str, int] = {}
    for bone, name in enumerate(names):
        indices.setdefault(name, bone)
    _check_segment_names(segments, twists, source)
    uses: dict[str, str] = {}
    for key, name in _iterate_uses(segments, twists):
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
    )
    if missing := mapping.missing_segments:
        raise SceneError(f"{source}: segments.{missing[0]}: is missing; a body needs {', '.join(missing)}.")
    _check_order(names, parents, mapping, source)
    return mapping


def is_below(bone: int, above: int, parents: Int[np.ndarray, " J"]) -> bool:
    """Return whether a bone is a descendant of another."""
    bone = int(parents[bone])
    while bone >= 0 and bone != above:
        bone = int(parents[bone])
    return bone >= 0


def list_path(bone: int, above: int, parents: Int[np.ndarray, " J"]) -> list[int]:
    """Return the bones from the child of `above` (-1: from a root) down to `bone`."""
    path: list[int] = []
    while bone not in (above, -1):
        path.insert(0, int(bone))
        bone = int(parents[bone])
    return path


def find_common_ancestor(bones: Sequence[int], parents: Int[np.ndarray, " J"]) -> int:
    """Return the lowest bone that is each of some bones or above it, -1 if they have none in common."""
    candidate = bones[0]
    while candidate >= 0 and not all(bone == candidate or is_below(bone, candidate, parents) for bone in bones):
        candidate = int(parents[candidate])
    return candidate


def _check_segment_names(segments: Mapping[str, Sequence[str]], twists: Mapping[str, Sequence[str]], source: str) -> None:
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


def _iterate_uses(segments: Mapping[str, Sequence[str]], twists: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, str]]:
    """Yield each key of the file with each name of a bone in it."""
    for title, group in (("segments", segments), ("twists", twists)):
        for segment, bones in group.items():
            for name in bones:
                yield f"{title}.{segment}", name


def _check_order(names: Sequence[str], parents: Int[np.ndarray, " J"], mapping: BoneMapping, source: str) -> None:
    for chain in SEGMENT_CHAINS:
        above = -1
        for segment in chain:
            for bone in mapping.bones.get(segment, ()):
                if above >= 0 and not is_below(bone, above, parents):
                    raise SceneError(
                        f"{source}: segments.{segment}: the bone {names[bone]!r} is not below {names[above]!r}; name the bones "
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
