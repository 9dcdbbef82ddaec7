"""Write all results as NumPy arrays (.npz) for other programs: `np.load("walk.npz")`, without pickle.

Metres, seconds, radians, Y up, right-handed. With T frames of the body, J joints, F frames of the take and M markers:

    format          "mocapfix 1"
    units           a sentence that states the units
    rate, first_frame   frames per second of the body; the file's number of its first frame
    names (J,)      joints, parents before children;  parents (J,), -1 for the root
    offsets (J, 3)  position of each joint in its parent's axes
    ends (J, 3)     end of a last bone in its joint's axes, NaN for other joints
    root (T, 3)     position of the root in the world
    rotations (T, J, 4)  axes of each joint in its parent's (of the root in the world) as quaternions x, y, z, w, without flips
    joints (T, J, 3)     positions of the joints in the world;  joint_sd (T, J) their predicted standard deviation per axis
    solved_joints (J,)   whether the markers show the joint; of the others, joints and joint_sd are NaN and the rotations at rest
    status (T,)     an index into status_texts (S,), which describe the confidence in the pose of each frame
    labels (M,)     marker names as in the file
    markers (F, M, 3)    cleaned markers, NaN where missing
    marker_sd (F, M)     predicted standard deviation per axis of the samples that mocapfix estimated, NaN elsewhere
    marker_rate     frames per second of the markers, always that of the take
    contact_joints (C,)  joints that can be in contact;  contacts (F, C) whether each is, in the frames of the take, as markers
    contacts_known (F, C)  False where the joint is not seen and its contact is inferred
    floor_heights (L,)  heights of the floor's levels at the origin;  floor_slope (2,) its rise in metres per metre along x and z
    event_times (E,)  seconds after the first frame;  event_sides, event_kinds (E,) "left" or "right", "foot strike" or "foot off"
    event_sources (E,)  "markers", "joints" or "force plate"
    label_confidence (F, M)  of a take that mocapfix labelled: the probability that the label of a sample is right, NaN for
                    samples that were not in the file

A take whose file has labels has no label_confidence. A take without a body has no contacts, floor, events, names, parents,
offsets, ends, root, rotations, joints, joint_sd, solved_joints, status and status_texts.

The motion of a character, `np.load("walk.character.npz")`, with T frames and J bones, parents before children:

    format              "mocapfix character 1"
    units               a sentence that states the units
    character           the character's name
    rate                frames per second
    names (J,)          bones;  parents (J,), -1 for roots
    scales (J,)         metres in a unit of the character's file along each bone's own axes;  root_scale that of roots
    rest_positions (J, 3)   head of each bone in its parent's axes (of a root in the world), in the rest pose
    rest_rotations (J, 4)   axes of each bone to its parent's (of a root to the world's), in the rest pose
    tails (J, 3)        tail of each bone in its own axes, NaN where it has none
    pelvis              name of the pelvis bone
    pelvis_position (T, 3)  its head in its parent's axes (of a root in the world); all other bones keep their rest_positions
    rotations (T, J, 4) axes of each bone to its parent's, without sign flips: in the rest pose these are rest_rotations
    is_moved (J,)       whether the bone belongs to a segment of the body or moves; the others keep the rest pose
    segments (S,)       segments of the body;  segment_bones (S,) the names of their bones from the pelvis outwards, separated by
                        line feeds

The pose in the world follows from the root downwards: a bone's axes are those of its parent times its own rotation, its head is
its parent's head plus the parent's axes times its position.
"""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from mocapfix.contacts.contacts import BodyContacts
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
) -> None:
    """Write the markers of a take and, if there is a body, its motion.

    Args:
        target: The file.
        take: The cleaned take.
        skeleton: The skeleton of the body.
        motion: Its motion.
        rate: Frames per second of the motion; by default those of the take.
        solved_joints: The joints that the markers show; by default all.
        contacts: The contacts of the body.

    Raises:
        WriteError: If `target` is not writable.
    """
    arrays = {
        "format": np.array(NPZ_FORMAT),
        "units": np.array(NPZ_UNITS),
        "rate": np.array(float(rate or take.rate)),
        "first_frame": np.array(take.first_frame),
        "labels": np.array(take.labels),
        "markers": take.markers,
        "marker_sd": np.full(take.visible.shape, np.nan) if take.sample_sd is None else take.sample_sd,
        "marker_rate": np.array(float(take.rate)),
    }
    if take.label_confidence is not None:
        arrays["label_confidence"] = take.label_confidence
    if skeleton is not None and motion is not None:
        arrays |= _build_body_arrays(skeleton, motion, solved_joints)
    if contacts is not None:
        arrays |= _build_contact_arrays(contacts)
    with replace_atomically(Path(target)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _build_contact_arrays(contacts: BodyContacts) -> dict[str, np.ndarray]:
    return {
        "contact_joints": np.array(contacts.joints),
        "contacts": contacts.is_contact,
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
    from scipy.spatial.transform import Rotation  # few cleanings need it

    bones, is_known = range(len(character.names)), np.ones(motion.frame_count, bool)
    rotations = [lie.extract_joint_quaternions(motion.local_rotations, bone, is_known) for bone in bones]
    segments = [segment for segment, chain in character.mapping.bones.items() if chain]
    arrays = {
        "format": np.array(CHARACTER_NPZ_FORMAT),
        "units": np.array(CHARACTER_NPZ_UNITS),
        "character": np.array(character.name),
        "rate": np.array(float(motion.rate)),
        "names": np.array(character.names),
        "parents": character.parents,
        "scales": character.scales,
        "root_scale": np.array(float(character.root_scale)),
        "rest_positions": character.rest_positions,
        "rest_rotations": Rotation.from_matrix(character.rest_rotations).as_quat(),
        "tails": character.tails,
        "pelvis": np.array(character.names[character.mapping.bones["pelvis"][0]]),
        "pelvis_position": motion.pelvis_position,
        "rotations": np.stack(rotations, axis=1),
        "is_moved": np.isin(np.arange(len(character.names)), list(moving_bones)),
        "segments": np.array(segments),
        "segment_bones": np.array(
            ["\n".join(character.names[bone] for bone in character.mapping.bones[segment]) for segment in segments]
        ),
    }
    with replace_atomically(Path(target)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
