"""Write the motion of a character as NumPy arrays (.npz) for other programs: `np.load("walk.character.npz")`, without pickle.

Metres, seconds, Y up, right-handed; quaternions x, y, z, w. With T frames and J bones, parents before children:

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

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import Character, CharacterMotion
from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels import quaternions
from mocapfix.write.character_bones import list_moving_bones

CHARACTER_NPZ_FORMAT = "mocapfix character 1"
CHARACTER_NPZ_UNITS = "metres, seconds; Y up, right-handed; quaternions x, y, z, w; rotations to the parent's axes"


def write_character_npz(target: Path, character: Character, motion: CharacterMotion) -> None:
    """Write the motion of a character. Raises WriteError if `target` is not writable."""
    bones, is_known = range(len(character.names)), np.ones(motion.frame_count, bool)
    rotations = [quaternions.extract_joint_quaternions(motion.local_rotations, bone, is_known) for bone in bones]
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
        "is_moved": np.isin(np.arange(len(character.names)), list_moving_bones(character, motion)),
        "segments": np.array(segments),
        "segment_bones": np.array(
            ["\n".join(character.names[bone] for bone in character.mapping.bones[segment]) for segment in segments]
        ),
    }
    with replace_atomically(Path(target)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
