"""Which links of a robot form its body: found by structure, or read from YAML.

A robot stands upright and looks along X at zero angles. Its joints form a tree: those whose subtree has ends on both sides are
central, and each tree of joints beside these is a limb. The lowest of a side is the leg, the one of the others that reaches
farthest is the arm.

- A knee is the joint about a lateral axis that is farthest from both ends of the leg; an elbow likewise about an axis across the
  arm.
- A thigh or upper arm begins at the last joint before it whose axis is across it. The anchor of that joint may be anywhere on its
  axis: where the axis about which the limb twists is along the limb, the point nearest to that axis counts.
- A shin ends at the ankle; a forearm at the wrist, at the last of its joints across it, or where the arm ends.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress, product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import yaml
from jaxtyping import Float, Int
from pydantic import Field
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.io.files import replace_atomically
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.robots.robot import LIMBS, SIDES, LinkPoint, Robot, RobotMap
from mocapfix.solve.trajectory import ROOT_UNKNOWNS, HingedTree, place_points

MIN_SIDE_M = 0.02  # distance from the middle from which the end of a limb is on a side
MIN_LATERAL_COSINE = 0.8  # between the axis of a knee and the lateral axis
MAX_ACROSS_COSINE = 0.7  # between a limb and the axis of a joint across it
MIN_ALONG_COSINE = 0.99  # between a limb and the axis about which it twists, from which this axis is in the middle of the limb
WRIST_EXTENT_M = 0.05  # largest distance between the joints of one wrist
MAX_HEEL_SHARE = 0.05  # of twice the length of a sole: so far its middle may be behind the ankle
MIN_LIMB_M, MIN_SOLE_M2 = 0.01, 1e-4  # smallest length of a limb, and area of a sole times four
ANKLE_SHARE, SOLE_SHARES = 0.07, (-0.11, 0.21, -0.06, 0.06)
"""Height of an ankle, heel, front and sides of a sole about it, over the length from hip to ankle: as five robots have them."""
ROTATION_Z_UP_Y_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # from axes with Y up and Z ahead
SOLE_DEPTH_M = 0.008  # height above the lowest point of a foot up to which points belong to the sole


def build_hinged_tree(robot: Robot) -> HingedTree:
    """Return the links and joints as the kernels take them; joints that follow others have their unknowns."""
    count, place = len(robot.joint_names), {joint: k for k, joint in enumerate(list_leaders(robot).tolist())}
    followed = {follower: (leader, offset, factor) for follower, leader, offset, factor in robot.couplings}
    unknowns = np.array([place[followed[joint][0] if joint in followed else joint] for joint in range(count)], int)
    factors = np.array([followed[joint][2] if joint in followed else 1.0 for joint in range(count)])
    offsets = np.array([followed[joint][1] if joint in followed else 0.0 for joint in range(count)])
    first = np.searchsorted(robot.joint_links, np.arange(len(robot.parents) + 1))
    paths, lengths = np.zeros((len(robot.parents), max(count, 1)), int), np.zeros(len(robot.parents), int)
    for link, parent in enumerate(robot.parents):
        joints = [*paths[parent, : lengths[parent]], *range(first[link], first[link + 1])] if parent >= 0 else []
        paths[link, : len(joints)], lengths[link] = joints, len(joints)
    arrays = robot.link_positions, robot.link_rotations, robot.joint_axes, robot.joint_anchors
    positions, rotations, axes, anchors = map(np.ascontiguousarray, arrays)
    return HingedTree(
        robot.parents, positions, rotations, first, axes, anchors, robot.is_slide, unknowns, factors,
        offsets - robot.zero_positions, paths, lengths,
    )  # fmt: skip


def list_leaders(robot: Robot) -> Int[np.ndarray, " U"]:
    """Return the joint that each unknown is the position of: those that follow no other."""
    return np.setdiff1d(np.arange(len(robot.joint_names)), [follower for follower, *_ in robot.couplings])


@dataclass(frozen=True)
class StandingRobot:
    """A robot at joint positions; the root is at the origin, with the axes that it has in `Robot.link_rotations`."""

    robot: Robot
    tree: HingedTree
    standing: Float[np.ndarray, " N"]
    positions: Float[np.ndarray, "L 3"]
    rotations: Float[np.ndarray, "L 3 3"]

    @property
    def parents(self) -> list[int]:
        """The joint before each joint, -1 if there is none."""
        tree, parents = self.tree, list[int]()
        for joint, link in enumerate(self.robot.joint_links):
            path = tree.paths[link, : tree.path_lengths[link]].tolist()
            before = path[: path.index(joint)]
            parents.append(before[-1] if before else -1)
        return parents

    def place(self, point: LinkPoint) -> Float[np.ndarray, " 3"]:
        return self.positions[point.link] + self.rotations[point.link] @ point.position

    def attach(self, link: int, place: Float[np.ndarray, " 3"]) -> LinkPoint:
        """Return the point of a link that is at a place."""
        return LinkPoint(link, self.rotations[link].T @ (place - self.positions[link]))

    def find_anchor(self, joint: int) -> Float[np.ndarray, " 3"]:
        link = int(self.robot.joint_links[joint])
        return self.place(LinkPoint(link, self.robot.joint_anchors[joint]))

    def find_axis(self, joint: int) -> Float[np.ndarray, " 3"]:
        return self.rotations[self.robot.joint_links[joint]] @ self.robot.joint_axes[joint]

    def list_fixed_links(self, link: int) -> list[int]:
        """Return a link and those that are fixed to it."""
        fixed = [link]
        for each in range(link + 1, len(self.robot.parents)):
            if self.robot.parents[each] in fixed and each not in self.robot.joint_links:
                fixed.append(each)
        return fixed

    def list_points(self, link: int) -> Float[np.ndarray, "P 3"]:
        """Return the ends of the capsules of a link and of those fixed to it, and the origins of the latter."""
        links, collision = self.list_fixed_links(link), self.robot.collision
        points = [self.positions[each] for each in links[1:]]
        for capsule in np.flatnonzero(np.isin(collision.links, links)):
            points += [self.place(LinkPoint(int(collision.links[capsule]), end)) for end in collision.ends[capsule]]
        return np.array(points).reshape(-1, 3)


def stand_robot(robot: Robot, positions: Float[np.ndarray, " N"]) -> StandingRobot:
    """Return a robot at joint positions, or at the nearest within their limits."""
    tree, count = build_hinged_tree(robot), len(robot.parents)
    standing = np.clip(positions, *robot.limits.T)
    unknowns = np.concatenate([np.zeros(ROOT_UNKNOWNS), standing[list_leaders(robot)]])[None]
    places, rotations = place_points(tree, robot.link_rotations[:1], unknowns, np.arange(count), np.zeros((count, 3)))
    return StandingRobot(robot, tree, standing, places[0], rotations[0])


def turn_upright(robot: Robot, find: Callable[[Robot], RobotMap]) -> tuple[Robot, RobotMap]:
    """Return a robot with a root that is turned so that it stands upright and looks along X, and its body, which `find` returns.

    The axes of the root are tried, those that the file gives it in the world, and roots with Y up, each with four headings.

    Raises:
        SceneError: As `find` does for a root that is not turned, if no root fits.
    """
    errors = list[SceneError]()
    for heading, axes in product(range(4), (np.eye(3), robot.link_rotations[0], ROTATION_Z_UP_Y_UP)):
        root = Rotation.from_euler("z", heading * np.pi / 2).as_matrix() @ axes
        turned = replace(robot, link_rotations=np.concatenate([root[None], robot.link_rotations[1:]]))
        try:
            found = find(turned)
            note = " The axes of its root are not X ahead and Z up." * bool(errors)
            return turned, replace(found, reason=found.reason + note)
        except SceneError as error:
            errors.append(error)
    raise errors[0]


def find_robot_map(robot: Robot) -> RobotMap:
    """Find the body of a robot by structure.

    Raises:
        SceneError: If it has not two legs with knees and two arms with elbows, or does not look along X.
    """
    body = stand_robot(robot, np.zeros(len(robot.joint_names)))
    limbs, neck_joints = _find_limbs(body)
    points: dict[str, tuple[LinkPoint, LinkPoint]] = {}
    feet, soles, hands, is_usual = dict[str, int](), dict[str, Float[np.ndarray, "4 3"]](), dict[str, int](), False
    for side in SIDES:
        leg, arm = limbs[f"{side}_leg"], limbs[f"{side}_arm"]
        feet[side] = int(robot.joint_links[leg[-1]])
        soles[side], is_usual = _find_sole(body, feet[side], leg)
        sole_centre = body.place(LinkPoint(feet[side], soles[side].mean(axis=0)))
        points |= _find_leg(body, side, leg, sole_centre)
        arm_points, hand = _find_arm(body, side, arm)
        points |= arm_points
        if hand is not None:
            hands[side] = hand
    pelvis, trunk = (_find_base_link(body, limbs[f"{SIDES[0]}_{limb}"][0]) for limb in ("leg", "arm"))
    heads = [link for link in robot.joint_links[neck_joints].tolist() if trunk in _list_above(robot, link)]
    head = max(heads, key=lambda link: (round(float(body.positions[link][2]), 3), link), default=trunk)
    reason = "Found by the structure of the robot."
    if is_usual:
        reason += " Its feet have no shapes of soles: these are of a usual size; measure them and edit the map."
    found = RobotMap(points, feet, soles, pelvis, trunk, head, hands, body.standing, reason)
    _check_map(body, found, robot.name)
    return found


def _check_map(body: StandingRobot, found: RobotMap, source: str) -> None:
    """Raise SceneError if a limb has no direction, or if a sole is not flat and ahead, in the axes of the root."""
    for name, (near, far) in found.limbs.items():
        length_m = float(np.linalg.norm(body.place(far) - body.place(near)))
        if near.link not in _list_above(body.robot, far.link) or length_m < MIN_LIMB_M:
            raise SceneError(f"{source}: {name} must run from a point to another one, of the same link or one below it.")
    for side in SIDES:
        heel_left, heel_right, toe_left, toe_right = found.soles[side] @ body.rotations[found.feet[side]].T
        forward, leftward = toe_left + toe_right - heel_left - heel_right, heel_left + toe_left - heel_right - toe_right
        if np.cross(forward, leftward)[2] < MIN_SOLE_M2:
            raise SceneError(f"{source}: the corners of the {side} sole must be those of heel and toe, left before right.")
        ankle = body.place(found.limbs[f"{side}_shin"][1]) - body.positions[found.feet[side]]
        ahead_m = float(np.mean([heel_left, heel_right, toe_left, toe_right], axis=0)[0] - ankle[0])
        if forward[0] <= abs(forward[1]) or ahead_m < -MAX_HEEL_SHARE * forward[0]:
            raise SceneError(f"{source}: the {side} foot must point along X in the axes of the root, as the robot looks.")


def _list_above(robot: Robot, link: int) -> list[int]:
    """Return the links from a link to the root."""
    links = [link]
    while robot.parents[links[-1]] >= 0:
        links.append(int(robot.parents[links[-1]]))
    return links


def _find_base_link(body: StandingRobot, joint: int) -> int:
    """Return the link that carries a limb: that of the joint before its first one, with what is fixed to it, or the root."""
    before = body.parents[joint]
    return int(body.robot.joint_links[before]) if before >= 0 else 0


def _find_limbs(body: StandingRobot) -> tuple[dict[str, list[int]], list[int]]:
    """Return the joints of legs and arms from the trunk outwards, and those that move only what is in the middle."""
    robot, parents = body.robot, body.parents
    children = {joint: [k for k, parent in enumerate(parents) if parent == joint] for joint in range(-1, len(parents))}
    sides: dict[int, set[str]] = {}
    for joint in reversed(range(len(parents))):
        if children[joint]:
            sides[joint] = set[str]().union(*(sides[child] for child in children[joint]))
        else:
            tip = np.vstack([body.find_anchor(joint)[None], body.list_points(int(robot.joint_links[joint]))])[:, 1].mean()
            sides[joint] = {"left"} if tip > MIN_SIDE_M else {"right"} if tip < -MIN_SIDE_M else {"middle"}
    is_limb = [len(sides[joint]) == 1 and "middle" not in sides[joint] for joint in range(len(parents))]
    found: dict[str, list[int]] = {}
    for side in SIDES:
        starts = [
            j for j in range(len(parents)) if is_limb[j] and side in sides[j] and (parents[j] < 0 or not is_limb[parents[j]])
        ]
        chains: list[list[int]] = []
        for start in starts:
            chain = [start]
            while len(children[chain[-1]]) == 1:
                chain.append(children[chain[-1]][0])
            chains.append(chain)
        chains = [chain for chain in chains if len(chain) > 1]
        if len(chains) < 2:
            raise SceneError(
                f"{robot.name}: found no arm and leg on the {side}; a robot has both and looks along X, or give --character-map."
            )
        leg = min(chains, key=lambda chain: body.find_anchor(chain[-1])[2])
        arms = [chain for chain in chains if chain is not leg]
        reach = [float(np.linalg.norm(body.find_anchor(chain[-1]) - body.find_anchor(chain[0]))) for chain in arms]
        found |= {f"{side}_leg": leg, f"{side}_arm": arms[int(np.argmax(reach))]}
    return found, [joint for joint in range(len(parents)) if sides[joint] == {"middle"}]


def _find_middle_joint(body: StandingRobot, chain: Sequence[int], end: Float[np.ndarray, " 3"], is_bend: Sequence[bool]) -> int:
    """Return the place in a limb of the bending joint that is farthest from both of its ends."""
    start = body.find_anchor(chain[0])
    places = np.array([body.find_anchor(joint) for joint in chain])
    distance = np.where(is_bend, np.minimum(*(np.linalg.norm(places - each, axis=1) for each in (start, end))), -1.0)
    if distance.max() <= 0:
        raise SceneError(
            f"{body.robot.name}: no knee or elbow was found after {body.robot.joint_names[chain[0]]}; give --character-map."
        )
    return int(np.argmax(distance))


def _find_start(body: StandingRobot, chain: Sequence[int], middle: Float[np.ndarray, " 3"]) -> LinkPoint:
    """Return where the first segment of a limb begins, from the joints before its knee or elbow."""
    across = [joint for joint in chain if _is_across(body, joint, middle - body.find_anchor(joint))] or list(chain[:1])
    last = across[-1]
    anchor, axis = body.find_anchor(last), body.find_axis(last)
    for joint in chain[list(chain).index(last) + 1 :]:
        along, line = body.find_axis(joint), middle - body.find_anchor(joint)
        if abs(along @ line) > MIN_ALONG_COSINE * np.linalg.norm(line) and abs(axis @ along) < MAX_ACROSS_COSINE:
            apart = body.find_anchor(joint) - anchor  # the point of the axis nearest to the axis of the twist
            product = axis @ along
            anchor = anchor + (apart @ axis - product * (apart @ along)) / (1.0 - product**2) * axis
            break
    return body.attach(int(body.robot.joint_links[last]), anchor)


def _is_across(body: StandingRobot, joint: int, line: Float[np.ndarray, " 3"]) -> bool:
    """Return whether a joint turns a line, other than about itself."""
    length = float(np.linalg.norm(line))
    return (
        length > 1e-6 and not body.robot.is_slide[joint] and abs(float(body.find_axis(joint) @ line)) < MAX_ACROSS_COSINE * length
    )


def _find_leg(
    body: StandingRobot, side: str, chain: Sequence[int], sole: Float[np.ndarray, " 3"]
) -> dict[str, tuple[LinkPoint, LinkPoint]]:
    lateral = [abs(float(body.find_axis(joint)[1])) > MIN_LATERAL_COSINE for joint in chain]
    knee = _find_middle_joint(body, chain, sole, lateral)
    below = [*compress(chain[knee + 1 :], lateral[knee + 1 :]), *chain[knee + 1 :]]
    ankle = body.find_anchor(below[0]) if below else sole
    shin_link, knee_place = int(body.robot.joint_links[chain[knee]]), body.find_anchor(chain[knee])
    start = _find_start(body, chain[:knee], knee_place)
    return {
        f"{side}_thigh": (start, body.attach(shin_link, knee_place)),
        f"{side}_shin": (body.attach(shin_link, knee_place), body.attach(shin_link, ankle)),
    }


def _find_arm(body: StandingRobot, side: str, chain: Sequence[int]) -> tuple[dict[str, tuple[LinkPoint, LinkPoint]], int | None]:
    """Return the segments of an arm, and the link of the hand if joints move it."""
    last_link = int(body.robot.joint_links[chain[-1]])
    points = body.list_points(last_link)
    far = np.linalg.norm(points - body.find_anchor(chain[-1]), axis=1)
    tip = points[int(np.argmax(far))] if len(points) else body.find_anchor(chain[-1])
    bends = [
        k > 0 and _is_across(body, joint, body.find_anchor(joint) - body.find_anchor(chain[0])) for k, joint in enumerate(chain)
    ]
    elbow = _find_middle_joint(body, chain, tip, bends)
    place = body.find_anchor(chain[elbow])
    wrists = [joint for joint in chain[elbow + 1 :] if _is_across(body, joint, body.find_anchor(joint) - place)]
    wrists = [joint for joint in wrists if np.linalg.norm(body.find_anchor(joint) - body.find_anchor(wrists[0])) < WRIST_EXTENT_M]
    forearm_link = int(body.robot.joint_links[chain[elbow]])
    fixed = body.positions[body.list_fixed_links(last_link)[1:]]
    ends = fixed[np.linalg.norm(fixed - body.find_anchor(chain[-1]), axis=1) > WRIST_EXTENT_M]
    if not wrists and len(ends):
        tip = ends[-1]
    elif not wrists:  # shapes may be short or beside the arm: it points to the centre of mass of its last part
        links = body.list_fixed_links(last_link)
        centres = np.array([body.place(LinkPoint(link, body.robot.mass_centres[link])) for link in links])
        centre = np.average(centres, axis=0, weights=body.robot.masses[links])
        tip = place + (centre - place) * np.linalg.norm(tip - place) / np.linalg.norm(centre - place)
    end_link = int(body.robot.joint_links[wrists[-1]]) if wrists else last_link
    end = body.attach(end_link, body.find_anchor(wrists[-1]) if wrists else tip)
    start = _find_start(body, chain[:elbow], place)
    limbs = {
        f"{side}_upper_arm": (start, body.attach(forearm_link, place)),
        f"{side}_forearm": (body.attach(forearm_link, place), end),
    }
    return limbs, (last_link if wrists else None)


def _find_sole(body: StandingRobot, foot: int, leg: Sequence[int]) -> tuple[Float[np.ndarray, "4 3"], bool]:
    """Return the corners of a rectangle about the lowest points of a foot's shapes, or of usual size without such, and which."""
    links, collision = body.list_fixed_links(foot), body.robot.collision
    points: list[Float[np.ndarray, " 3"]] = []
    is_box = np.isin(collision.box_links, links)
    for box in np.flatnonzero(is_box):
        for signs in np.ndindex(2, 2, 2):
            corner = collision.box_centres[box] + collision.box_rotations[box] @ (
                collision.box_halves[box] * (2.0 * np.array(signs) - 1.0)
            )
            points.append(body.place(LinkPoint(int(collision.box_links[box]), corner)))
    for capsule in np.flatnonzero(np.isin(collision.links, links)) if not is_box.any() else ():
        for end in collision.ends[capsule]:
            place = body.place(LinkPoint(int(collision.links[capsule]), end))
            points.append(place - [0.0, 0.0, collision.radii[capsule]])
    if len(points) < 3:
        outline = [(link, corners) for link, corners in body.robot.outline if link in links]
        points = [body.place(LinkPoint(link, corner)) for link, corners in outline for corner in corners]
    if is_usual := len(points) < 3:
        ankle, leg_m = body.positions[foot], float(np.linalg.norm(body.positions[foot] - body.find_anchor(leg[0])))
        lowest = min(float(body.positions[link, 2]) for link in links)
        lowest = lowest if lowest < ankle[2] - 0.5 * ANKLE_SHARE * leg_m else float(ankle[2]) - ANKLE_SHARE * leg_m
        bends = [np.clip(body.robot.limits[joint], -np.pi, np.pi).sum() * body.find_axis(joint)[1] for joint in leg]
        ahead_m = leg_m if max(bends, key=abs) >= 0.0 else -leg_m  # a knee bends backwards
        shares = [(x, y) for x in SOLE_SHARES[:2] for y in SOLE_SHARES[2:]]
        points = [np.array([ankle[0] + x * ahead_m, ankle[1] + y * leg_m, lowest]) for x, y in shares]
    found = np.array(points)
    lowest = found[:, 2].min()
    low, high = (choose(found[found[:, 2] < lowest + SOLE_DEPTH_M, :2], axis=0) for choose in (np.min, np.max))
    corners = np.array([(low[0], high[1], lowest), (low[0], low[1], lowest), (*high, lowest), (high[0], low[1], lowest)])
    return np.array([body.attach(foot, corner).position for corner in corners]), is_usual


Side = Literal["left", "right"]
Coordinates = Annotated[list[float], Field(min_length=3, max_length=3)]


class PointFile(StrictModel):
    """A point of a link, in its axes, metres."""

    link: str
    position: Coordinates = Field(default_factory=lambda: [0.0, 0.0, 0.0])


class FootFile(StrictModel):
    """A foot: the corners of its sole are heel left, heel right, toe left, toe right."""

    link: str
    sole: Annotated[list[Coordinates], Field(min_length=4, max_length=4)]


class RobotMapFile(StrictModel):
    """The content of a file with the body of a robot."""

    pelvis: str
    trunk: str
    head: str
    hands: dict[Side, str] = Field(default_factory=dict)
    limbs: dict[str, Annotated[list[PointFile], Field(min_length=2, max_length=2)]]
    feet: dict[Side, FootFile]
    standing: dict[str, float] = Field(default_factory=dict)  # joint positions that are not zero
    keeps_balance: bool = False


def read_robot_map(path: Path, robot: Robot) -> RobotMap:
    """Read the body of a robot from YAML. Raises SceneError as `read_yaml_model` does, and if a name is not the robot's."""
    content = read_yaml_model(RobotMapFile, path)

    def find(name: str) -> int:
        if name not in robot.link_names:
            raise SceneError(f"{path.name}: {robot.name} has no link {name}; its links are in the file of the robot.")
        return robot.link_names.index(name)

    def convert(point: PointFile) -> LinkPoint:
        return LinkPoint(find(point.link), np.array(point.position))

    if wrong := sorted({*LIMBS} ^ {*content.limbs}):
        raise SceneError(f"{path.name}: limbs must be {', '.join(LIMBS)}; {wrong[0]} is missing or none of them.")
    if missing := [side for side in SIDES if side not in content.feet]:
        raise SceneError(f"{path.name}: feet must have {missing[0]}.")
    if unknown := [name for name in content.standing if name not in robot.joint_names]:
        raise SceneError(f"{path.name}: standing: {robot.name} has no joint {unknown[0]}.")
    body = stand_robot(robot, np.array([content.standing.get(name, 0.0) for name in robot.joint_names]))
    found = RobotMap(
        {name: (convert(content.limbs[name][0]), convert(content.limbs[name][1])) for name in LIMBS},
        {side: find(content.feet[side].link) for side in SIDES},
        {side: np.array(content.feet[side].sole) for side in SIDES},
        find(content.pelvis),
        find(content.trunk),
        find(content.head),
        {side: find(name) for side, name in content.hands.items()},
        body.standing,
        f"Read from {path.name}.",
        content.keeps_balance,
    )
    _check_map(body, found, path.name)
    return found


def write_robot_map(target: Path, robot: Robot, robot_map: RobotMap) -> None:
    """Write the body of a robot as YAML, to be edited and read again. Raises WriteError if `target` is not writable."""

    def convert(point: LinkPoint) -> dict[str, object]:
        return {"link": robot.link_names[point.link], "position": np.round(point.position, 5).tolist()}

    content = {
        "pelvis": robot.link_names[robot_map.pelvis],
        "trunk": robot.link_names[robot_map.trunk],
        "head": robot.link_names[robot_map.head],
        "hands": {side: robot.link_names[link] for side, link in robot_map.hands.items()},
        "limbs": {name: [convert(point) for point in ends] for name, ends in robot_map.limbs.items()},
        "feet": {
            side: {"link": robot.link_names[link], "sole": np.round(robot_map.soles[side], 5).tolist()}
            for side, link in robot_map.feet.items()
        },
        "standing": {
            name: round(float(value), 5) for name, value in zip(robot.joint_names, robot_map.standing, strict=True) if value
        },
        "keeps_balance": robot_map.keeps_balance,
    }
    head = f"# The body of the robot {robot.name}; edit it and give it as --character-map. {robot_map.reason}\n"
    text = head + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=130)
    with replace_atomically(target) as part:
        part.write_text(text, encoding="utf-8")
