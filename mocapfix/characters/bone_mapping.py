"""Find which joint or bone is which part of a body: by its name, and for a character otherwise by the shape of its skeleton.

The naming conventions of scenes/hierarchies give names to the 31 joints of the body, the characters of scenes/rigs to the
segments that their bones form. Case, separators, namespaces ("Jim:Hips"), a prefix of most names, and the way in which a name
gives its side are ignored.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field

from mocapfix.characters.bone_geometry import MAX_AXIS_DISTANCE_SHARE, MIN_TWIST_SHARE, find_segments_by_shape
from mocapfix.characters.character import (
    REQUIRED_SEGMENTS,
    SEGMENT_CHAINS,
    SEGMENT_JOINTS,
    SIDES,
    TRUNK_JOINTS,
    TWISTING_SEGMENTS,
    BoneMapping,
    Character,
    get_next_segment,
)
from mocapfix.errors import SceneError, format_name_list
from mocapfix.io.shipped import find_by_name, find_shipped_folder, read_shipped_yaml
from mocapfix.io.yaml_files import JointName, StrictModel, read_yaml_model
from mocapfix.model.skeleton import find_ancestor, find_common_joint, is_below, list_path, load_cmu31_body
from mocapfix.options import CHARACTER_PRESETS
from mocapfix.stats.rigid_alignment import split_along_line

NAMESPACE_END = re.compile(r"[:|]")
NAME_PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")  # words and numbers in a bone's name: LeftArm, upper_arm.L.001
FINAL_NUMBER = re.compile(r"_\d+$")  # an exporter numbers all nodes, such as FootL_3
MIN_NUMBERED_SHARE = 0.8  # share of names that have such numbers, and of different ones, from which they are not parts of names
IGNORED_CHARACTERS = re.compile(r"[\W_]+")
SIDE_WORDS = {"l": "left", "left": "left", "r": "right", "right": "right"}
CENTRE_WORD = "c"  # marks bones in the middle in some conventions, such as J_Bip_C_Hips
MIN_PREFIX_SHARE = 0.5  # share of the bones that begin with a word from which it is a prefix, such as mixamorig or DEF
MAX_PREFIX_PARTS = 4
MIN_COMMON_PREFIX_LENGTH = 3  # letters: a shorter prefix of all names is regarded as chance
NameKey = tuple[str, str]
"""side ("left", "right" or "") and the other words of a name, in lower case without separators and leading zeros; or "" and all
letters of a name, whose side is then not distinguished from its words"""


class _NamingConventionFile(StrictModel):
    name: str
    title: str
    joints: dict[JointName, tuple[str, ...]] = Field(min_length=1)


@dataclass(frozen=True)
class NameTable:
    """The names that one program or convention gives to the parts of a body."""

    name: str  # name, title: short, and for people
    title: str
    # one of the 31 joints or a segment, and the names of one of its bones, the most likely first
    parts: tuple[tuple[str, tuple[NameKey, ...]], ...]
    other_names: frozenset[NameKey] = frozenset()  # names of bones that are no part

    def find_parts(self, spellings: Sequence[Sequence[NameKey]]) -> list[tuple[str, int]]:
        """Return the parts with the bones that have their names; a bone is the first part of its name that it can be."""
        bone_by_key: dict[NameKey, int] = {}
        for same_spelling in zip(*spellings, strict=True):
            for bone, key in enumerate(same_spelling):
                bone_by_key.setdefault(key, bone)
        bone_by_key.pop(("", ""), None)  # of names without words
        found: list[tuple[str, int]] = []
        used = {-1}
        for part, keys in self.parts:
            bone = next((bone_by_key[key] for key in keys if bone_by_key.get(key, -1) not in used), -1)
            if bone >= 0:
                used.add(bone)
                found.append((part, bone))
        return found

    def compare_names(self, spellings: Sequence[Sequence[NameKey]]) -> float:
        """Return how similar all names are to those of the table: the share of the spellings of both that are common."""
        names = {key for each in spellings for key in each}
        own_names = self.other_names.union(*(keys for _, keys in self.parts))
        return len(own_names & names) / len(own_names | names)


def spell_names(names: Sequence[str]) -> list[tuple[NameKey, NameKey, NameKey, NameKey]]:
    """Return the spellings of each name by which tables are searched.

    They are the letters of the whole name, those without the prefix of most names, and the words of both.
    """
    bare = [NAMESPACE_END.split(name)[-1] for name in names]
    numbers = [match[0] for name in bare if (match := FINAL_NUMBER.search(name))]
    if min(len(numbers) / len(names), len(set(numbers)) / max(len(numbers), 1)) > MIN_NUMBERED_SHARE:
        bare = [FINAL_NUMBER.sub("", name) or name for name in bare]
    words, prefix = [NAME_PARTS.findall(name) for name in bare], list[str]()
    all_letters = [_join_letters(name) for name in bare]
    # The root is excluded because its whole name may be the prefix, such as Bip01.
    common = takewhile(lambda letters: len(set(letters)) == 1, zip(*all_letters[1:], strict=False))
    letter_prefix = "".join(letters[0] for letters in common)
    if len(letter_prefix) < MIN_COMMON_PREFIX_LENGTH or len(names) < len(REQUIRED_JOINTS):
        letter_prefix = ""
    for count in range(1, MAX_PREFIX_PARTS + 1):
        beginnings = Counter(tuple(each[:count]) for each in words if len(each) >= count)
        if len(names) < 2 or not beginnings:
            break
        beginning, uses = beginnings.most_common(1)[0]
        if uses < MIN_PREFIX_SHARE * len(names) or beginning[-1].lower() in SIDE_WORDS:
            break
        prefix = list(beginning)
    spellings: list[tuple[NameKey, NameKey, NameKey, NameKey]] = []
    for letters, each in zip(all_letters, words, strict=True):
        short = (each[len(prefix) :] if prefix and each[: len(prefix)] == prefix else each) or each
        short_letters = letters.removeprefix(letter_prefix or _join_letters("".join(prefix))) or letters
        spellings.append((("", letters), ("", short_letters), _build_key(each), _build_key(short)))
    return spellings


def _join_letters(name: str) -> str:
    return IGNORED_CHARACTERS.sub("", name).lower()


def _build_key(words: Sequence[str]) -> NameKey:
    lower = [word.lower() for word in words]
    side = next((SIDE_WORDS[word] for word in lower if word in SIDE_WORDS), "")
    rest = [word for word in lower if word not in SIDE_WORDS and word != CENTRE_WORD]
    return side, "".join(word.lstrip("0") or "0" if word.isdigit() else word for word in rest)


@cache
def load_shipped_conventions() -> tuple[NameTable, ...]:
    """Load the shipped naming conventions of the 31 joints, sorted by name."""
    return tuple(_read_naming_convention(path) for path in sorted((find_shipped_folder("scenes") / "hierarchies").glob("*.yaml")))


def load_naming_convention(name_or_path: str | Path) -> NameTable:
    """Load a shipped naming convention by name, or one from a YAML file.

    Raises:
        SceneError: If there is none of the name, with the shipped ones, or if a file is invalid, with the wrong key.
    """
    shipped = {each.name: each for each in load_shipped_conventions()}
    return find_by_name(name_or_path, shipped, "naming convention", _read_naming_convention)


def _read_naming_convention(path: Path) -> NameTable:
    model = read_yaml_model(_NamingConventionFile, path)
    parts: list[tuple[str, tuple[NameKey, ...]]] = []
    for joint, names in model.joints.items():
        letters, words = ([("", _join_letters(name)) for name in names], [_build_key(NAME_PARTS.findall(name)) for name in names])
        parts.append((joint, (*letters, *words)))
    return NameTable(model.name, model.title, tuple(parts))


REQUIRED_JOINTS = ("Hips", "Spine1") + tuple(
    side + bone for side in ("Left", "Right") for bone in ("UpLeg", "Leg", "Arm", "ForeArm")
)


@dataclass(frozen=True)
class JointMapping:
    """The 31 joints in a file's tree."""

    # index of the file's joint for each, -1 if there is none; None if the file lacks required joints
    file_joints: Int[np.ndarray, " 31"] | None
    reason: str  # sentence on what was found


def map_joints(names: Sequence[str], parents: Int[np.ndarray, " J"], convention: str | Path | None = None) -> JointMapping:
    """Map the joints of a tree to the 31-joint skeleton, by the naming convention that matches the most or by the given one.

    Hips, thorax, both legs and both arms are required.

    Args:
        parents: The index of each joint's parent, -1 for roots.
        convention: Name of a shipped naming convention, or a YAML file.

    Raises:
        SceneError: If there is no such convention.
    """
    conventions = (load_naming_convention(convention),) if convention is not None else load_shipped_conventions()
    spellings = spell_names(names)
    matches = [(each, _match_joints(each, spellings, parents)) for each in conventions]
    best, file_joints = max(
        matches, key=lambda match: (not _find_missing_joints(match[1]), (match[1] >= 0).sum(), match[0].compare_names(spellings))
    )
    count = int((file_joints >= 0).sum())
    if missing := _find_missing_joints(file_joints):
        lacks = f"the nearest convention, {best.title}, lacks {format_name_list(missing)}"
        problem = f"The joint names are not those of a body: {lacks if count else 'no joint name is known'}"
        return JointMapping(None, f"{problem}; give a YAML file of the names (--hierarchy).")
    return JointMapping(file_joints, f"{best.title}: found {count} of the {len(file_joints)} joints.")


def _match_joints(
    table: NameTable, spellings: Sequence[Sequence[NameKey]], parents: Int[np.ndarray, " J"]
) -> Int[np.ndarray, " 31"]:
    """Return the file's joint for each of the 31, without those that are not below that of the nearest joint above them."""
    model = load_cmu31_body().skeleton
    file_joints = np.full(len(model.names), -1)
    for part, bone in table.find_parts(spellings):
        file_joints[model.find_joint(part)] = bone
    return _discard_misplaced_joints(file_joints, parents)


def _discard_misplaced_joints(file_joints: Int[np.ndarray, " 31"], parents: Int[np.ndarray, " J"]) -> Int[np.ndarray, " 31"]:
    """Return the file's joints without those that are not below that of the nearest joint above them."""
    file_joints, model = file_joints.copy(), load_cmu31_body().skeleton
    for joint, file_joint in enumerate(file_joints.tolist()):
        above = find_ancestor(joint, model.parents, file_joints >= 0)
        if above >= 0 and file_joint >= 0 and not is_below(file_joint, int(file_joints[above]), parents):
            file_joints[joint] = -1
    return file_joints


def map_joints_by_shape(
    names: Sequence[str], parents: Int[np.ndarray, " J"], poses: Iterable[Float[np.ndarray, "J 3"]]
) -> JointMapping | None:
    """Map the joints of a tree whose names are not all known: by the shape of the skeleton, and by the names that agree with it.

    Args:
        parents: The index of each joint's parent, -1 for roots.
        poses: Positions in metres, Y up. The pose is used in which the most joints are found: both sides must be alike, and limbs
            that are bent differently are found in part, or not at all. If the feet never show the front, the first pose in which
            a body is found faces +Z.
    """
    found: Counter[tuple[tuple[bool, bool, int], tuple[tuple[str, tuple[int, ...]], ...]]] = Counter()
    for positions in poses:
        with suppress(ValueError):
            shape = find_segments_by_shape(parents, positions)
            score = _has_aligned_sides(shape.bones, positions), shape.faces_forward, sum(map(len, shape.bones.values()))
            found[score, tuple(sorted(shape.bones.items()))] += 1
    if not found:
        return None
    best = max(found, key=lambda each: (each[0], found[each]))
    model = load_cmu31_body().skeleton
    shaped = np.full(len(model.names), -1)
    for segment, chain in (best if best[0][1] else next(iter(found)))[1]:
        joints = [joint for joint, own in SEGMENT_OF_JOINT.items() if own == segment]
        if segment == "spine":  # the thorax carries the arms
            chain, joints = [chain[-1], *chain[:-1]], [joints[-1], *joints[:-1]]
        for joint, bone in zip(joints, chain[:1] if segment in TWISTING_SEGMENTS else chain, strict=False):
            shaped[model.find_joint(joint)] = bone
    spellings = spell_names(names)
    named = [_match_joints(each, spellings, parents) for each in load_shipped_conventions()]
    agreeing = [each for each in named if ((each == shaped) | (each < 0) | (shaped < 0)).all()]
    by_name = max(agreeing, key=lambda each: int((each >= 0).sum()), default=shaped)
    merged = np.where(by_name >= 0, by_name, np.where(np.isin(shaped, by_name), -1, shaped))
    merged = _discard_misplaced_joints(merged, parents)
    file_joints = shaped if _find_missing_joints(merged) else merged
    count = int((file_joints >= 0).sum())
    return JointMapping(file_joints, f"By the shape of the skeleton: found {count} of the {len(file_joints)} joints.")


MIN_SIDE_COSINE = 0.8  # cosine of the angle between the directions across the hips and across shoulders and elbows


def _has_aligned_sides(bones: Mapping[str, tuple[int, ...]], positions: Float[np.ndarray, "J 3"]) -> bool:
    """Return whether the left shoulder and elbow are on the same side of the right ones as the left hip."""
    left, right = (positions[[bones[f"{side}_{part}"][0] for part in ("thigh", "upper_arm", "forearm")]] for side in SIDES)
    across = (left - right)[:, [0, 2]]
    return bool((across @ across[0] > MIN_SIDE_COSINE * np.linalg.norm(across, axis=1) * np.linalg.norm(across[0])).all())


def _find_missing_joints(file_joints: Int[np.ndarray, " 31"]) -> list[str]:
    names = load_cmu31_body().skeleton.names
    return [name for name in REQUIRED_JOINTS if file_joints[names.index(name)] < 0]


SEGMENT_OF_JOINT = {joint: segment for segment, joints in TRUNK_JOINTS.items() for joint in joints} | {
    f"{side.capitalize()}{joint}": f"{side}_{segment}"
    for side in SIDES
    for segment, joints in (SEGMENT_JOINTS | {"hand": ("Hand", *SEGMENT_JOINTS["hand"])}).items()
    for joint in joints
}
"""The segments of the 31 joints that the naming conventions name; joints that are missing here have none. Hand is the wrist of a
file without FingerBase, otherwise `_complete_segments` gives it to the forearm."""


def find_segments_by_name(names: Sequence[str], parents: Int[np.ndarray, " J"]) -> BoneMapping | None:
    """Find the bones of the segments by their names; None if no table gives all that a body needs.

    Bones between two bones of a limb are parts of the upper segment. The table that gives the most bones is chosen, among equals
    the one with the most similar set of names.
    """
    best = _find_best_table(names, lambda found: _complete_segments(found, parents))
    return best and BoneMapping({segment: tuple(chain) for segment, chain in best[1].items()}, reason=f"{best[0].title} names")


Chains: TypeAlias = dict[str, list[int]]  # segment to its bones


def _find_best_table(names: Sequence[str], complete: Callable[[Chains], Chains]) -> tuple[NameTable, Chains] | None:
    """Return the table by which most bones have a segment, and these, corrected and completed; None if none gives a body."""
    spellings = spell_names(names)
    best: tuple[tuple[int, float], NameTable, Chains] | None = None
    for table in _load_segment_tables():
        found: Chains = {}
        for segment, bone in table.find_parts(spellings):
            found.setdefault(segment, []).append(bone)
        chains = complete({segment: sorted(chain) for segment, chain in found.items()})  # parents have lower indices
        score = sum(map(len, chains.values())), table.compare_names(spellings)
        if all(chains.get(segment) for segment in REQUIRED_SEGMENTS) and (best is None or score > best[0]):
            best = score, table, chains
    return best and best[1:]


@cache
def _load_segment_tables() -> tuple[NameTable, ...]:
    """Return the tables of the presets, then those of the naming conventions, whose joints are in segments."""
    tables: list[NameTable] = []
    for name in CHARACTER_PRESETS:
        preset = read_shipped_yaml(f"rigs/{name}.yaml")
        names = [bone["name"] for bone in preset["bones"]]
        spellings = spell_names(names)
        parts = tuple((segment, spellings[names.index(bone)]) for segment, chain in preset["segments"].items() for bone in chain)
        tables.append(NameTable(name, preset["title"], parts, frozenset(key for each in spellings for key in each)))
    for table in load_shipped_conventions():
        parts = tuple((SEGMENT_OF_JOINT[joint], keys) for joint, keys in table.parts if joint in SEGMENT_OF_JOINT)
        tables.append(NameTable(table.name, table.title, parts))
    return tuple(tables)


def _complete_segments(chains: Chains, parents: Int[np.ndarray, " J"]) -> Chains:
    """Return the bones of the segments, with the hand apart from the forearm, without misplaced ones, and with those between."""
    for side in SIDES:
        *inner, wrist = chains.get(f"{side}_hand", [-1])
        if inner and f"{side}_forearm" in chains:
            chains[f"{side}_forearm"] += inner
            chains[f"{side}_hand"] = [wrist]
    _correct_pelvis(chains, parents)
    _discard_misplaced_bones(chains, parents)
    _fill_chains(chains, parents)
    return {segment: chain for segment, chain in chains.items() if chain}


def _correct_pelvis(chains: Chains, parents: Int[np.ndarray, " J"]) -> None:
    """Move the pelvis up to the bone that carries both legs and both arms, where the named one does not."""
    limbs = [chains[segment][0] for side in SIDES for segment in (f"{side}_thigh", f"{side}_upper_arm") if chains.get(segment)]
    pelvis = chains.get("pelvis", [])[:1]
    if pelvis and limbs and not all(is_below(bone, pelvis[0], parents) for bone in limbs):
        common = find_common_joint(parents, [*limbs, *pelvis])
        pelvis = [common] if common >= 0 else []
    if "pelvis" in chains:
        chains["pelvis"] = pelvis


def _discard_misplaced_bones(chains: Chains, parents: Int[np.ndarray, " J"]) -> None:
    """Discard bones that are not below the bone before them."""
    for order in SEGMENT_CHAINS:
        above = -1
        for segment in order:
            kept: list[int] = []
            for bone in chains.get(segment, ()):
                if above < 0 or is_below(bone, above, parents):
                    kept.append(bone)
                    above = bone
            if segment in chains:
                chains[segment] = kept


def _fill_chains(chains: Chains, parents: Int[np.ndarray, " J"]) -> None:
    """Add the bones between the named ones of the spine, the neck and the limbs."""
    if spine := chains.get("spine"):
        chains["spine"] = list_path(spine[-1], int(parents[spine[0]]), parents)
    if head := chains.get("head"):
        neck, below = chains.get("neck"), (chains.get("spine") or chains.get("pelvis") or [-1])[-1]
        between = list_path(int(parents[head[0]]), int(parents[neck[0]]) if neck else below, parents)
        arms = [
            chains[segment][0] for side in SIDES for segment in (f"{side}_clavicle", f"{side}_upper_arm") if chains.get(segment)
        ]
        chains["neck"] = [bone for bone in between if not any(is_below(arm, bone, parents) for arm in arms)]
    for upper in TWISTING_SEGMENTS:
        lower = get_next_segment(upper)
        if chains.get(upper) and chains.get(lower):
            chains[upper] = list_path(int(parents[chains[lower][0]]), int(parents[chains[upper][0]]), parents)


MAX_DETACHED_SHARE = 0.3  # distance of a bone of a body from the bone before it, as a share of the size of the whole
SEGMENTS_OF_HIPS = ("left_thigh", "right_thigh")


def find_detached_bones(
    names: Sequence[str], parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"], is_skinned: Bool[np.ndarray, " J"]
) -> dict[int, int]:
    """Find bones that the names give a segment, but that are not below the bone before it; return the bone that carries each.

    In rigs with controls, constraints move bones that have other parents: feet that are targets of inverse kinematics are below
    the root, and the limbs of a rig that Rigify generated are below bones that follow controls.

    Args:
        parents: Index of each bone's parent, -1 for roots.
        positions: In the rest pose, in metres in the world.
        is_skinned: Whether a mesh follows the bone; only such bones are found.
    """
    if (best := _find_best_table(names, lambda found: found)) is None:
        return {}
    segments, limit = best[1], MAX_DETACHED_SHARE * float(np.ptp(positions, axis=0).max())
    hips = np.mean([positions[segments[segment][0]] for segment in SEGMENTS_OF_HIPS], axis=0)
    common = find_common_joint(parents, [segments["pelvis"][0], *(segments[segment][0] for segment in SEGMENTS_OF_HIPS)])
    if common >= 0 and np.linalg.norm(positions[common] - hips) < limit:
        segments["pelvis"] = [common]
    found: dict[int, int] = {}
    changed = parents.copy()
    for order in SEGMENT_CHAINS:
        above = -1
        for bone in (bone for segment in order for bone in segments.get(segment, ())):
            if above >= 0 and not is_below(bone, above, changed):
                is_near = np.linalg.norm(positions[bone] - positions[above]) < limit
                if not is_near or not is_skinned[bone] or is_below(above, bone, changed):
                    continue
                found[bone] = changed[bone] = above
            above = bone
    return found


MIN_HAND_HEIGHT_SHARE = 0.2
"""height of the wrists above the ankles, as a share of the legs' length; an animal on four legs has less"""


def map_bones(character: Character) -> BoneMapping:
    """Find the bones that form the segments of a body.

    The names of the shipped characters and naming conventions are tried first, without regard to case, separators, namespaces and
    prefixes. If they do not give a body, the tree and the positions of the bones in the rest pose are used alone; the character
    may face any direction, but must stand upright. Fingers and other bones have no segment and keep their rest pose. The
    character's own mapping is not used.

    Raises:
        SceneError: If the bones do not form a body with two arms and two legs. The message names the file.
    """
    positions, _ = character.skeleton.compute_rest_pose()
    named = find_segments_by_name(character.skeleton.names, character.skeleton.parents)
    if named is not None:
        if _stands_on_hands(positions, named.bones):
            raise SceneError(
                f"{character.origin}: its hands are at the height of its feet in the rest pose: it stands on four legs, and only "
                "a character on two legs can take a person's motion."
            )
        return _build_mapping(character, positions, dict(named.bones), named.reason)
    try:
        shape = find_segments_by_shape(character.skeleton.parents, positions)
    except ValueError as error:
        raise SceneError(
            f"{character.origin}: the names of its bones are unknown, and their shape is no body with two arms and two legs in "
            f"an upright rest pose ({error}); give the bones of each segment in a file (--character-map)."
        ) from error
    how = "By the shape of the skeleton" if shape.faces_forward else "By the shape of the skeleton, taken to face +Z"
    return _build_mapping(character, positions, shape.bones, how)


def _stands_on_hands(positions: Float[np.ndarray, "J 3"], bones: Mapping[str, tuple[int, ...]]) -> bool:
    """Return whether both arms reach down to the feet."""
    feet = min(positions[bones[f"{side}_foot"][0], 1] for side in SIDES)
    hips = min(positions[bones[f"{side}_thigh"][0], 1] for side in SIDES)
    ends = [bones.get(f"{side}_hand", bones[f"{side}_forearm"])[-1] for side in SIDES]
    return all(positions[end, 1] < feet + MIN_HAND_HEIGHT_SHARE * (hips - feet) for end in ends)


def _build_mapping(
    character: Character, positions: Float[np.ndarray, "J 3"], bones: dict[str, tuple[int, ...]], how: str
) -> BoneMapping:
    twists = find_side_twists(character.skeleton.names, character.skeleton.parents, positions, bones)
    count = sum(map(len, (*bones.values(), *twists.values())))
    return BoneMapping(bones, twists, f"{how}: {count} of {len(character.skeleton.names)} bones.")


MAX_TWIST_SHARE = 0.98
"""position along the segment up to which a bone without a telling name is a twist bone; others are helpers of the joints"""
NAMED_TWIST_MARGIN = 0.1  # share of the segment by which a bone named as a twist bone may lie outside it
TWIST_WORDS = ("twist", "roll")
CORRECTIVE_WORDS = ("cor", "corrective", "drv")  # ends of the names of bones that correct the skin at a twist bone


def find_side_twists(
    names: Sequence[str],
    parents: Int[np.ndarray, " J"],
    positions: Float[np.ndarray, "J 3"],
    bones: Mapping[str, tuple[int, ...]],
) -> dict[str, tuple[int, ...]]:
    """Return by segment the twist bones beside the chains of the limbs, from near to far.

    They are children that lie on the segment's axis in the rest pose; those named as twist bones may lie a little outside it.
    """
    used = {bone for chain in bones.values() for bone in chain}
    found: dict[str, tuple[int, ...]] = {}
    for segment in TWISTING_SEGMENTS:
        chain, following = bones.get(segment, ()), bones.get(get_next_segment(segment), ())
        if not chain or not following:
            continue
        ends = positions[chain[0]], positions[following[0]]
        length = np.linalg.norm(ends[1] - ends[0])
        children = [bone for bone in np.flatnonzero(np.isin(parents, chain)).tolist() if bone not in used and length > 0]
        shares, across = split_along_line(positions[children], *ends)
        is_near = np.linalg.norm(across, axis=1) <= MAX_AXIS_DISTANCE_SHARE * length
        beside = sorted(zip(shares.tolist(), children, is_near.tolist(), strict=True))
        if twists := tuple(bone for share, bone, near in beside if near and _is_twist(names[bone], share)):
            found[segment] = twists
    return found


def _is_twist(name: str, share: float) -> bool:
    name = name.lower()
    if any(word in name for word in TWIST_WORDS):
        stem = name.removesuffix(")").rstrip("_.0123456789lr")
        is_corrective = any(stem.endswith(word) for word in CORRECTIVE_WORDS) or "twistcor" in name
        return not is_corrective and -NAMED_TWIST_MARGIN < share < 1 + NAMED_TWIST_MARGIN
    return MIN_TWIST_SHARE < share < MAX_TWIST_SHARE
