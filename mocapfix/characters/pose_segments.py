"""Solve the poses of a character's segments under terms that say what of the source's motion is kept.

    orientation terms   pelvis, chest, head, hands and feet, in the world
    direction terms     thighs, shins, upper arms and forearms, and the planes in which knees bend
    point terms         ankles and wrists at their targets
    tracking term       the other rotations, and the pelvis at its height in leg lengths
    joint limits        of the character, where it has them

The weights are the same in all frames, so that no joint jumps where a contact begins or ends: a foot in contact has a target that
stands still.

The tree of a character's segments for the solver: one joint for each segment, or for each bone of spine and neck.

The joints have the axes of the bones. Bones between two joints that the motion does not turn are part of the first.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import BodyFrame
from mocapfix.characters.character import SIDES, TWISTING_SEGMENTS, Character
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.minimise import SolverSettings, minimise
from mocapfix.solve.terms import DirectionTerm, JointLimitTerm, KinematicTree, OrientationTerm, PointTerm, TrackingTerm

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


ANKLE_SD_M = 0.0003
WRIST_SD_M = 0.003
PELVIS_SD_M = 0.006
"""Standard deviations of positions about their targets."""
ORIENTATION_SD_RAD = {"pelvis": 0.01, "chest": 0.05, "head": 0.02, "hand": 0.03, "foot": 0.005}
"""Standard deviations of orientations in the world, by segment."""
DIRECTION_SD_RAD = 0.1
"""Standard deviation of the direction of a limb's bone."""
TRACKING_SD_RAD = {"spine": 0.03, "clavicle": 0.03}
"""Standard deviations of rotations relative to the parent, by segment."""
OTHER_TRACKING_SD_RAD = 0.3
LIMIT_SD_RAD = 0.1
"""Standard deviation of a joint's excess over its limits."""
MAX_POSE_ITERATIONS = 30
SIDEWAYS_SD_RAD = 0.2
"""Standard deviation of the direction of a thigh's or shin's own sideways axis: it keeps the plane in which a knee bends."""
MIN_START_FLEXION_RAD = np.deg2rad(8.0)
"""Flexion of a knee with which its solve begins at least: a straight leg could bend either way."""
DIRECTED_BONES = (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))

SIDEWAYS = np.array([1.0, 0.0, 0.0])
"""Axis of a segment about which a knee bends, forwards for a positive angle."""


class SegmentTargets(NamedTuple):
    """What is kept, over T frames.

    rotation  (T, N, 3, 3): of the joints of a `SolveTree`, in the world; also the start of the solve
    pelvis    (T, 3) m
    points    segment (feet and hands) to (T, 3) m: where it shall begin
    """

    rotation: Float[np.ndarray, "T N 3 3"]
    pelvis: Float[np.ndarray, "T 3"]
    points: dict[str, Float[np.ndarray, "T 3"]]

    def replace_points(self, points: dict[str, Float[np.ndarray, "T 3"]]) -> "SegmentTargets":
        """Return the targets with some points in place of those of the same segments."""
        return self._replace(points=self.points | points)

    def select_frames(self, is_selected: Bool[np.ndarray, " T"]) -> "SegmentTargets":
        """Return the targets of some frames."""
        points = {segment: place[is_selected] for segment, place in self.points.items()}
        return SegmentTargets(self.rotation[is_selected], self.pelvis[is_selected], points)


def solve_segments(tree: SolveTree, character: Character, targets: SegmentTargets) -> Poses:
    """Return positions (T, 3) of the pelvis in metres and local rotations (T, N, 3, 3) that reach the targets."""
    local = compute_rotations_to_parents(tree, targets.rotation)
    terms = (
        _build_point_term(tree, targets),
        _build_direction_term(tree, targets.rotation),
        _build_orientation_term(tree, targets.rotation),
        _build_tracking_term(tree, local, targets.pelvis),
        _build_limit_term(tree, character),
    )
    start = targets.pelvis, bend_straight_knees(tree, local)
    return minimise(tree.tree, terms, start, SolverSettings(max_iterations=MAX_POSE_ITERATIONS)).poses


def bend_straight_knees(tree: SolveTree, local: Float[np.ndarray, "T N 3 3"]) -> Float[np.ndarray, "T N 3 3"]:
    """Return local rotations with every knee flexed by MIN_START_FLEXION_RAD at least; the foot keeps its direction."""
    bent = local.copy()
    for side in SIDES:
        thigh, shin, foot = (tree.find_joint(f"{side}_{segment}") for segment in ("thigh", "shin", "foot"))
        axes = tree.standard_rotations
        knee = axes[thigh] @ local[:, shin] @ axes[shin].T  # of the shin relative to the thigh, in the segments' axes
        missing = np.maximum(MIN_START_FLEXION_RAD - Rotation.from_matrix(knee).as_rotvec()[:, 0], 0.0)
        half, whole = (Rotation.from_rotvec(share * missing[:, None] * SIDEWAYS).as_matrix() for share in (0.5, 1.0))
        bent[:, thigh] = bent[:, thigh] @ axes[thigh].T @ np.swapaxes(half, 1, 2) @ axes[thigh]
        bent[:, shin] = axes[thigh].T @ whole @ knee @ axes[shin]
        bent[:, foot] = axes[shin].T @ np.swapaxes(half, 1, 2) @ axes[shin] @ bent[:, foot]
    return bent


def compute_rotations_to_parents(tree: SolveTree, rotation: Float[np.ndarray, "T N 3 3"]) -> Float[np.ndarray, "T N 3 3"]:
    """Return rotations relative to the parents, of rotations in the world."""
    local = rotation.copy()
    parents = tree.tree.parents
    local[:, 1:] = np.swapaxes(rotation[:, parents[1:]], 2, 3) @ rotation[:, 1:]
    return local


def _get_base_segment(segment: str) -> str:
    """Return a segment without its side and number."""
    return segment.removeprefix("left_").removeprefix("right_").partition(".")[0]


def _build_point_term(tree: SolveTree, targets: SegmentTargets) -> PointTerm:
    joints = np.array([tree.find_joint(segment) for segment in targets.points])
    measured = np.ascontiguousarray(np.stack(list(targets.points.values()), axis=1))
    sd = np.array([ANKLE_SD_M if segment.endswith("foot") else WRIST_SD_M for segment in targets.points])
    weight = np.tile(sd**-2, (len(measured), 1))
    return PointTerm(joints, np.zeros((len(joints), 3)), measured, weight)


def _build_direction_term(tree: SolveTree, rotation: Float[np.ndarray, "T N 3 3"]) -> DirectionTerm:
    joints: list[int] = []
    axes: list[np.ndarray] = []
    for side in SIDES:
        for start, end in DIRECTED_BONES:
            joint, tip = tree.find_joint(f"{side}_{start}"), tree.find_joint(f"{side}_{end}")
            if joint >= 0 and tip >= 0 and np.linalg.norm(tree.tree.offsets[tip]) > 0 and tree.tree.parents[tip] == joint:
                joints.append(joint)
                axes.append(tree.tree.offsets[tip] / np.linalg.norm(tree.tree.offsets[tip]))
    sd = [DIRECTION_SD_RAD] * len(joints)
    for side in SIDES:
        for segment in ("thigh", "shin"):
            joint = tree.find_joint(f"{side}_{segment}")
            joints.append(joint)
            axes.append(tree.standard_rotations[joint].T @ SIDEWAYS)
            sd.append(SIDEWAYS_SD_RAD)
    measured = np.ascontiguousarray((rotation[:, joints] @ np.array(axes)[:, :, None])[..., 0])
    weight = np.tile(np.array(sd) ** -2.0, (len(measured), 1))
    return DirectionTerm(np.array(joints), np.array(axes), measured, weight)


def _build_orientation_term(tree: SolveTree, rotation: Float[np.ndarray, "T N 3 3"]) -> OrientationTerm:
    chest = max((k for k, segment in enumerate(tree.segments) if segment.startswith("spine.")), default=-1)
    joints = [k for k, segment in enumerate(tree.segments) if _get_base_segment(segment) in ORIENTATION_SD_RAD]
    sd = [ORIENTATION_SD_RAD[_get_base_segment(tree.segments[k])] for k in joints]
    if chest >= 0:
        joints.append(chest)
        sd.append(ORIENTATION_SD_RAD["chest"])
    weight = np.tile(np.array(sd) ** -2, (len(rotation), 1))
    return OrientationTerm(np.array(joints), np.ascontiguousarray(rotation[:, joints]), weight)


def _build_tracking_term(tree: SolveTree, local: Float[np.ndarray, "T N 3 3"], pelvis: Float[np.ndarray, "T 3"]) -> TrackingTerm:
    sd = np.array([TRACKING_SD_RAD.get(_get_base_segment(segment), OTHER_TRACKING_SD_RAD) for segment in tree.segments])
    weight = np.where(np.arange(len(sd)) == 0, 0.0, sd**-2)[None]
    return TrackingTerm(local, np.ascontiguousarray(weight), pelvis, np.full(len(pelvis), PELVIS_SD_M**-2))


def _build_limit_term(tree: SolveTree, character: Character) -> JointLimitTerm:
    """Return the limits of the joints about the rest pose, without any where the character has none.

    Limits of a limb's bones that share its twist are for their shares, so they do not apply to the joint.
    """
    chains = [character.mapping.bones.get(segment, ()) for segment in TWISTING_SEGMENTS]
    shared = {bone for chain in chains if len(chain) > 1 for bone in chain}
    count = len(tree.bones)
    rest = character.compute_rest_pose()[1][tree.bones]
    low, high = np.full((count, 3), -np.inf), np.full((count, 3), np.inf)
    for k, bone in enumerate(tree.bones.tolist()):
        if bone in character.limits_deg and bone not in shared:
            low[k], high[k] = np.deg2rad(character.limits_deg[bone]).T
    reference = compute_rotations_to_parents(tree, rest[None])[0]
    return JointLimitTerm(reference, low, high, LIMIT_SD_RAD**-2)
