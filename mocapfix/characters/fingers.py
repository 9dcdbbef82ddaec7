"""The fingers of characters: which bones they are, and their poses relative to the palm.

Bones below the hand are found by their names, and without known names by the shape of the hand. Three or two
bones of each turn, from its first joint beside the palm; a metacarpal keeps its rest pose.

Rest poses differ, so hands are compared with that of priors/hand.yaml, whose fingers are straight. A bone's C is its axes in the
palm's, turned by the shortest way from where the bone points in the rest pose to where the straight finger does; R = S C for its
rotation R, as in `body_frames`. S relative to the palm is kept, so that a bone points where the source's does.
"""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import FINGER_BONE_COUNTS, FINGERS, SIDES, Character
from mocapfix.hands.hand_model import JOINTS_PER_RAY, RAY_ROOTS, load_hand
from mocapfix.model.skeleton import is_below, list_path
from mocapfix.stats.rigid_alignment import compute_shortest_rotations

FINGER_NAMES = {
    "thumb": "thumb", "index": "index", "pointer": "index", "forefinger": "index", "mid": "middle", "middle": "middle",
    "ring": "ring", "pink": "pinky", "pinky": "pinky", "pinkie": "pinky", "little": "pinky", "small": "pinky",
}  # fmt: skip
"""words in the names of bones, and their fingers"""
FINGER_WORD = re.compile(
    rf"(?<![a-z])(?:left|right|[lr])?(?:hand|finger)?({'|'.join(FINGER_NAMES)})"
    r"(?:finger|meta|carpal|proximal|intermediate|medial|distal|base|tip|end|nub|left|right|[lr])*(?![a-z])"
)
"""the same as whole words of a name in small letters, with what is written to them without a space"""
METACARPAL_NAME = re.compile(r"meta|carpal|inhand|palm", re.IGNORECASE)
HELPER_NAME = re.compile(
    r"half|twist|roll|bulge|helper|corrective|_mcp|_pip|_dip|_palm|spine|chest|torso|back|neck|toe", re.IGNORECASE
)
END_NAME = re.compile(r"(end|tip|nub|leaf|site)([_.\s-]*[lr])?\d*$", re.IGNORECASE)
NUMBER = re.compile(r"\d+")
WORD_START = re.compile(r"(?<=[a-z])(?=[A-Z])")
MAX_METACARPAL_SHARE = 0.4
"""distance of a metacarpal from the wrist, as a share of that of the next bone; of the shipped characters' at most 0.33, and of
their first bones of fingers at least 0.67"""
MIN_FINGERS = 3  # chains that are a hand: by shape, of which one is the thumb, or by name beside the hand that was found
MAX_LENGTH_RATIO = 3.0  # of the longest such chain to the shortest
TIP_SHARE = 0.8  # length of a last bone without an end, as a share of the bone before it


class HandPoses(NamedTuple):
    """The poses of a hand over T frames."""

    palm: Float[np.ndarray, "T 3 3"]  # from the palm's axes to the world's: those of the hand's segment
    fingers: Mapping[str, Float[np.ndarray, "T n 3 3"]]  # by finger, one of FINGERS: S of its bones relative to the palm
    position: Float[np.ndarray, "T 3"]  # of the palm in the world, metres
    # by finger: each bone from the one before, the first from the palm's position, in the axes of S, metres
    offsets: Mapping[str, Float[np.ndarray, "n 3"]]


def find_fingers(
    names: Sequence[str],
    parents: Int[np.ndarray, " J"],
    positions: Float[np.ndarray, "J 3"],
    bones: Mapping[str, tuple[int, ...]],
) -> dict[str, tuple[int, ...]]:
    """Return the bones that turn of each finger, such as "left_index", from the palm to the tip.

    Args:
        positions: Of the J bones in the rest pose, in metres.
        bones: The bones of the segments.
    """
    found: dict[str, tuple[int, ...]] = {}
    for side in SIDES:
        if not (hand := bones.get(f"{side}_hand")):
            continue
        below = [bone for bone in range(len(names)) if bone != hand[-1] and is_below(bone, hand[-1], parents)]
        chains = _find_named_chains(names, parents, below) or _find_chains_by_shape(parents, positions, hand[-1], below)
        for finger, chain in chains.items():
            turning = _select_turning_bones([names[bone] for bone in chain], positions[[hand[-1], *chain]], finger)
            if len(turning) in FINGER_BONE_COUNTS:
                found[f"{side}_{finger}"] = tuple(chain[k] for k in turning)
    return found


def find_palms(
    names: Sequence[str], parents: Int[np.ndarray, " J"], bones: Mapping[str, tuple[int, ...]]
) -> dict[str, tuple[int, ...]]:
    """Return the bones of the segments, where a hand is the bone beyond the forearm that carries the named fingers.

    A body with hands, as it is written here, has its wrist and its palm beside each other.
    """
    found = dict(bones)
    for side in SIDES:
        forearm, hand = bones[f"{side}_forearm"][-1], bones.get(f"{side}_hand", (-1,))[-1]
        beside = [k for k in range(len(names)) if is_below(k, forearm, parents) and hand not in list_path(k, forearm, parents)]
        chains = _find_named_chains(names, parents, beside).values()
        palms = [int(parents[chain[0]]) for chain in chains if len(chain) >= FINGER_BONE_COUNTS[0]]
        if len(palms) >= MIN_FINGERS and len({*palms}) == 1 and palms[0] in beside:
            found[f"{side}_hand"] = (palms[0],)
    return found


def _find_named_chains(names: Sequence[str], parents: Int[np.ndarray, " J"], below: list[int]) -> dict[str, list[int]]:
    """Return the bones below a hand whose names are those of each finger, one below the other."""
    finger_of: dict[int, str] = {}
    for bone in below:
        words = FINGER_WORD.findall(WORD_START.sub("_", names[bone]).lower())
        finger = next((each for word, each in FINGER_NAMES.items() if word in words), None)
        if finger is not None and not HELPER_NAME.search(names[bone]):
            finger_of[bone] = finger
    chains: dict[str, list[int]] = {}
    for finger in FINGERS:
        own = [bone for bone, each in finger_of.items() if each == finger]
        paths = [[each for each in list_path(bone, -1, parents) if each in own] for bone in own]
        if paths:  # of branches, the one whose names differ in their numbers only
            chains[finger] = max(paths, key=lambda path: (len(path), -len({NUMBER.sub("", names[bone]) for bone in path})))
    return chains


def has_named_fingers(names: Sequence[str], parents: Int[np.ndarray, " J"]) -> bool:
    """Return whether a tree has joints that are named as those of a finger, one below the other."""
    chains = _find_named_chains(names, parents, list(range(len(names))))
    return any(len(chain) >= FINGER_BONE_COUNTS[0] for chain in chains.values())


def _select_turning_bones(names: Sequence[str], positions: Float[np.ndarray, "n+1 3"], finger: str) -> list[int]:
    """Return which bones of a chain turn: no ends, no surplus metacarpals. Positions are those of hand and bones, in metres."""
    turning = list(range(len(names)))
    while turning and END_NAME.search(names[turning[-1]]):
        turning.pop()
    distances = np.linalg.norm(positions[1:] - positions[0], axis=1)
    is_near = len(turning) > JOINTS_PER_RAY and distances[0] < MAX_METACARPAL_SHARE * distances[1]
    is_named = METACARPAL_NAME.search(names[0]) is not None and len(turning) > FINGER_BONE_COUNTS[0]
    has_metacarpal = (len(turning) > JOINTS_PER_RAY and is_named) if finger == "thumb" else is_near or is_named
    return turning[int(has_metacarpal) :][:JOINTS_PER_RAY]


def _find_chains_by_shape(
    parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"], hand: int, below: list[int]
) -> dict[str, list[int]]:
    """Return the fingers of a hand by its shape: three to five chains of similar lengths.

    The thumb is the chain nearest to the wrist; the index finger is the one nearest to its tip, and so on.
    """
    paths = [list_path(bone, hand, parents) for bone in below if not (parents == bone).any()]
    uses = np.bincount([bone for path in paths for bone in path], minlength=len(parents))
    chains = [[bone for bone in path if uses[bone] == 1] for path in paths]
    chains = [chain for chain in chains if len(chain) >= FINGER_BONE_COUNTS[0]]
    lengths = [float(np.linalg.norm(np.diff(positions[chain], axis=0), axis=1).sum()) for chain in chains]
    if not (MIN_FINGERS <= len(chains) <= len(FINGERS) and max(lengths) < MAX_LENGTH_RATIO * min(lengths)):
        return {}
    middles = np.array([positions[chain].mean(0) for chain in chains])
    thumb = chains[int(np.linalg.norm(middles - positions[hand], axis=1).argmin())]
    order = np.argsort(np.linalg.norm(middles - positions[thumb[-1]], axis=1)).tolist()
    others = FINGERS[1:] if len(chains) == len(FINGERS) else (*FINGERS[1 : len(chains) - 1], FINGERS[-1])
    return dict(zip(FINGERS[:1] + others, [thumb, *(chains[k] for k in order if chains[k] is not thumb)], strict=True))


def compute_straight_finger(side: str, finger: str) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Return the direction of the straight finger of priors/hand.yaml in the palm's axes, and the lengths of its three bones."""
    model, root = load_hand("Left" if side == "left" else "Right"), int(RAY_ROOTS[FINGERS.index(finger)])
    straight = model.skeleton.rest_positions[root + 2] - model.skeleton.rest_positions[root + 1]
    bones = *model.skeleton.offsets[[root + 2, root + 3]], model.skeleton.ends[root + 3]
    return straight / np.linalg.norm(straight), np.linalg.norm(bones, axis=1)


def compute_palm_roll(character: Character, positions: Float[np.ndarray, "J 3"], side: str) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about a hand's x axis that turns the row of its knuckles to that of the hand of priors/hand.yaml.

    `positions` are those of the bones in the axes of the hand in the rest pose. It is the identity for less than two fingers.
    """
    fingers, places = character.mapping.fingers, load_hand("Left" if side == "left" else "Right").skeleton.rest_positions
    mapped = [k for k, finger in enumerate(FINGERS) if k and f"{side}_{finger}" in fingers]
    rows = positions[[fingers[f"{side}_{FINGERS[k]}"][0] for k in mapped]], places[RAY_ROOTS[mapped] + 1]
    (_, y, z), (_, usual_y, usual_z) = ((each - each.sum(0) / max(len(each), 1)).T for each in rows)
    return Rotation.from_euler("x", np.arctan2(y @ usual_z - z @ usual_y, y @ usual_y + z @ usual_z)).as_matrix()


def measure_finger(
    character: Character, positions: Float[np.ndarray, "J 3"], ends: Float[np.ndarray, "J 3"], finger: str
) -> Float[np.ndarray, "n 3"]:
    """Return the vectors from each bone of a finger, such as left_index, to the next one, or to its tail, in metres.

    Positions and tails are those of all bones. A tail that is not known continues the bone before.
    """
    bones = list(character.mapping.fingers[finger])
    children = np.flatnonzero(character.skeleton.parents == bones[-1])
    vectors = np.diff(positions[bones], axis=0)
    tip = (positions[children[0]] if len(children) == 1 else ends[bones[-1]]) - positions[bones[-1]]
    is_tip = np.isfinite(tip).all() and tip @ vectors[-1] > 0.0 and np.linalg.norm(tip) < 2 * np.linalg.norm(vectors[-1])
    return np.concatenate([vectors, (tip if is_tip else TIP_SHARE * vectors[-1])[None]])


def fit_finger(hand: HandPoses, side: str, finger: str, count: int) -> Float[np.ndarray, "T n 3 3"] | None:
    """Return S of the bones of a finger of two or three bones relative to the palm, None if the hand does not show them.

    A finger that the hand lacks bends like the nearest one. A finger of two bones has the first of three, a thumb the last; the
    other one points from where the two others begin to where they end, with the lengths of priors/hand.yaml.
    """
    nearest = sorted(FINGERS[1:], key=lambda each: abs(FINGERS.index(each) - FINGERS.index(finger)))
    source = next((each for each in ((finger,) if finger == "thumb" else nearest) if each in hand.fingers), None)
    if source is None:
        return None
    own = hand.fingers[source]
    if own.shape[1] == count:
        return own
    joined = 0 if finger == "thumb" else 1  # the first of the two bones that are one, or the bone that is two
    if own.shape[1] < count:
        return own[:, [0, joined, 1]]
    straight, lengths = compute_straight_finger(side, source)
    pair = own[:, joined : joined + 2]
    line = np.einsum("k,tkab,b->ta", lengths[joined : joined + 2], pair, straight)
    turned = compute_shortest_rotations(pair[:, 0] @ straight, line) @ pair[:, 0]
    return np.stack([own[:, 0], turned] if joined else [turned, own[:, 2]], axis=1)
