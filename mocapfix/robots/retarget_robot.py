"""Retarget a motion to a robot: the joint positions of a whole take at once.

    targets    = compute_robot_targets(...)    what is kept of the performer
    posture    = find_posture(...)             joint positions of an easy posture, where nothing else decides
    trajectory = solve_windows(...)            a search without places to stand, on every n-th frame
    targets    = stand_feet(...)               where feet stand
    trajectory = solve_windows(...)            all terms; first on every n-th frame, then on all

No frame starts from another one: the search starts in the same posture everywhere and the spline couples the frames, so the
result does not depend on how a take begins. Joint positions are within their limits, to which control points are clipped at the
end; limits of speeds are soft.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.animations.repair_methods import make_quaternions_continuous
from mocapfix.characters.body_frames import BodyFrame, SegmentMotion
from mocapfix.contacts.contacts import BodyContacts
from mocapfix.robots.robot import Robot
from mocapfix.robots.robot_targets import (
    RobotBody,
    RobotTargets,
    compute_robot_targets,
    list_leaders,
    stand_feet,
)
from mocapfix.solve.trajectory import (
    FAR_START_DAMPING,
    ROOT_UNKNOWNS,
    ControlCosts,
    HingedTerms,
    Trajectory,
    build_spline_basis,
    minimise_trajectory,
    place_points,
)

CONTROL_RATE = 30.0  # control points per second, at least
WINDOW_S, OVERLAP_S = 20.0, 1.0  # longest part of a take that is solved at once, and the time that two parts share
SPEED_SHARE, SPEED_SD = 0.97, 0.05  # share of the limit from which a speed counts as too high, and its standard deviation
LIMIT_SD_RAD, LIMIT_SEARCH_SD_RAD = 0.004, 0.03  # of an excess over a joint's limits, at the end and in the search
POSTURE_SD_RAD, POSTURE_SEARCH_SD_RAD = 2.0, 0.7  # of joint positions about the easy posture, likewise
ACCELERATION_SD, JERK_SD = 60.0, 3000.0  # of joints and of the root's rotation, rad/s^2 and rad/s^3
ROOT_ACCELERATION_SD, ROOT_JERK_SD = 10.0, 500.0  # of the root's position, m/s^2 and m/s^3
POSTURE_DIRECTIONS = {
    "upper_arm": (0.0, 0.15, -1.0),
    "forearm": (0.9, 0.0, -0.5),
    "thigh": (0.25, 0.03, -1.0),
    "shin": (-0.25, 0.0, -1.0),
}
"""Directions of the left limbs in an easy posture: elbows and knees bend as a person's do, far from where they are straight."""
POSTURE_STARTS = 8  # random starts of the search for it; a seed makes them the same
POSTURE_LINE_SD_RAD = 0.05
POSTURE_RATE = 1.0  # control points per second in the search for it: so slow that changes between them cost little
SEARCH_ITERATIONS, STANDING_ITERATIONS, LAST_ITERATIONS = 10, 18, 10
SEARCH_DECREASE, LAST_DECREASE = 1e-2, 3e-4  # relative decreases at which searches end; 1e-3 left 4 % overlaps in a dance
STANDING_DAMPING, LAST_DAMPING = 1e-2, 1e-4


class SolveStage(NamedTuple):
    """How a trajectory is minimised once, see `minimise_trajectory`."""

    frame_step: int
    max_iterations: int
    min_decrease: float
    damping: float


@dataclass(frozen=True)
class RobotMotion:
    """The motion of a robot over T frames; Z up, the floor at height 0, X forward where the performer's Z is."""

    robot: Robot
    rate: float
    references: Float[np.ndarray, "T 3 3"]  # references, unknowns: as `kernels.hinged_tree` takes them
    unknowns: Float[np.ndarray, "T D"]
    joint_positions: Float[np.ndarray, "T N"]  # radians, metres of slides
    link_positions: Float[np.ndarray, "T L 3"]  # origins of the links in the world, metres
    link_rotations: Float[np.ndarray, "T L 3 3"]

    @property
    def root_position(self) -> Float[np.ndarray, "T 3"]:
        """The origin of the root, metres."""
        return self.link_positions[:, 0]

    @property
    def root_rotation(self) -> Float[np.ndarray, "T 3 3"]:
        return self.link_rotations[:, 0]

    @property
    def joint_velocities(self) -> Float[np.ndarray, "T N"]:
        """Central differences, per second; of a single frame 0."""
        return differentiate(self.joint_positions, self.rate)

    def select_frames(self, frames: slice) -> "RobotMotion":
        """Return some frames of the motion."""
        arrays = (self.references, self.unknowns, self.joint_positions, self.link_positions, self.link_rotations)
        return RobotMotion(self.robot, self.rate, *(each[frames] for each in arrays))


def differentiate(values: Float[np.ndarray, "*shape"], rate: float) -> Float[np.ndarray, "*shape"]:
    """Return central differences along the frames, the first axis, per second; of a single frame 0."""
    return np.gradient(values, 1.0 / rate, axis=0) if len(values) > 1 else np.zeros_like(values)


def retarget_to_robot(
    body: RobotBody, source: BodyFrame, motion: SegmentMotion, contacts: BodyContacts | None, rate: float
) -> RobotMotion:
    """Return the motion of a robot that moves like a performer; arguments as for `compute_robot_targets`."""
    targets = compute_robot_targets(body, source, motion, contacts, rate)
    start = find_start(body, targets)
    posture = start.points[0, ROOT_UNKNOWNS:]
    step = start.basis.interval
    search = build_control_costs(body, posture, LIMIT_SEARCH_SD_RAD, POSTURE_SEARCH_SD_RAD)
    found = solve_windows(
        body, targets.loosen(), search, start, [SolveStage(step, SEARCH_ITERATIONS, SEARCH_DECREASE, FAR_START_DAMPING)]
    )
    edges, _ = place_points(body.tree, found.references, found.unknowns, body.edge_links, body.edge_offsets)
    standing = stand_feet(body, targets, edges)
    costs = build_control_costs(body, posture, LIMIT_SD_RAD, POSTURE_SD_RAD)
    stages = [
        SolveStage(step, STANDING_ITERATIONS, LAST_DECREASE, STANDING_DAMPING),
        SolveStage(1, LAST_ITERATIONS, LAST_DECREASE, LAST_DAMPING),
    ]
    found = solve_windows(body, standing, costs, found, stages)
    points = found.points.copy()
    points[:, ROOT_UNKNOWNS:] = np.clip(points[:, ROOT_UNKNOWNS:], *costs.limits.T)
    return compose_robot_motion(body, rate, found.references, found.basis.evaluate(points))


def build_control_costs(body: RobotBody, posture: Float[np.ndarray, " U"], limit_sd: float, posture_sd: float) -> ControlCosts:
    """Return the costs of control points; joints that follow others narrow the limits of those."""
    tree, robot = body.tree, body.robot
    limits, speeds = np.tile([-np.inf, np.inf], (len(posture), 1)), np.full(len(posture), np.inf)
    for joint, unknown in enumerate(tree.unknowns):
        factor, offset = tree.factors[joint], tree.offsets[joint] + robot.zero_positions[joint]
        if factor != 0.0:
            low, high = np.sort((robot.limits[joint] - offset) / factor)
            limits[unknown] = max(limits[unknown, 0], low), min(limits[unknown, 1], high)
            speeds[unknown] = min(speeds[unknown], body.speed_limits[joint] / abs(factor))
    size = ROOT_UNKNOWNS + len(posture)
    acceleration, jerk = np.full(size, ACCELERATION_SD), np.full(size, JERK_SD)
    acceleration[:3], jerk[:3] = ROOT_ACCELERATION_SD, ROOT_JERK_SD
    return ControlCosts(limits, limit_sd, SPEED_SHARE * speeds, SPEED_SD, posture, posture_sd, acceleration, jerk)


def find_posture(body: RobotBody, targets: RobotTargets) -> Float[np.ndarray, " U"]:
    """Return the joint positions of an easy posture, which has bent elbows and knees.

    It is the cheapest solution for its directions from several starts: where a pose has two, motions begin near the natural one.
    """
    frame = targets.select_frames(slice(0, 1))
    line, rotation = frame.line, frame.rotation
    names = [*body.map.limbs]
    wanted = np.array([POSTURE_DIRECTIONS[name.partition("_")[2]] for name in names])
    wanted[[name.startswith("right") for name in names], 1] *= -1.0
    directions, weights = line.directions.copy(), np.zeros(line.weights.shape)
    directions[0, : len(names)] = wanted / np.linalg.norm(wanted, axis=1, keepdims=True)
    weights[0, : len(names)] = POSTURE_LINE_SD_RAD**-2
    turns = np.stack([body.turn_standing(link) for link in rotation.links])[None]
    none = np.zeros((0, 2), int)
    terms = HingedTerms(
        frame.place._replace(weights=np.zeros(frame.place.weights.shape)),
        frame.floor._replace(weight=0.0),
        line._replace(directions=directions, weights=weights),
        rotation._replace(rotations=np.ascontiguousarray(turns)),
        frame.collision._replace(pairs=none, box_pairs=none),
    )
    standing = body.map.standing[list_leaders(body.robot)]
    costs = build_control_costs(body, standing, LIMIT_SEARCH_SD_RAD, POSTURE_SEARCH_SD_RAD)
    random, basis = np.random.default_rng(0), build_spline_basis(1, POSTURE_RATE, 1)
    low, high = np.clip(costs.limits, -np.pi, np.pi).T
    best = (np.inf, standing)
    for k in range(1 + POSTURE_STARTS):
        joints = np.clip(standing, low, high) if k == 0 else standing + 0.5 * (random.uniform(low, high) - standing)
        points = np.tile(np.concatenate([np.zeros(ROOT_UNKNOWNS), joints]), (basis.point_count, 1))
        start = Trajectory(basis, np.eye(3)[None], points)
        found, cost = minimise_trajectory(body.tree, terms, costs, start, max_iterations=25, min_decrease=1e-3)
        if cost < best[0]:
            best = cost, found.unknowns[0, ROOT_UNKNOWNS:]
    return np.clip(best[1], low, high)


def find_start(body: RobotBody, targets: RobotTargets) -> Trajectory:
    """Return the easy posture carried along the path, turned as the performer's pelvis."""
    count = len(targets.hips)
    basis = build_spline_basis(count, targets.rate, max(1, round(targets.rate / CONTROL_RATE)))
    quaternions = make_quaternions_continuous(Rotation.from_matrix(targets.pelvis).as_quat())
    references = np.ascontiguousarray(Rotation.from_quat(basis.evaluate(basis.fit(quaternions))).as_matrix())
    points = np.zeros((basis.point_count, ROOT_UNKNOWNS + len(body.map.standing[list_leaders(body.robot)])))
    points[:, :3] = basis.fit(targets.hips - references @ body.hip_centre)
    points[:, ROOT_UNKNOWNS:] = find_posture(body, targets)
    return Trajectory(basis, references, points)


def solve_windows(
    body: RobotBody,
    targets: RobotTargets,
    costs: ControlCosts,
    start: Trajectory,
    stages: Sequence[SolveStage],
) -> Trajectory:
    """Return the trajectory of least cost after several stages, solved in windows that overlap.

    In an overlap the control points of one window lead over into those of the next.
    """
    basis, points = start.basis, start.points.copy()
    length, overlap = (round(seconds / basis.interval_s) for seconds in (WINDOW_S, OVERLAP_S))
    first, count = 0, len(points)
    while True:
        stop = count if first + length + overlap + 3 >= count else first + length
        window = start.select_points(first, stop)
        frame = first * basis.interval
        terms = targets.select_frames(slice(frame, frame + len(window.references)))
        for stage in stages:
            window, _ = minimise_trajectory(body.tree, terms, costs, window, **stage._asdict())
        share = np.clip((np.arange(stop - first) + 1.0) / (overlap + 1.0), 0.0, 1.0)[:, None] if first else 1.0
        points[first:stop] = (1.0 - share) * points[first:stop] + share * window.points
        if stop == count:
            return replace(start, points=points)
        first = stop - overlap


def compose_robot_motion(
    body: RobotBody, rate: float, references: Float[np.ndarray, "T 3 3"], unknowns: Float[np.ndarray, "T D"]
) -> RobotMotion:
    """Return the motion of unknowns, as `kernels.hinged_tree` takes them."""
    tree, links = body.tree, np.arange(len(body.tree.parents))
    positions, rotations = place_points(tree, references, unknowns, links, np.zeros((len(links), 3)))
    joints = tree.offsets + tree.factors * unknowns[:, ROOT_UNKNOWNS + tree.unknowns] + body.robot.zero_positions
    return RobotMotion(body.robot, rate, references, unknowns, joints, positions, rotations)
