"""Rotation copying, as constraints in Blender do it: the baseline against which retargeting is measured.

Each bone turns from its rest pose as the source's bone does, in the world, and the pelvis moves as the source's does, from the
height of its own rest pose. Nothing else is kept.
"""

import numpy as np

from mocapfix.characters.character import Character, CharacterMotion
from mocapfix.retarget.body_frames import build_body_frame
from mocapfix.retarget.pose_segments import compute_rotations_to_parents
from mocapfix.retarget.retarget_motion import compose_character_motion, spread_rotations
from mocapfix.retarget.segment_motion import compute_segment_motion
from mocapfix.retarget.solve_tree import build_solve_tree


def copy_rotations(source: Character, motion: CharacterMotion, target: Character) -> CharacterMotion:
    """Return the motion of a target whose bones have the source's rotations, and whose pelvis has the source's path."""
    source_frame, target_frame = build_body_frame(source), build_body_frame(target)
    segments, tree = compute_segment_motion(source_frame, motion), build_solve_tree(target_frame)
    rotation = spread_rotations(source_frame, target_frame, tree, segments)
    standing = [frame.leg_length_m + frame.ankle_height_m - frame.hip_centre[1] for frame in (source_frame, target_frame)]
    pelvis = segments.position["pelvis"] + np.array([0.0, standing[1] - standing[0], 0.0])
    return compose_character_motion(target_frame, tree, pelvis, compute_rotations_to_parents(tree, rotation), motion.rate)
