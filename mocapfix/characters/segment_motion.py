"""The rotations of body segments in a motion, and the shared rotations of spines and necks with other numbers of bones."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import BodyFrame
from mocapfix.characters.character import SIDE_SEGMENTS, SIDES, CharacterMotion, compute_character_poses
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

PARENT_SEGMENTS = {
    "clavicle": "chest", "upper_arm": "clavicle", "forearm": "upper_arm", "hand": "forearm",
    "thigh": "pelvis", "shin": "thigh", "foot": "shin", "toe": "foot",
}  # fmt: skip
"""The segment with which one that a body lacks moves; both of the same side, except pelvis and chest."""
MIN_LENGTH_M = 1e-9


@dataclass(frozen=True)
class SegmentMotion:
    """The segments of a body in every frame.

    position   segment to (T, 3) m: where it begins
    rotation   segment to S (T, 3, 3), from the segment's axes to the world's. "chest" is the outermost bone of the spine
    spine      (T, n + 1, 3, 3): of the pelvis and the spine's n bones
    neck       (T, n + 2, 3, 3): of the chest, the neck's n bones and the head
    """

    position: Mapping[str, Float[np.ndarray, "T 3"]]
    rotation: Mapping[str, Float[np.ndarray, "T 3 3"]]
    spine: Float[np.ndarray, "T n 3 3"]
    neck: Float[np.ndarray, "T n 3 3"]


def compute_segment_motion(frame: BodyFrame, motion: CharacterMotion) -> SegmentMotion:
    """Compute the segments of a character's body in every frame of its motion."""
    position, rotation = compute_character_poses(frame.character, motion)
    bones = frame.character.mapping.bones
    rotations = {segment: rotation[:, bone] @ frame.standard_rotations[bone].T for segment, bone in frame.segment_bones.items()}
    chains = {
        segment: [rotation[:, bone] @ frame.standard_rotations[bone].T for bone in bones.get(segment, ())]
        for segment in ("spine", "neck")
    }
    spine = np.stack([rotations["pelvis"], *chains["spine"]], axis=1)
    rotations["chest"] = spine[:, -1]
    head = rotations.setdefault("head", chains["neck"][-1] if chains["neck"] else rotations["chest"])
    for side in SIDES:
        for segment in SIDE_SEGMENTS:
            parent = PARENT_SEGMENTS[segment]
            parent = parent if parent in ("chest", "pelvis") else f"{side}_{parent}"
            rotations.setdefault(f"{side}_{segment}", rotations[parent])
    positions = {segment: position[:, chain[0]] for segment, chain in bones.items() if chain}
    return SegmentMotion(positions, rotations, spine, np.stack([rotations["chest"], *chains["neck"], head], axis=1))


def resample_chain(rotations: Float[np.ndarray, "T n 3 3"], count: int) -> Float[np.ndarray, "T m 3 3"]:
    """Return the rotations of a chain of `count` bones that bends like another, its first and last as they are.

    The rotations of a chain are those at equal distances along it; between two, the rotation turns about one axis.
    """
    last = rotations.shape[1] - 1
    if count == last + 1:
        return rotations
    if count == 1 or last == 0:
        return np.repeat(rotations[:, -1:], count, axis=1)
    resampled = np.empty((len(rotations), count, 3, 3))
    for k in range(count):
        place = k * last / (count - 1)
        low = min(int(place), last - 1)
        resampled[:, k] = turn_by_share(rotations[:, low], rotations[:, low + 1], place - low)
    return resampled


def keep_chain_direction(
    source_offsets: Float[np.ndarray, "n 3"],
    source_rotations: Float[np.ndarray, "T n 3 3"],
    offsets: Float[np.ndarray, "m 3"],
    rotations: Float[np.ndarray, "T m 3 3"],
) -> Float[np.ndarray, "T m 3 3"]:
    """Return the rotations of a chain, turned together so that the chain points in the direction of another one.

    offsets    from the beginning of each bone to that of the next, in its segment's axes, in metres
    rotations  of these bones
    """
    if not len(offsets) or not len(source_offsets):
        return rotations
    wanted = np.einsum("tnij,nj->ti", source_rotations, source_offsets)
    rest = compute_shortest_rotation(source_offsets.sum(0), offsets.sum(0))
    reached = np.einsum("tnij,nj->ti", rotations, offsets @ rest)
    return compute_shortest_rotations(reached, wanted)[:, None] @ rotations


def compute_shortest_rotations(before: Float[np.ndarray, "T 3"], after: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Return the smallest rotations from the directions of `before` to those of `after`; opposite directions are left."""
    a, b = (each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), MIN_LENGTH_M) for each in (before, after))
    quaternion = np.column_stack([np.cross(a, b), 1.0 + np.einsum("ti,ti->t", a, b)])
    quaternion[quaternion[:, 3] < MIN_LENGTH_M] = [0.0, 0.0, 0.0, 1.0]
    return Rotation.from_quat(quaternion).as_matrix()


def turn_by_share(start: Float[np.ndarray, "T 3 3"], end: Float[np.ndarray, "T 3 3"], share: float) -> Float[np.ndarray, "T 3 3"]:
    """Return the rotations at a share of the way from one to another."""
    if share <= 0.0 or share >= 1.0:
        return start if share <= 0.0 else end
    vector = Rotation.from_matrix(np.swapaxes(start, 1, 2) @ end).as_rotvec()
    return start @ Rotation.from_rotvec(share * vector).as_matrix()
