"""Write the motion of a character beside the other outputs: GLB, BVH, NPZ, on request FBX, and its mapping of bones as YAML."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.characters.character import Character, CharacterMotion
from mocapfix.characters.cmu31_character import build_cmu31_character, convert_motion
from mocapfix.characters.mapping_file import write_mapping_file
from mocapfix.contacts.contacts import BodyContacts
from mocapfix.files.output_files import make_scratch_folder
from mocapfix.motion import Motion
from mocapfix.retarget.body_frames import build_body_frame
from mocapfix.retarget.retarget_motion import retarget_motion
from mocapfix.skeleton import Skeleton
from mocapfix.write.character_bvh import write_character_bvh
from mocapfix.write.character_glb import write_character_glb
from mocapfix.write.character_npz import write_character_npz
from mocapfix.write.fbx import write_character_fbx

CHARACTER_SUFFIXES = ("glb", "bvh", "npz", "map.yaml")
FBX_SUFFIX = "fbx"


@dataclass(frozen=True)
class CharacterFiles:
    """What is written of a character.

    character      the character, with a mapping of its bones
    key_error_deg  largest error of reduced keys; None for a key in every frame
    has_fbx        whether FBX is written too
    """

    character: Character
    key_error_deg: float | None = None
    has_fbx: bool = False

    @property
    def suffixes(self) -> tuple[str, ...]:
        """The suffixes of the files, after the stem of the take."""
        endings = (*CHARACTER_SUFFIXES, *((FBX_SUFFIX,) if self.has_fbx else ()))
        return tuple(f"{self.character.name}.{ending}" for ending in endings)

    def write(
        self, target: Path, skeleton: Skeleton, motion: Motion, rate: float, contacts: BodyContacts | None = None
    ) -> list[str]:
        """Write the motion of a solved skeleton, retargeted onto the character.

        target    the GLB; the other files are beside it
        rate      frames per second
        contacts  of the motion, with its floor; if the feet of the motion are locked in them, so are the character's

        Returns sentences for the report. Raises WriteError if a file is not writable.
        """
        character = self.character
        source = build_cmu31_character(skeleton)
        retargeted = retarget_motion(source, convert_motion(motion, rate), character, contacts=contacts)
        write_character_bvh(target.with_suffix(".bvh"), character, retargeted)
        write_character_npz(target.with_suffix(".npz"), character, retargeted)
        write_mapping_file(target.with_suffix(".map.yaml"), character)
        scale = build_body_frame(character).leg_length_m / build_body_frame(source).leg_length_m
        notes = [f"{target.name}: {character.mapping.reason} Places are scaled by {scale:.3f}, the ratio of the legs' lengths."]
        return [*notes, *write_glb_and_fbx(target, character, retargeted, self.key_error_deg, contacts, has_fbx=self.has_fbx)]


def write_glb_and_fbx(
    target: Path,
    character: Character,
    motion: CharacterMotion,
    key_error_deg: float | None,
    contacts: BodyContacts | None,
    *,
    has_fbx: bool,
) -> list[str]:
    """Write a GLB, and with `has_fbx` an FBX of it by Blender. Returns sentences for the report. Raises WriteError."""
    take_name = target.name.partition(".")[0]
    key_error_rad = None if key_error_deg is None else float(np.deg2rad(key_error_deg))
    reduction = write_character_glb(target, character, motion, take_name, key_error_rad, contacts)
    notes = [] if reduction is None else [f"{target.name}: {reduction.sentence}"]
    if has_fbx and (problem := write_character_fbx(target.with_suffix(f".{FBX_SUFFIX}"), target, motion.rate)):
        notes.append(problem)
    return notes


def write_skeleton_fbx(
    target: Path,
    skeleton: Skeleton,
    motion: Motion,
    rate: float,
    key_error_deg: float | None,
    contacts: BodyContacts | None = None,
) -> list[str]:
    """Write the solved skeleton as FBX. Returns sentences for the report. Raises WriteError.

    contacts  of the motion, in which a reduction of keys keeps the feet; without any, slow feet stand
    """
    with make_scratch_folder() as folder:
        glb = folder / f"{target.stem}.glb"
        character = build_cmu31_character(skeleton)
        write_glb_and_fbx(glb, character, convert_motion(motion, rate), key_error_deg, contacts, has_fbx=False)
        problem = write_character_fbx(target, glb, rate)
    return [problem] if problem else []
