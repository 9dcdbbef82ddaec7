"""The tree of a character's segments for the solver: one joint for each segment, or for each bone of spine and neck.

The joints have the axes of the bones. Bones between two joints that the motion does not turn are part of the first.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.retarget.body_frames import BodyFrame

CHAIN_SEGMENTS = ("spine", "neck")
"""Segments of which every bone is a joint of its own."""
FIXED_SEGMENTS = ("neck", "toe")
"""Segments that keep their rotation relative to their parent."""


@dataclass(frozen=True)
class SolveTree:
    """N joints of a character, parents before children, the pelvis first.

    tree      for the kernels; offsets in metres in the bones' axes
    bones     (N,) the bone that has each joint's rotation
    segments  the segment of each joint, of spine and neck with the number of the bone: spine.0
    standard_rotations  (N, 3, 3): C of `BodyFrame`
    """

    tree: KinematicTree
    bones: Int[np.ndarray, " N"]
    segments: tuple[str, ...]
    standard_rotations: Float[np.ndarray, "N 3 3"]

    @property
    def free(self) -> Bool[np.ndarray, " N"]:
        """The joints that the solver turns."""
        return self.tree.free

    def find_joint(self, segment: str) -> int:
        """Return the index of a segment's joint, -1 if the character lacks it."""
        return self.segments.index(segment) if segment in self.segments else -1


def build_solve_tree(frame: BodyFrame) -> SolveTree:
    """Return the tree of a character's segments."""
    character, joints = frame.character, _list_joints(frame)
    joint_of_bone = {bone: k for k, (_, chain, _) in enumerate(joints) for bone in chain}
    parents, offsets = np.full(len(joints), -1), np.zeros((len(joints), 3))
    for k, (_, chain, _) in enumerate(joints):
        above = int(character.parents[chain[0]])
        while above >= 0 and above not in joint_of_bone:
            above = int(character.parents[above])
        if k and above >= 0:
            parent = joint_of_bone[above]
            _, parent_chain, parent_bone = joints[parent]
            parents[k] = parent
            vector = frame.rest_position[chain[0]] - frame.rest_position[parent_chain[0]]
            offsets[k] = frame.rest_rotation[parent_bone].T @ vector
    segments = tuple(segment for segment, _, _ in joints)
    free = np.array([not segment.partition(".")[0].endswith(FIXED_SEGMENTS) for segment in segments])
    bones = np.array([bone for _, _, bone in joints])
    standard = np.stack([frame.standard_rotations[bone] for bone in bones.tolist()])
    return SolveTree(KinematicTree(parents, offsets, free), bones, segments, standard)


def _list_joints(frame: BodyFrame) -> list[tuple[str, tuple[int, ...], int]]:
    """Return segment, bones, and the bone that has the rotation, of each joint, parents first."""
    joints: list[tuple[str, tuple[int, ...], int]] = []
    for segment, chain in frame.character.mapping.bones.items():
        if segment in CHAIN_SEGMENTS:
            joints += [(f"{segment}.{k}", (bone,), bone) for k, bone in enumerate(chain)]
        elif chain:
            joints.append((segment, chain, frame.segment_bones[segment]))
    return sorted(joints, key=lambda joint: (joint[0] != "pelvis", joint[1][0]))  # bones come after their parents
