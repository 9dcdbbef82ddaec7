"""The segments of a body: their standard pose, which makes two bodies comparable, and their motion.

Rest poses differ: arms are level or hang, legs are apart, bones have axes of their own. In the standard pose a figure stands
upright and faces +Z, Y up, its arms level to the sides, its legs vertical, its feet straight ahead. Each segment has axes that
are those of the world in this pose. `standard_rotations` has C, the axes of a segment's bone in the segment's axes, so that
R = S C for the world rotations R of the bone and S of the segment. Retargeting keeps S.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters import fingers
from mocapfix.characters.character import (
    FINGERS,
    LIMB_ENDS,
    SIDE_SEGMENTS,
    SIDES,
    Character,
    CharacterMotion,
    compute_character_poses,
    get_next_segment,
)
from mocapfix.characters.fingers import HandPoses
from mocapfix.stats.rigid_alignment import compute_shortest_rotation, compute_shortest_rotations, scale_rotations

LIMB_DIRECTIONS = {"left": np.array([1.0, 0.0, 0.0]), "right": np.array([-1.0, 0.0, 0.0])}
"""Directions of the arms in the standard pose."""
DOWN = np.array([0.0, -1.0, 0.0])
LIMB_AXES = {
    f"{side}_{segment}": direction if segment in ("upper_arm", "forearm") else DOWN
    for side, direction in LIMB_DIRECTIONS.items()
    for segment in LIMB_ENDS
}
"""Directions in the standard pose of the limbs' segments: from where each begins to where it ends, in its own axes."""
OUTER_BONE_SEGMENTS = ("upper_arm", "thigh")
"""Segments whose outermost bone has the twist of the whole; of the other limb segments it is the innermost bone."""
MAX_FOOT_YAW_RAD = np.deg2rad(45.0)  # a foot that points more to the side in the rest pose is not turned straight ahead
DEFAULT_BALL_HEIGHT = 0.03
"""Height of the ball joint above the sole, as a share of the leg's length, where the rest pose does not stand at height 0."""
MAX_BALL_HEIGHT, MAX_BALL_DEPTH = 0.15, 0.03
"""Heights between which the balls of a figure are that stands on height 0; below 0 they are taken to be at 0."""
DEFAULT_FOOT_LENGTH, DEFAULT_ANKLE_HEIGHT = 0.15, 0.08
"""Distance from the ankle to the ball of the foot and its height, as shares of the leg's length, without toes and tail."""
PALM_SHARE = 0.7  # the middle of the hand, as a share of its bone, which ends at the knuckles
DEFAULT_PALM = 0.13  # the same as a share of the arm's length, for a hand without a tail


@dataclass(frozen=True)
class BodyFrame:
    """The segments of a character in its rest pose and its measures."""

    character: Character
    segment_bones: dict[str, int]  # segment to the bone that has the segment's rotation
    standard_rotations: dict[int, Float[np.ndarray, "3 3"]]  # bone to C
    rest_position: Float[np.ndarray, "J 3"]  # rest_position, rest_end, rest_rotation: of the bones in the world, in the rest pose
    rest_end: Float[np.ndarray, "J 3"]
    rest_rotation: Float[np.ndarray, "J 3 3"]
    facing: Float[np.ndarray, "3 3"]  # from axes that face +Z to those of the rest pose in the world, a rotation about Y

    def find_head(self, segment: str) -> Float[np.ndarray, " 3"]:
        """Return where a segment begins in the rest pose: the head of its first bone, in metres."""
        return self.rest_position[self.character.mapping.bones[segment][0]]

    def find_centre(self, segment: str) -> Float[np.ndarray, " 3"]:
        """Return the middle between the beginnings of a segment on both sides."""
        return np.mean([self.find_head(f"{side}_{segment}") for side in SIDES], axis=0)

    def compute_vector(self, segment: str, point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
        """Return a point of the rest pose relative to a segment's beginning, in the segment's axes, in metres."""
        bone = self.segment_bones[segment]
        return self.standard_rotations[bone] @ self.rest_rotation[bone].T @ (point - self.find_head(segment))

    def compute_tail(self, segment: str) -> Float[np.ndarray, " 3"]:
        """Return the end of a segment's bone relative to its beginning, in the segment's axes; NaN where it is not known."""
        return self.compute_vector(segment, self.rest_end[self.segment_bones[segment]])

    def compute_chain_offsets(self, segment: str) -> Float[np.ndarray, "n 3"]:
        """Return the vectors from each bone of the spine or neck to the next, in the segments' axes, in metres.

        The last of the neck is to the beginning of the head, if the character has one.
        """
        heads = [self.rest_position[bone] for bone in self.character.mapping.bones.get(segment, ())]
        if segment == "neck" and "head" in self.segment_bones and heads:
            heads.append(self.find_head("head"))
        return np.diff(np.reshape(heads, (-1, 3)), axis=0) @ self.facing

    def compute_length(self, *segments: str) -> float:
        """Return the length in metres of the way over the beginnings of segments, the mean over both sides."""
        return float(np.mean([self.compute_way([f"{side}_{segment}" for segment in segments]) for side in SIDES]))

    def compute_way(self, segments: Sequence[str]) -> float:
        """Return the length in metres of the way over the beginnings of segments."""
        return float(np.linalg.norm(np.diff([self.find_head(segment) for segment in segments], axis=0), axis=1).sum())

    @property
    def leg_length_m(self) -> float:
        return self.compute_length("thigh", "shin", "foot")

    @property
    def has_hands(self) -> bool:
        """Whether both hands are mapped, so that the forearms have a length."""
        return all(f"{side}_hand" in self.segment_bones for side in SIDES)

    @property
    def trunk_length_m(self) -> float:
        """Distance from between the hips to between the shoulders."""
        return float(np.linalg.norm(self.find_centre("upper_arm") - self.find_centre("thigh")))

    @property
    def hip_centre(self) -> Float[np.ndarray, " 3"]:
        """The point between the hip joints, relative to the pelvis, in its axes, in metres."""
        return self.compute_vector("pelvis", self.find_centre("thigh"))

    def compute_ball(self, side: str) -> Float[np.ndarray, " 3"]:
        """Return the ball of a foot relative to the ankle, in the foot's axes, in metres.

        It is the toe's beginning, or the tail of the foot's bone, or estimated from the leg's length.
        """
        if f"{side}_toe" in self.segment_bones:
            return self.compute_vector(f"{side}_foot", self.find_head(f"{side}_toe"))
        tail, leg_length_m = self.compute_tail(f"{side}_foot"), self.leg_length_m
        if np.isfinite(tail).all() and tail[2] > DEFAULT_FOOT_LENGTH * leg_length_m / 2:
            return tail
        return leg_length_m * np.array([0.0, DEFAULT_BALL_HEIGHT - DEFAULT_ANKLE_HEIGHT, DEFAULT_FOOT_LENGTH])

    def compute_hull(self, segment: str) -> Float[np.ndarray, "P 3"]:
        """Return `Character.hulls` of a segment from its beginning, in its axes, in metres; none without a mesh."""
        points = self.character.hulls.get(segment, np.zeros((0, 3)))
        return np.array([self.compute_vector(segment, point) for point in points]).reshape(-1, 3)

    def compute_palm(self, side: str) -> Float[np.ndarray, " 3"]:
        """Return the middle of a hand relative to the wrist, in the hand's axes, in metres, by the tail of its bone."""
        tail = self.compute_tail(f"{side}_hand")
        if np.isfinite(tail).all():
            return PALM_SHARE * tail
        return DEFAULT_PALM * self.compute_length("upper_arm", "forearm", "hand") * LIMB_DIRECTIONS[side]

    @property
    def ball_height_m(self) -> float:
        """Height of the balls of the feet above the sole, of a figure that stands flat.

        It is their height in the rest pose where that stands on height 0, as the rest pose of a character with a mesh does.
        """
        heights: list[float] = []
        for side in SIDES:
            foot = self.segment_bones[f"{side}_foot"]
            axes = self.rest_rotation[foot] @ self.standard_rotations[foot].T
            heights.append(float((self.find_head(f"{side}_foot") + axes @ self.compute_ball(side))[1]))
        height = float(np.mean(heights)) / self.leg_length_m
        is_standing = self.character.has_feet_flat and -MAX_BALL_DEPTH <= height < MAX_BALL_HEIGHT
        return (max(height, 0.0) if is_standing else DEFAULT_BALL_HEIGHT) * self.leg_length_m

    @property
    def ankle_height_m(self) -> float:
        """Height of the ankles above the sole, of a figure that stands flat."""
        return self.ball_height_m - float(np.mean([self.compute_ball(side)[1] for side in SIDES]))


def build_body_frame(character: Character, hands: Collection[str] = ()) -> BodyFrame:
    """Compute the standard pose of a character from its rest pose. The mapping must have all required segments.

    `hands` are the sides whose fingers are posed: their palms are level where the knuckles are, whatever the forearms show.
    """
    position, rotation = character.skeleton.compute_rest_pose()
    bones = character.mapping.bones
    facing, ends = compute_facing(character), character.skeleton.compute_rest_ends()
    heads = {segment: position[chain[0]] @ facing for segment, chain in bones.items() if chain}
    tails = {segment: ends[chain[-1]] @ facing for segment, chain in bones.items() if chain}
    turns = _compute_segment_turns(heads, tails, has_feet_flat=character.has_feet_flat)
    segment_bones = {
        segment: chain[-1 if segment.partition("_")[2] in OUTER_BONE_SEGMENTS else 0] for segment, chain in bones.items() if chain
    }
    standard = {
        bone: turns.get(segment, np.eye(3)) @ facing.T @ rotation[bone]
        for segment, chain in (*bones.items(), *character.mapping.twists.items())
        for bone in chain
    }
    for side in hands:
        axes, hand = turns[f"{side}_hand"] @ facing.T, segment_bones[f"{side}_hand"]
        axes = fingers.compute_palm_roll(character, position @ axes.T, side) @ axes
        standard[hand] = axes @ rotation[hand]
        for name, finger in list_fingers(character, side).items():
            straight, _ = fingers.compute_straight_finger(side, finger)
            for bone, vector in zip(
                character.mapping.fingers[name], fingers.measure_finger(character, position, ends, name), strict=True
            ):
                standard[bone] = compute_shortest_rotation(axes @ vector, straight) @ axes @ rotation[bone]
    return BodyFrame(character, segment_bones, standard, position, ends, rotation, facing)


def list_fingers(character: Character, side: str) -> dict[str, str]:
    """Return the mapped fingers of a hand: such as left_index to index."""
    names = {f"{side}_{finger}": finger for finger in FINGERS}
    return {name: finger for name, finger in names.items() if name in character.mapping.fingers}


MIN_FINGER_MOTION = (
    1e-6  # difference of an element of a rotation relative to the hand from the rest pose, from which fingers move
)


def measure_hand_poses(
    character: Character, position: Float[np.ndarray, "T J 3"], rotation: Float[np.ndarray, "T J 3 3"]
) -> dict[str, HandPoses]:
    """Return the poses of the hands by side from places in metres and rotations of all bones, of hands whose fingers move."""
    mapping, rest = character.mapping, character.skeleton.compute_rest_pose()[1]
    sides = [side for side in SIDES if f"{side}_hand" in mapping.bones and list_fingers(character, side)]
    frame, found = build_body_frame(character, sides), dict[str, HandPoses]()
    for side in sides:
        hand, is_moving = frame.segment_bones[f"{side}_hand"], False
        palm = rotation[:, hand] @ frame.standard_rotations[hand].T
        posed, offsets = dict[str, np.ndarray](), dict[str, np.ndarray]()
        for name, finger in list_fingers(character, side).items():
            bones = list(mapping.fingers[name])
            relative = rotation[:, [hand]].swapaxes(-1, -2) @ rotation[:, bones]
            is_moving |= bool((np.abs(relative - rest[hand].T @ rest[bones]) > MIN_FINGER_MOTION).any())
            standard = np.stack([frame.standard_rotations[bone].T for bone in bones])
            posed[finger] = frame.standard_rotations[hand] @ relative @ standard
            above = palm[:, None] @ np.concatenate([np.tile(np.eye(3), (len(palm), 1, 1, 1)), posed[finger][:, :-1]], axis=1)
            vectors = np.diff(position[:, [hand, *bones]], axis=1)
            offsets[finger] = np.median(np.einsum("tnji,tnj->tni", above, vectors), axis=0)
        if is_moving:
            found[side] = HandPoses(palm, posed, position[:, hand], offsets)
    return found


def pose_fingers(
    frame: BodyFrame, side: str, palm: Float[np.ndarray, "T 3 3"], hand: HandPoses
) -> dict[int, Float[np.ndarray, "T 3 3"]]:
    """Return the world rotations of the bones of a hand's fingers, by bone, on a palm with these axes in the world."""
    posed: dict[int, np.ndarray] = {}
    for name, finger in list_fingers(frame.character, side).items():
        bones = frame.character.mapping.fingers[name]
        if (poses := fingers.fit_finger(hand, side, finger, len(bones))) is not None:
            posed |= {bone: palm @ poses[:, k] @ frame.standard_rotations[bone] for k, bone in enumerate(bones)}
    return posed


def compute_facing(character: Character) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about Y from axes that face +Z to the rest pose: its columns are the figure's left, up and front."""
    return compute_facings(character.skeleton.rest_positions[None], character.mapping.bones)[0]


def compute_facings(positions: Float[np.ndarray, "T J 3"], bones: Mapping[str, tuple[int, ...]]) -> Float[np.ndarray, "T 3 3"]:
    """Return the same rotations of poses in which the bones are at these positions."""
    left, right = (positions[:, [bones[f"{side}_{each}"][0] for each in ("thigh", "upper_arm")]].sum(1) for side in SIDES)
    leftward = left - right
    return Rotation.from_euler("y", np.arctan2(-leftward[:, 2], leftward[:, 0])[:, None]).as_matrix()


def _compute_segment_turns(
    heads: Mapping[str, Float[np.ndarray, " 3"]], tails: Mapping[str, Float[np.ndarray, " 3"]], *, has_feet_flat: bool
) -> dict[str, Float[np.ndarray, "3 3"]]:
    """Return the rotations of the limbs' segments from the rest pose, facing +Z, to the standard pose."""
    turns: dict[str, Float[np.ndarray, "3 3"]] = {}
    for side in SIDES:
        for start, end in LIMB_ENDS.items():
            vector = heads.get(f"{side}_{end}", tails[f"{side}_{start}"]) - heads[f"{side}_{start}"]
            turns[f"{side}_{start}"] = compute_shortest_rotation(np.nan_to_num(vector), LIMB_AXES[f"{side}_{start}"])
        turns[f"{side}_hand"] = turns[f"{side}_forearm"]
        turn = np.eye(3) if has_feet_flat else turns[f"{side}_shin"]
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
CHAIN_SEGMENTS = ("spine", "neck")  # segments of which every bone has a rotation of its own


@dataclass(frozen=True)
class SegmentMotion:
    """The segments of a body in every frame."""

    position: Mapping[str, Float[np.ndarray, "T 3"]]  # segment to where it begins, in metres
    # segment to S, from the segment's axes to the world's. "chest" is the outermost bone of the spine. A limb's segment points to
    # where the next one begins, also where the bones of its chain bend relative to each other
    rotation: Mapping[str, Float[np.ndarray, "T 3 3"]]
    # (T, n, 3, 3) by segment of several bones: of pelvis and spine; of chest, neck and head
    chains: Mapping[str, Float[np.ndarray, "T _ 3 3"]]

    def carry(self, segment: str, point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "T 3"]:
        """Return where a point is in the world that moves with a segment; it is relative to its beginning, in its axes."""
        return self.position[segment] + self.rotation[segment] @ point


def compute_segment_motion(frame: BodyFrame, motion: CharacterMotion) -> SegmentMotion:
    """Compute the segments of a character's body in every frame of its motion."""
    position, rotation = compute_character_poses(frame.character, motion)
    bones = frame.character.mapping.bones
    standard = {bone: rotation[:, bone] @ each.T for bone, each in frame.standard_rotations.items()}
    rotations = {segment: standard[bone] for segment, bone in frame.segment_bones.items()}
    spine, neck = ([standard[bone] for bone in bones.get(segment, ())] for segment in CHAIN_SEGMENTS)
    spine = [rotations["pelvis"], *spine]
    rotations["chest"] = spine[-1]
    neck = [rotations["chest"], *neck]
    neck.append(rotations.setdefault("head", neck[-1]))
    for side in SIDES:
        for segment in SIDE_SEGMENTS:
            parent = PARENT_SEGMENTS[segment]
            parent = parent if parent in ("chest", "pelvis") else f"{side}_{parent}"
            rotations.setdefault(f"{side}_{segment}", rotations[parent])
    positions = {segment: position[:, chain[0]] for segment, chain in bones.items() if chain}
    for segment, axis in LIMB_AXES.items():
        end = get_next_segment(segment)
        if len(bones[segment]) > 1 and end in positions:  # bones of a chain may bend relative to each other
            line, pointed = positions[end] - positions[segment], rotations[segment] @ axis
            rotations[segment] = compute_shortest_rotations(pointed, line) @ rotations[segment]
    return SegmentMotion(positions, rotations, {"spine": np.stack(spine, axis=1), "neck": np.stack(neck, axis=1)})


def fit_chain(source: BodyFrame, target: BodyFrame, segments: SegmentMotion, segment: str) -> Float[np.ndarray, "T _ 3 3"]:
    """Return the rotations of a target's spine or neck, as in `SegmentMotion.chains`, that bends like that of the source."""
    chain = segments.chains[segment]
    end_count = chain.shape[1] - len(source.character.mapping.bones.get(segment, ()))
    fitted = resample_chain(chain, len(target.character.mapping.bones.get(segment, ())) + end_count)
    if fitted.shape != chain.shape:
        offsets, source_offsets = target.compute_chain_offsets(segment), source.compute_chain_offsets(segment)
        fitted[:, 1:-1] = keep_chain_direction(source_offsets, chain[:, 1:-1], offsets, fitted[:, 1:-1])
    return fitted


def resample_chain(rotations: Float[np.ndarray, "T n 3 3"], count: int) -> Float[np.ndarray, "T m 3 3"]:
    """Return the rotations of a chain of `count` bones that bends like another, its first and last as they are.

    The rotations of a chain are those at equal distances along it; between two, the rotation turns about one axis.
    """
    last = rotations.shape[1] - 1
    if count == last + 1:
        return rotations
    if count == 1 or last == 0:
        return np.repeat(rotations[:, -1:], count, axis=1)
    places = np.arange(count) * last / (count - 1)
    low = np.minimum(places.astype(int), last - 1)
    between = np.swapaxes(rotations[:, low], 2, 3) @ rotations[:, low + 1]
    turns = [scale_rotations(between[:, k], share) for k, share in enumerate((places - low).tolist())]
    return rotations[:, low] @ np.stack(turns, axis=1)


def keep_chain_direction(
    source_offsets: Float[np.ndarray, "n 3"],
    source_rotations: Float[np.ndarray, "T n 3 3"],
    offsets: Float[np.ndarray, "m 3"],
    rotations: Float[np.ndarray, "T m 3 3"],
) -> Float[np.ndarray, "T m 3 3"]:
    """Return the rotations of a chain, turned together so that the chain points in the direction of another one.

    Offsets are from the beginning of each bone to that of the next, in its segment's axes, in metres.
    """
    if not len(offsets) or not len(source_offsets):
        return rotations
    wanted = np.einsum("tnij,nj->ti", source_rotations, source_offsets)
    rest = compute_shortest_rotation(source_offsets.sum(0), offsets.sum(0))
    reached = np.einsum("tnij,nj->ti", rotations, offsets @ rest)
    return compute_shortest_rotations(reached, wanted)[:, None] @ rotations
