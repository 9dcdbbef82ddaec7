"""Write all results as NumPy arrays (.npz) for other programs: `np.load("walk.npz")`, without pickle.

docs/formats.md lists the arrays of a take, docs/characters.md those of a character.
"""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy
from jaxtyping import Bool

from mocapfix.contacts.contacts import BodyContacts
from mocapfix.hands.solve_hands import HandMotion
from mocapfix.io.files import replace_atomically
from mocapfix.kernels import lie
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.take import Take
from mocapfix.solve import kinematics

if TYPE_CHECKING:
    from mocapfix.characters.character import Character, CharacterMotion

NPZ_FORMAT = "mocapfix 1"
NPZ_UNITS = "metres, seconds, radians; Y up, right-handed; quaternions x, y, z, w"


def write_npz(
    target: Path,
    take: Take,
    skeleton: Skeleton | None = None,
    motion: Motion | None = None,
    rate: float | None = None,
    solved_joints: Bool[np.ndarray, " J"] | None = None,
    contacts: BodyContacts | None = None,
    *,
    hands: Sequence[HandMotion] = (),
) -> None:
    """Write the markers of a take and, if there is a body, its motion.

    Args:
        rate: Frames per second of the motion; by default those of the take.
        solved_joints: The joints that the markers show; by default all.
        hands: The hands whose fingers markers show, at the rate of the markers.
    """
    arrays = {
        "format": np.array(NPZ_FORMAT),
        "units": np.array(NPZ_UNITS),
        "rate": np.array(float(rate or take.rate)),
        "first_frame": np.array(take.first_frame),
        "labels": np.array(take.labels),
        "markers": take.markers,
        "marker_sd": take.estimated_sd,
        "marker_rate": np.array(float(take.rate)),
    }
    if take.label_confidence is not None:
        arrays["label_confidence"] = take.label_confidence
    if skeleton is not None and motion is not None:
        arrays |= _build_body_arrays(skeleton, motion, solved_joints)
    if contacts is not None:
        arrays |= _build_contact_arrays(contacts)
    for hand in hands:
        arrays |= _build_hand_arrays(hand)
    with replace_atomically(Path(target)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _build_hand_arrays(hand: HandMotion) -> dict[str, np.ndarray]:
    """Return the arrays of a hand; their names begin with its side."""
    side, is_known = hand.hand.model.side.lower(), np.ones(len(hand.palm_position), bool)
    joints = range(hand.joint_rotations.shape[1])
    rotations = [lie.extract_joint_quaternions(hand.joint_rotations, joint, is_known) for joint in joints]
    palm = lie.extract_joint_quaternions(np.ascontiguousarray(hand.palm_rotation[:, None]), 0, is_known)
    arrays = {
        "names": np.array([*hand.hand.model.joint_names, *hand.hand.model.tip_names]),
        "length": np.array(hand.hand.length_m),
        "wrist": hand.palm_position,
        "palm": palm,
        "rotations": np.stack(rotations, axis=1),
        "points": hand.point_positions,
        "point_sd": hand.point_sd,
        "rotation_sd": hand.rotation_sd,
        "fingers_seen": hand.is_seen,
    }
    return {f"{side}_hand_{name}": values for name, values in arrays.items()}


def _build_contact_arrays(contacts: BodyContacts) -> dict[str, np.ndarray]:
    return {
        "contact_joints": np.array(contacts.joints),
        "contacts": contacts.is_contact,
        "contact_probabilities": contacts.probability,
        "contacts_known": contacts.is_known,
        "floor_heights": np.array(contacts.floor.level_heights_m, float),
        "floor_slope": np.array([contacts.floor.slope_x, contacts.floor.slope_z]),
        "event_times": np.array([event.time_s for event in contacts.events], float),
        "event_sides": np.array([event.side for event in contacts.events], str),
        "event_kinds": np.array([event.kind for event in contacts.events], str),
        "event_sources": np.array([event.source for event in contacts.events], str),
    }


def _build_body_arrays(skeleton: Skeleton, motion: Motion, solved_joints: Bool[np.ndarray, " J"] | None) -> dict[str, np.ndarray]:
    is_known = np.ones(motion.frame_count, bool)
    is_solved = np.ones(len(skeleton.names), bool) if solved_joints is None else solved_joints
    joints = range(len(skeleton.names))
    rotations = [lie.extract_joint_quaternions(motion.local_rotations, joint, is_known) for joint in joints]
    return {
        "names": np.array(skeleton.names),
        "parents": skeleton.parents,
        "offsets": skeleton.offsets,
        "ends": skeleton.ends,
        "root": motion.root_position,
        "rotations": np.stack(rotations, axis=1),
        "joints": np.where(is_solved[:, None], kinematics.compute_world_poses(skeleton, motion)[0], np.nan),
        "joint_sd": motion.joint_sd,
        "solved_joints": is_solved,
        "status": motion.status,
        "status_texts": np.array([status.description for status in FrameStatus]),
    }


CHARACTER_NPZ_FORMAT = "mocapfix character 1"
CHARACTER_NPZ_UNITS = "metres, seconds; Y up, right-handed; quaternions x, y, z, w; rotations to the parent's axes"


def write_character_npz(target: Path, character: "Character", motion: "CharacterMotion", moving_bones: Collection[int]) -> None:
    """Write the motion of a character, some of whose bones move. Raises WriteError if `target` is not writable."""
    bones, is_known = range(len(character.skeleton.names)), np.ones(motion.frame_count, bool)
    rotations = [lie.extract_joint_quaternions(motion.local_rotations, bone, is_known) for bone in bones]
    segments = [segment for segment, chain in character.mapping.bones.items() if chain]
    arrays = {
        "format": np.array(CHARACTER_NPZ_FORMAT),
        "units": np.array(CHARACTER_NPZ_UNITS),
        "character": np.array(character.name),
        "rate": np.array(float(motion.rate)),
        "names": np.array(character.skeleton.names),
        "parents": character.skeleton.parents,
        "scales": character.scales,
        "root_scale": np.array(float(character.root_scale)),
        "rest_positions": character.skeleton.offsets,
        "rest_rotations": scipy.spatial.transform.Rotation.from_matrix(character.skeleton.rest_rotations).as_quat(),
        "tails": character.skeleton.ends,
        "pelvis": np.array(character.skeleton.names[character.mapping.bones["pelvis"][0]]),
        "pelvis_position": motion.pelvis_position,
        "rotations": np.stack(rotations, axis=1),
        "is_moved": np.isin(np.arange(len(character.skeleton.names)), list(moving_bones)),
        "segments": np.array(segments),
        "segment_bones": np.array(
            ["\n".join(character.skeleton.names[bone] for bone in character.mapping.bones[segment]) for segment in segments]
        ),
    }
    if motion.positions:
        arrays["positioned_bones"] = np.array([character.skeleton.names[bone] for bone in motion.positions])
        arrays["positions"] = np.stack(list(motion.positions.values()), axis=1)
    with replace_atomically(Path(target)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
