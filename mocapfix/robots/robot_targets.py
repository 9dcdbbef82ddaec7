"""What a robot keeps of a performer: directions of limbs, rotations of trunk, head and feet, the path, and where feet stand.

The performer's segments (`characters.body_frames`) have Y up and face Z; those of robots have Z up and face X. Places are scaled
by the length of the legs, heights are above the floor without its slope: a robot walks up a ramp on the level.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.characters.body_frames import LIMB_AXES, BodyFrame, SegmentMotion
from mocapfix.characters.character import LIMB_ENDS
from mocapfix.characters.kept_positions import level_feet, measure_flat_feet
from mocapfix.contacts.contacts import FOOT_JOINTS, NO_FLOOR, BodyContacts
from mocapfix.robots.robot import SIDES, LinkPoint, Robot, RobotMap
from mocapfix.robots.robot_map import SOLE_SHARES, StandingRobot, stand_robot
from mocapfix.solve.trajectory import (
    BalanceTerm,
    FloorTerm,
    HingedTerms,
    HingedTree,
    LineTerm,
    LinkRotationTerm,
    PlaceTerm,
)
from mocapfix.stats.sequences import find_runs

ROBOT_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # from axes with Y up that face Z
DIRECTION_SD_RAD = 0.015  # of the limbs
HAND_SD_RAD = 0.1  # of the direction of a hand
ROTATION_SD_RAD = {"pelvis": 0.04, "trunk": 0.04, "head": 0.1, "foot": 0.12}
"""A waist that only turns shares a bend between pelvis and trunk. With 0.1 for the trunk, it turned away to keep arms off it: on
seven recordings of the training people by 4 (G1) and 12 degrees (T1), now by 2 and 8, with limbs 0.03 degrees farther off."""
PATH_SD_M = (0.05, 0.05, 0.03)  # of the middle of the hips about its scaled path
DEFAULT_SPEED_LIMIT = 12.0  # radians or metres per second, of joints whose file states none
FLOOR_SD_M = 0.001  # of a sole below the floor
CORNER_SD_M = 0.0015
"""Of the height of the corners of a sole in contact: a foot that cannot roll keeps its edges and tilts."""
COLLISION_DISTANCE_M, COLLISION_SD_M = 0.008, 0.001  # distance that primitives keep, and the standard deviation of a smaller one
FLOOR_SEARCH_SD_M, COLLISION_SEARCH_SD_M = 0.01, 0.02
"""The same while poses are still far. Without collisions in the search, hands end inside thighs in 2 % of an acrobat's frames."""

LIMB_MASSES = {
    ("upper_arm", "forearm"): (0.028, 0.436),
    ("forearm", "hand"): (0.022, 0.682),
    ("thigh", "shin"): (0.1, 0.433),
    ("shin", "foot"): (0.061, 0.606),
}
"""Shares of a person's mass in limbs (forearms with hands, shins with feet), and where their centres are between two joints."""
TRUNK_CENTRE = 0.66  # where that of the rest is, between hips and shoulders; both from Winter 2009, table 4.1
BALANCE_SD_M = 0.003
"""Of the centre of mass over feet that stand flat. On G1 in a walk it is outside of the soles in 54 % of the frames, with 0.01 in
80 % and without in 93 %; below 0.003 limbs and feet give way for little."""


@dataclass(frozen=True)
class Sole:
    """The sole of a foot: its edges are the middles between two corners each."""

    link: int
    corners: Float[np.ndarray, "4 3"]  # in the order of SOLE_CORNERS, in the link's axes, metres

    @property
    def edges(self) -> Float[np.ndarray, "2 3"]:
        """Heel and front."""
        return self.corners.reshape(2, 2, 3).mean(axis=1)

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Forward, left and up of the sole, as columns, in the link's axes."""
        forward = self.edges[1] - self.edges[0]
        leftward = self.corners[0] + self.corners[2] - self.corners[1] - self.corners[3]
        up = np.cross(forward, leftward)
        forward, up = forward / np.linalg.norm(forward), up / np.linalg.norm(up)
        return np.stack([forward, np.cross(up, forward), up], axis=1)


@dataclass(frozen=True)
class RobotBody:
    """A robot as the solve takes it."""

    robot: Robot
    map: RobotMap
    tree: HingedTree
    standing: StandingRobot  # upright
    soles: dict[str, Sole]

    @property
    def speed_limits(self) -> Float[np.ndarray, " N"]:
        """Largest speeds of the joints, DEFAULT_SPEED_LIMIT where no file states one."""
        return np.where(np.isfinite(self.robot.speed_limits), self.robot.speed_limits, DEFAULT_SPEED_LIMIT)

    @property
    def edge_links(self) -> Int[np.ndarray, " 4"]:
        """The links of heel and front of the left and the right sole."""
        return np.repeat([self.soles[side].link for side in SIDES], 2)

    @property
    def edge_offsets(self) -> Float[np.ndarray, "4 3"]:
        return np.concatenate([self.soles[side].edges for side in SIDES])

    @property
    def corner_links(self) -> Int[np.ndarray, " 8"]:
        return np.repeat([self.soles[side].link for side in SIDES], 4)

    @property
    def corner_offsets(self) -> Float[np.ndarray, "8 3"]:
        return np.concatenate([self.soles[side].corners for side in SIDES])

    @property
    def leg_length_m(self) -> float:
        """The length of thigh and shin."""
        lengths = [
            np.linalg.norm(self.standing.place(far) - self.standing.place(near))
            for name, (near, far) in self.map.limbs.items()
            if name.endswith(("thigh", "shin"))
        ]
        return float(np.sum(lengths)) / len(SIDES)

    @property
    def hip_centre(self) -> Float[np.ndarray, " 3"]:
        """The middle of the hips in the upright stance, relative to the root, with X ahead and Z up, in metres."""
        return np.mean([self.standing.place(self.map.limbs[f"{side}_thigh"][0]) for side in SIDES], axis=0)

    @property
    def ankle_height_m(self) -> float:
        """Height of the ends of the shins above flat soles."""
        ankles = [self.standing.place(self.map.limbs[f"{side}_shin"][1])[2] for side in self.soles]
        soles = [self.standing.place(LinkPoint(sole.link, sole.corners.mean(axis=0)))[2] for sole in self.soles.values()]
        return float(np.mean(ankles) - np.mean(soles))


def build_robot_body(robot: Robot, robot_map: RobotMap) -> RobotBody:
    """Return a robot as the solve takes it."""
    soles = {side: Sole(robot_map.feet[side], robot_map.soles[side]) for side in SIDES}
    standing = stand_robot(robot, robot_map.standing)
    return RobotBody(robot, robot_map, standing.tree, standing, soles)


@dataclass(frozen=True)
class RobotTargets:
    """The terms of T frames, and what the search for a start and for places to stand needs."""

    terms: HingedTerms
    rate: float
    hips: Float[np.ndarray, "T 3"]  # scaled path of the middle of the hips, metres
    pelvis: Float[np.ndarray, "T 3 3"]  # rotations of the pelvis from the upright stance
    # side, and 0 for the heel or 1 for the front, to first and last frames
    contacts: dict[tuple[str, int], list[tuple[int, int]]]
    heights: Float[np.ndarray, "T 2"]  # of the level under each foot, scaled, metres

    def loosen(self) -> "RobotTargets":
        """Return the targets of a search: soles may sink and parts may meet a little."""
        floor = self.terms.floor._replace(weight=FLOOR_SEARCH_SD_M**-2)
        collision = self.terms.collision._replace(weight=COLLISION_SEARCH_SD_M**-2)
        return replace(self, terms=self.terms._replace(floor=floor, collision=collision))

    def isolate_collisions(self) -> HingedTerms:
        """Return terms whose cost is half the sum of the squared depths of parts that overlap, in square metres."""
        place, floor, line, rotation, collision, balance = self.terms
        return HingedTerms(
            place._replace(weights=np.zeros_like(place.weights)),
            floor._replace(weight=0.0),
            line._replace(weights=np.zeros_like(line.weights)),
            rotation._replace(weights=np.zeros_like(rotation.weights)),
            collision._replace(distance=0.0, weight=1.0),
            balance._replace(weights=np.zeros_like(balance.weights)),
        )

    def select_frames(self, frames: slice) -> HingedTerms:
        """Return the terms of some frames."""
        place, line, rotation, balance = self.terms.place, self.terms.line, self.terms.rotation, self.terms.balance
        return self.terms._replace(
            place=place._replace(places=place.places[frames], weights=place.weights[frames]),
            line=line._replace(directions=line.directions[frames], weights=line.weights[frames]),
            rotation=rotation._replace(rotations=rotation.rotations[frames], weights=rotation.weights[frames]),
            balance=balance._replace(places=balance.places[frames], weights=balance.weights[frames]),
        )


def compute_robot_targets(
    body: RobotBody, source: BodyFrame, motion: SegmentMotion, contacts: BodyContacts | None, rate: float,
    is_solved: Bool[np.ndarray, " J"] | None = None,
) -> RobotTargets:  # fmt: skip
    """Return what a robot keeps of a performer.

    Args:
        body: The robot.
        source: The performer.
        motion: The performer's segments, Y up, over T frames.
        contacts: At the same rate; without them feet stand nowhere.
        rate: Frames per second.
        is_solved: The performer's joints that the take shows, None for all. Limbs whose ends it does not show are left free.
    """
    flat_feet = measure_flat_feet(source, motion, contacts)
    motion = level_feet(motion, flat_feet)
    floor = NO_FLOOR if contacts is None else contacts.floor
    scale, count = body.leg_length_m / source.leg_length_m, len(motion.rotation["pelvis"])
    hips = np.mean([motion.position[f"{side}_thigh"] for side in SIDES], axis=0)
    ankle_m = np.mean([flat.compute_ankle_height(source.compute_ball(side)) for side, flat in flat_feet.items()])
    path = scale * np.stack([hips[:, 2], hips[:, 0], floor.remove_slope(hips) - floor.height_m - ankle_m], axis=1)
    path[:, 2] += body.ankle_height_m
    balls = {side: motion.carry(f"{side}_foot", source.compute_ball(side)) for side in SIDES}
    levels = [floor.remove_slope(ball) - floor.height_m - floor.compute_height_above(ball) for ball in balls.values()]
    runs = {
        (side, end): find_runs(contacts.is_contact[:, contacts.joints.index(joint)]) if contacts is not None else []
        for side, joints in FOOT_JOINTS.items()
        for end, joint in enumerate(joints)
    }
    pelvis = _convert_rotations(motion.rotation["pelvis"])
    terms = HingedTerms(
        _build_place_term(body, path),
        _build_floor_term(body),
        _build_line_term(body, source, motion, is_solved),
        _build_rotation_term(body, motion, count),
        body.robot.collision._replace(distance=COLLISION_DISTANCE_M, weight=COLLISION_SD_M**-2),
        _build_balance_term(body, source, motion, contacts, scale),
    )
    return RobotTargets(terms, rate, path, pelvis, runs, scale * np.stack(levels, axis=1))


def _convert_rotations(rotation: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Return the rotations of a segment from the standard pose in a robot's axes."""
    return ROBOT_AXES @ rotation @ ROBOT_AXES.T


def _build_place_term(body: RobotBody, path: Float[np.ndarray, "T 3"]) -> PlaceTerm:
    """Return the path of the hips, and then the edges and the corners of the soles, which stand nowhere yet."""
    turn, links = body.standing.rotations[body.map.pelvis], np.array([body.map.pelvis, *body.edge_links, *body.corner_links])
    centre = turn.T @ (body.hip_centre - body.standing.place(LinkPoint(body.map.pelvis, np.zeros(3))))
    offsets = np.concatenate([centre[None], body.edge_offsets, body.corner_offsets])
    places, weights = np.zeros((2, len(path), len(links), 3))
    places[:, 0], weights[:, 0] = path, np.array(PATH_SD_M) ** -2
    return PlaceTerm(links, offsets, places, weights)


def _build_line_term(
    body: RobotBody, source: BodyFrame, motion: SegmentMotion, is_solved: Bool[np.ndarray, " J"] | None
) -> LineTerm:
    links: list[tuple[int, int]] = []
    offsets: list[tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]] = []
    segments: list[str] = []
    for segment, (near, far) in body.map.limbs.items():
        links.append((near.link, far.link))
        offsets.append((near.position, far.position))
        segments.append(segment)
    for side, link in body.map.hands.items():  # a hand points along the forearm in the upright stance
        near, far = (body.standing.place(point) for point in body.map.limbs[f"{side}_forearm"])
        along = body.standing.rotations[link].T @ (far - near)
        links.append((link, link))
        offsets.append((np.zeros(3), along / np.linalg.norm(along)))
        segments.append(f"{side}_hand")
    axes = LIMB_AXES | {f"{side}_hand": LIMB_AXES[f"{side}_forearm"] for side in SIDES}
    directions = np.stack([motion.rotation[segment] @ axes[segment] @ ROBOT_AXES.T for segment in segments], axis=1)
    sd = np.array([HAND_SD_RAD if segment.endswith("hand") else DIRECTION_SD_RAD for segment in segments])
    if is_solved is not None:
        bones, parts = source.character.mapping.bones, [segment.partition("_") for segment in segments]
        ends = [(*bones["".join(part)][1:], *bones[f"{part[0]}_{LIMB_ENDS.get(part[2], part[2])}"])[0] for part in parts]
        sd[~is_solved[ends]] = np.inf
    weights = np.tile(sd**-2.0, (len(directions), 1))
    return LineTerm(np.array(links), np.array(offsets), np.ascontiguousarray(directions), weights)


def _build_rotation_term(body: RobotBody, motion: SegmentMotion, count: int) -> LinkRotationTerm:
    links = {"pelvis": body.map.pelvis, "trunk": body.map.trunk, "head": body.map.head}
    if body.map.head == body.map.trunk:
        del links["head"]
    segments = {"pelvis": "pelvis", "trunk": "chest", "head": "head"}
    rotations = [
        _convert_rotations(motion.rotation[segments[part]]) @ body.standing.rotations[link] for part, link in links.items()
    ]
    sd = [ROTATION_SD_RAD[part] for part in links]
    for side, sole in body.soles.items():
        rotations.append(_convert_rotations(motion.rotation[f"{side}_foot"]) @ sole.axes.T)
        sd.append(ROTATION_SD_RAD["foot"])
    joints = np.array([*links.values(), *(sole.link for sole in body.soles.values())])
    return LinkRotationTerm(joints, np.ascontiguousarray(np.stack(rotations, axis=1)), np.tile(np.array(sd) ** -2, (count, 1)))


def _build_floor_term(body: RobotBody) -> FloorTerm:
    """Return soles above the floor, and the primitives of the other links."""
    each = body.robot.collision
    is_body = ~np.isin(each.links, [sole.link for sole in body.soles.values()])
    links = np.concatenate([body.corner_links, np.repeat(each.links[is_body], 2)])
    offsets = np.concatenate([body.corner_offsets, each.ends[is_body].reshape(-1, 3)])
    heights = np.concatenate([np.zeros(len(body.corner_links)), np.repeat(each.radii[is_body], 2)])
    return FloorTerm(links, offsets, heights, FLOOR_SD_M**-2)


def _build_balance_term(
    body: RobotBody, source: BodyFrame, motion: SegmentMotion, contacts: BodyContacts | None, scale: float
) -> BalanceTerm:
    """Return where the scaled centre of mass of the performer is from the middle of the edges in contact; nothing weighs yet."""
    links, count = np.flatnonzero(body.robot.masses), len(motion.rotation["pelvis"])
    places = np.zeros((count, 2))
    if contacts is not None and (edges := contacts.select_feet().is_contact).any():
        middle = (place_soles(source, motion).reshape(count, 4, 2, 3).mean(axis=2) * edges[..., None]).sum(axis=1)
        middle /= np.maximum(edges.sum(axis=1), 1)[:, None]
        places = scale * ((compute_mass_centre(motion) - middle) @ ROBOT_AXES.T)[:, :2]
    shares = body.robot.masses[links] / body.robot.masses.sum()
    return BalanceTerm(links, body.robot.mass_centres[links], shares, np.ascontiguousarray(places), np.zeros(count))


def place_soles(source: BodyFrame, segments: SegmentMotion) -> Float[np.ndarray, "T 8 3"]:
    """Return the corners of a person's soles, which have usual sizes, in the order of `RobotBody.corner_links`, in metres."""
    sole = source.leg_length_m * np.array([(y, 0.0, x) for x in SOLE_SHARES[:2] for y in SOLE_SHARES[2:]])
    return np.stack([segments.carry(f"{side}_foot", corner) for side in SIDES for corner in sole], axis=1)


def compute_mass_centre(segments: SegmentMotion) -> Float[np.ndarray, "T 3"]:
    """Return a person's centre of mass by mean shares of segments, in metres."""
    hips, shoulders = (np.mean([segments.position[f"{s}_{each}"] for s in SIDES], axis=0) for each in ("thigh", "upper_arm"))
    total = (1.0 - 2.0 * sum(mass for mass, _ in LIMB_MASSES.values())) * (hips + TRUNK_CENTRE * (shoulders - hips))
    for (near, far), (mass, share) in LIMB_MASSES.items():
        for side in SIDES:
            start, end = segments.position[f"{side}_{near}"], segments.position[f"{side}_{far}"]
            total = total + mass * (start + share * (end - start))
    return total


def stand_feet(body: RobotBody, targets: RobotTargets, edges: Float[np.ndarray, "T 4 3"], standing_sd_m: float) -> RobotTargets:
    """Return the targets with places for the soles in contact.

    Heel and front of a foot that are in contact together are a sole's length apart. So a foot that rolls from the heel to the
    front stays where it is, and one that turns on its front sets the heel down elsewhere.

    Args:
        body: The robot.
        targets: Its targets; the place term has the edges of the soles after the hips, then the corners.
        edges: Where the edges are in a motion near to the one wanted, as `RobotBody.edge_links`, in metres.
        standing_sd_m: Of the edges of a sole in contact.
    """
    term = targets.terms.place
    places, weights = term.places.copy(), term.weights.copy()
    for k, side in enumerate(SIDES):
        length, found = np.linalg.norm(np.diff(body.soles[side].edges, axis=0)), dict[tuple[int, int, int], np.ndarray]()
        runs = sorted((first, last, end) for end in (0, 1) for first, last in targets.contacts[side, end])
        for first, last, end in runs:
            together = [(min(last, other[1]) - max(first, other[0]), other) for other in found if other[2] != end]
            overlap, other = max(together, default=(-1, (0, 0, 0)))
            if overlap < 0:
                place = edges[first : last + 1, 2 * k + end, :2].mean(axis=0)
            else:
                both = slice(max(first, other[0]), min(last, other[1]) + 1)
                forward = (edges[both, 2 * k + 1, :2] - edges[both, 2 * k, :2]).mean(axis=0)
                place = found[other] + (2 * end - 1) * length * forward / np.linalg.norm(forward)
            found[first, last, end] = place
            run, height = slice(first, last + 1), float(np.median(targets.heights[first : last + 1, k]))
            places[run, 1 + 2 * k + end] = [*place, height]
            weights[run, 1 + 2 * k + end] = standing_sd_m**-2
            corners = 5 + 4 * k + 2 * end + np.arange(2)
            places[run, corners, 2], weights[run, corners, 2] = height, CORNER_SD_M**-2
    is_standing, balance = weights[:, 1:5, 0] > 0.0, targets.terms.balance
    if body.map.keeps_balance:
        middle = (places[:, 1:5, :2] * is_standing[..., None]).sum(axis=1) / np.maximum(is_standing.sum(axis=1), 1)[:, None]
        is_flat = (is_standing[:, ::2] & is_standing[:, 1::2]).any(axis=1)
        balance = balance._replace(places=balance.places + middle, weights=is_flat / BALANCE_SD_M**2)
    place = term._replace(places=places, weights=weights)
    return replace(targets, terms=targets.terms._replace(place=place, balance=balance))
