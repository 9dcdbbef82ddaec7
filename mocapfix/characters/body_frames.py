"""The segments of a body: their standard pose, which makes two bodies comparable, and their motion.

Rest poses differ: arms are level or hang, legs are apart, bones have axes of their own. In the standard pose a figure stands
upright and faces +Z, Y up, its arms level to the sides, its legs vertical, its feet straight ahead. Each segment has axes that
are those of the world in this pose. `standard_rotations` has C, the axes of a segment's bone in the segment's axes, so that
R = S C for the world rotations R of the bone and S of the segment. Retargeting keeps S.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import LIMB_ENDS, SIDE_SEGMENTS, SIDES, Character, CharacterMotion, compute_character_poses
from mocapfix.stats.rigid_alignment import compute_shortest_rotation, compute_shortest_rotations

LIMB_DIRECTIONS = {"left": np.array([1.0, 0.0, 0.0]), "right": np.array([-1.0, 0.0, 0.0])}
"""Directions of the arms in the standard pose."""
DOWN = np.array([0.0, -1.0, 0.0])
OUTER_BONE_SEGMENTS = ("upper_arm", "thigh")
"""Segments whose outermost bone has the twist of the whole; of the other limb segments it is the innermost bone."""
MAX_FOOT_YAW_RAD = np.deg2rad(45.0)  # a foot that points more to the side in the rest pose is not turned straight ahead
DEFAULT_BALL_HEIGHT = 0.03
"""Height of the ball joint above the sole, as a share of the leg's length, where the rest pose does not stand at height 0."""
MAX_BALL_HEIGHT = 0.15
MAX_BALL_DEPTH = 0.03
"""Heights between which the balls of a figure are that stands on height 0; below 0 they are taken to be at 0."""
DEFAULT_FOOT_LENGTH = 0.15
"""Distance from the ankle to the ball of the foot, as a share of the leg's length, of a foot without toes and tail."""
DEFAULT_ANKLE_HEIGHT = 0.08
PALM_SHARE = 0.7  # the middle of the hand, as a share of its bone, which ends at the knuckles
DEFAULT_PALM = 0.13  # the same as a share of the arm's length, for a hand without a tail


@dataclass(frozen=True)
class BodyFrame:
    """The segments of a character in its rest pose and its measures."""

    character: Character
    segment_bones: dict[str, int]  # segment to the bone that has the segment's rotation
    standard_rotations: dict[int, Float[np.ndarray, "3 3"]]  # bone to C (3, 3)
    rest_position: Float[np.ndarray, "J 3"]  # rest_position, rest_rotation: (J, 3) m and (J, 3, 3): the rest pose in the world
    rest_rotation: Float[np.ndarray, "J 3 3"]
    facing: Float[np.ndarray, "3 3"]  # (3, 3): from axes that face +Z to those of the rest pose in the world, a rotation about Y

    def find_head(self, segment: str) -> Float[np.ndarray, " 3"]:
        """Return where a segment begins in the rest pose: the head of its first bone, in metres."""
        return self.rest_position[self.character.mapping.bones[segment][0]]

    def compute_vector(self, segment: str, point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
        """Return a point of the rest pose relative to a segment's beginning, in the segment's axes, in metres."""
        bone = self.segment_bones[segment]
        return self.standard_rotations[bone] @ self.rest_rotation[bone].T @ (point - self.find_head(segment))

    def compute_chain_offsets(self, segment: str, end: str | None = None) -> Float[np.ndarray, "n 3"]:
        """Return the vectors from each bone of the spine or neck to the next, in the segments' axes, in metres.

        The last is to the beginning of the segment `end`, if it is given and the character has it.
        """
        heads = [self.rest_position[bone] for bone in self.character.mapping.bones.get(segment, ())]
        if end in self.segment_bones and heads:
            heads.append(self.find_head(end))
        return np.diff(np.reshape(heads, (-1, 3)), axis=0) @ self.facing if len(heads) > 1 else np.zeros((0, 3))

    def compute_length(self, start: str, end: str) -> float:
        """Return the mean over both sides of the distance in metres between the beginnings of two segments."""
        return float(
            np.mean([np.linalg.norm(self.find_head(f"{side}_{end}") - self.find_head(f"{side}_{start}")) for side in SIDES])
        )

    @property
    def leg_length_m(self) -> float:
        return self.compute_length("thigh", "shin") + self.compute_length("shin", "foot")

    @property
    def has_hands(self) -> bool:
        """Whether both hands are mapped, so that the forearms have a length."""
        return all(f"{side}_hand" in self.segment_bones for side in SIDES)

    @property
    def arm_length_m(self) -> float:
        """Length of upper arm and forearm; needs hands."""
        return self.compute_length("upper_arm", "forearm") + self.compute_length("forearm", "hand")

    @property
    def trunk_length_m(self) -> float:
        """Distance from the pelvis to the beginning of the arms."""
        arms = np.mean([self.find_head(f"{side}_upper_arm") for side in SIDES], axis=0)
        return float(np.linalg.norm(arms - self.find_head("pelvis")))

    @property
    def hip_centre(self) -> Float[np.ndarray, " 3"]:
        """The point between the hip joints, relative to the pelvis, in its axes, in metres."""
        centre = np.mean([self.find_head(f"{side}_thigh") for side in SIDES], axis=0)
        return self.compute_vector("pelvis", centre)

    def compute_ball(self, side: str) -> Float[np.ndarray, " 3"]:
        """Return the ball of a foot relative to the ankle, in the foot's axes, in metres.

        It is the toe's beginning, or the tail of the foot's bone, or estimated from the leg's length.
        """
        foot = self.segment_bones[f"{side}_foot"]
        if f"{side}_toe" in self.segment_bones:
            return self.compute_vector(f"{side}_foot", self.find_head(f"{side}_toe"))
        tail = self.rest_position[foot] + self.rest_rotation[foot] @ self.character.skeleton.ends[foot]
        vector = self.compute_vector(f"{side}_foot", tail)
        length = DEFAULT_FOOT_LENGTH * self.leg_length_m
        if np.isfinite(vector).all() and vector[2] > length / 2:
            return vector
        return np.array([0.0, (DEFAULT_BALL_HEIGHT - DEFAULT_ANKLE_HEIGHT) * self.leg_length_m, length])

    def compute_palm(self, side: str) -> Float[np.ndarray, " 3"]:
        """Return the middle of a hand relative to the wrist, in the hand's axes, in metres, by the tail of its bone."""
        hand = self.segment_bones[f"{side}_hand"]
        tail = self.rest_position[hand] + self.rest_rotation[hand] @ self.character.skeleton.ends[hand]
        vector = self.compute_vector(f"{side}_hand", tail)
        return PALM_SHARE * vector if np.isfinite(vector).all() else DEFAULT_PALM * self.arm_length_m * LIMB_DIRECTIONS[side]

    @property
    def ball_height_m(self) -> float:
        """Height of the balls of the feet above the sole, of a figure that stands flat.

        It is their height in the rest pose where that stands on height 0, as the rest pose of a character with a mesh does.
        """
        if not self.character.has_feet_flat:
            return DEFAULT_BALL_HEIGHT * self.leg_length_m
        heights: list[float] = []
        for side in SIDES:
            foot = self.segment_bones[f"{side}_foot"]
            axes = self.rest_rotation[foot] @ self.standard_rotations[foot].T
            heights.append(float((self.find_head(f"{side}_foot") + axes @ self.compute_ball(side))[1]))
        height = float(np.mean(heights)) / self.leg_length_m
        is_standing = -MAX_BALL_DEPTH <= height < MAX_BALL_HEIGHT
        return (max(height, 0.0) if is_standing else DEFAULT_BALL_HEIGHT) * self.leg_length_m

    @property
    def ankle_height_m(self) -> float:
        """Height of the ankles above the sole, of a figure that stands flat."""
        return self.ball_height_m - float(np.mean([self.compute_ball(side)[1] for side in SIDES]))


def build_body_frame(character: Character) -> BodyFrame:
    """Compute the standard pose of a character from its rest pose. The mapping must have all required segments."""
    position, rotation = character.skeleton.compute_rest_pose()
    bones = character.mapping.bones
    segment_bones = {segment: find_segment_bone(segment, chain) for segment, chain in bones.items() if chain}
    facing = _compute_facing(position, bones)
    turns = _compute_segment_turns(character, position, rotation, facing)
    standard: dict[int, Float[np.ndarray, "3 3"]] = {}
    for segment, chain in (*bones.items(), *character.mapping.twists.items()):
        for bone in chain:
            standard[bone] = turns.get(segment, np.eye(3)) @ facing.T @ rotation[bone]
    return BodyFrame(character, segment_bones, standard, position, rotation, facing)


def find_segment_bone(segment: str, chain: tuple[int, ...]) -> int:
    """Return the bone of a segment's chain that has the segment's rotation."""
    is_outer = segment.partition("_")[2] in OUTER_BONE_SEGMENTS
    return chain[-1] if is_outer else chain[0]


def _compute_facing(position: Float[np.ndarray, "J 3"], bones: Mapping[str, tuple[int, ...]]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about Y that turns +X to the figure's left."""
    leftward = np.zeros(3)
    for segment in ("thigh", "upper_arm"):
        leftward += position[bones[f"left_{segment}"][0]] - position[bones[f"right_{segment}"][0]]
    return Rotation.from_euler("y", np.arctan2(-leftward[2], leftward[0])).as_matrix()


def _compute_segment_turns(
    character: Character, position: Float[np.ndarray, "J 3"], rotation: Float[np.ndarray, "J 3 3"], facing: np.ndarray
) -> dict[str, Float[np.ndarray, "3 3"]]:
    """Return the rotations of the limbs' segments from the rest pose, facing +Z, to the standard pose."""
    bones = character.mapping.bones
    heads = {segment: facing.T @ position[chain[0]] for segment, chain in bones.items() if chain}
    turns: dict[str, Float[np.ndarray, "3 3"]] = {}
    for side in SIDES:
        for start, end in LIMB_ENDS.items():
            direction = DOWN if start in ("thigh", "shin") else LIMB_DIRECTIONS[side]
            bone = bones[f"{side}_{start}"][-1]
            tail = facing.T @ (position[bone] + rotation[bone] @ character.skeleton.ends[bone])
            vector = heads.get(f"{side}_{end}", tail) - heads[f"{side}_{start}"]
            turns[f"{side}_{start}"] = compute_shortest_rotation(vector, direction) if np.isfinite(vector).all() else np.eye(3)
        turns[f"{side}_hand"] = turns[f"{side}_forearm"]
        turn = np.eye(3) if character.has_feet_flat else turns[f"{side}_shin"]
        if f"{side}_toe" in heads:
            x, _, z = turn @ (heads[f"{side}_toe"] - heads[f"{side}_foot"])
            yaw = float(np.arctan2(x, z))
            if abs(yaw) < MAX_FOOT_YAW_RAD:
                turn = Rotation.from_euler("y", -yaw).as_matrix() @ turn
        turns[f"{side}_foot"] = turns[f"{side}_toe"] = turn
    return turns


PARENT_SEGMENTS = {
    "clavicle": "chest", "upper_arm": "clavicle", "forearm": "upper_arm", "hand": "forearm",
    "thigh": "pelvis", "shin": "thigh", "foot": "shin", "toe": "foot",
}  # fmt: skip
"""The segment with which one that a body lacks moves; both of the same side, except pelvis and chest."""
MIN_LENGTH_M = 1e-9


@dataclass(frozen=True)
class SegmentMotion:
    """The segments of a body in every frame."""

    position: Mapping[str, Float[np.ndarray, "T 3"]]  # segment to (T, 3) m: where it begins
    # segment to S (T, 3, 3), from the segment's axes to the world's. "chest" is the outermost bone of the spine
    rotation: Mapping[str, Float[np.ndarray, "T 3 3"]]
    spine: Float[np.ndarray, "T n 3 3"]  # (T, n + 1, 3, 3): of the pelvis and the spine's n bones
    neck: Float[np.ndarray, "T n 3 3"]  # (T, n + 2, 3, 3): of the chest, the neck's n bones and the head


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


def turn_by_share(start: Float[np.ndarray, "T 3 3"], end: Float[np.ndarray, "T 3 3"], share: float) -> Float[np.ndarray, "T 3 3"]:
    """Return the rotations at a share of the way from one to another."""
    if share <= 0.0 or share >= 1.0:
        return start if share <= 0.0 else end
    vector = Rotation.from_matrix(np.swapaxes(start, 1, 2) @ end).as_rotvec()
    return start @ Rotation.from_rotvec(share * vector).as_matrix()
