"""Retarget a motion to a robot: the joint positions of a whole take at once.

    targets    = compute_robot_targets(...)    what is kept of the performer
    posture    = find_posture(...)             joint positions of an easy posture, where nothing else decides
    trajectory = solve_windows(...)            a search without places to stand, on every n-th frame
    targets    = stand_feet(...)               where feet stand, nearest to the last trajectory
    trajectory = solve_windows(...)            all terms; feet stand loosely first, and at the end on all frames

No frame starts from another one: the search starts in the same posture everywhere and the spline couples the frames, so the
result does not depend on how a take begins. Joint positions are within their limits; those of speeds are soft, and
exact at the end: feet slide where legs are too slow for a motion.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.animations.repair_methods import make_quaternions_continuous
from mocapfix.robots.robot import Robot
from mocapfix.robots.robot_map import list_leaders
from mocapfix.robots.robot_targets import RobotBody, RobotTargets, stand_feet
from mocapfix.solve import trajectory

WINDOW_S, OVERLAP_S = 20.0, 1.0  # longest part of a take that is solved at once, and the time that two parts share
SPEED_SHARE, SPEED_SD = 0.97, 0.05  # share of its limit that a speed may reach, and the standard deviation of an excess
POSTURE_SD_RAD, POSTURE_SEARCH_SD_RAD = 2.0, 0.7  # of joint positions about the easy posture, at the end and in the search
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


class SolveStage(NamedTuple):
    """How a trajectory is minimised once."""

    control_rate: float  # control points per second, at least
    counts_all: bool  # whether every frame counts, or as many as there are control points
    max_iterations: int
    min_decrease: float
    damping: float


SEARCH = SolveStage(15.0, False, 10, 1e-2, trajectory.FAR_START_DAMPING)
STANDING = (
    (0.003, SolveStage(15.0, False, 12, 3e-4, 1e-2)),
    (0.001, SolveStage(30.0, False, 12, 3e-4, 1e-3)),
    (0.00007, SolveStage(30.0, True, 10, 3e-4, 1e-4)),
)
"""Standard deviations of the edges of standing soles, in metres, and how trajectories are minimised with them.

Feet that need not stand stop where a robot with joints at limits cannot stand: so places are found again while they become exact.
"""


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
    def mass_centres(self) -> Float[np.ndarray, "T L 3"]:
        """The centres of mass of the links in the world, metres."""
        return self.link_positions + np.einsum("tlij,lj->tli", self.link_rotations, self.robot.mass_centres)

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


def retarget_to_robot(body: RobotBody, targets: RobotTargets) -> RobotMotion:
    """Return the motion of a robot that does what `compute_robot_targets` returns."""
    found = find_start(body, targets)
    costs = build_control_costs(body, found.points[0, trajectory.ROOT_UNKNOWNS :])
    found = solve_windows(body, targets.loosen(), replace(costs, rest_sd=POSTURE_SEARCH_SD_RAD), found, SEARCH)
    for standing_sd, stage in STANDING:
        edges, _ = trajectory.place_points(body.tree, found.references, found.unknowns, body.edge_links, body.edge_offsets)
        found = solve_windows(body, stand_feet(body, targets, edges, standing_sd), costs, found, stage)
    found = found.limit_speeds(costs.speed_limits)
    return compose_robot_motion(body, targets.rate, found.references, found.unknowns)


def build_control_costs(body: RobotBody, posture: Float[np.ndarray, " U"]) -> trajectory.ControlCosts:
    """Return the costs of control points; joints that follow others narrow the limits of those."""
    tree, robot = body.tree, body.robot
    limits, speeds = np.tile([-np.inf, np.inf], (len(posture), 1)), np.full(len(posture), np.inf)
    for joint, unknown in enumerate(tree.unknowns):
        factor, offset = tree.factors[joint], tree.offsets[joint] + robot.zero_positions[joint]
        if factor != 0.0:
            low, high = np.sort((robot.limits[joint] - offset) / factor)
            limits[unknown] = max(limits[unknown, 0], low), min(limits[unknown, 1], high)
            speeds[unknown] = min(speeds[unknown], body.speed_limits[joint] / abs(factor))
    size = trajectory.ROOT_UNKNOWNS + len(posture)
    acceleration, jerk = np.full(size, ACCELERATION_SD), np.full(size, JERK_SD)
    acceleration[:3], jerk[:3] = ROOT_ACCELERATION_SD, ROOT_JERK_SD
    return trajectory.ControlCosts(limits, SPEED_SHARE * speeds, SPEED_SD, posture, POSTURE_SD_RAD, acceleration, jerk)


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
    turns = np.stack([body.standing.rotations[link] for link in rotation.links])[None]
    terms = trajectory.HingedTerms(
        frame.place._replace(weights=np.zeros(frame.place.weights.shape)),
        frame.floor._replace(weight=0.0),
        line._replace(directions=directions, weights=weights),
        rotation._replace(rotations=np.ascontiguousarray(turns)),
        frame.collision._replace(weight=0.0),
        frame.balance,
    )
    standing = body.map.standing[list_leaders(body.robot)]
    costs = replace(build_control_costs(body, standing), rest_sd=POSTURE_SEARCH_SD_RAD)
    random, basis = np.random.default_rng(0), trajectory.build_spline_basis(1, POSTURE_RATE, 1)
    low, high = np.clip(costs.limits, -np.pi, np.pi).T
    best = (np.inf, standing)
    for k in range(1 + POSTURE_STARTS):
        joints = np.clip(standing, low, high) if k == 0 else standing + 0.5 * (random.uniform(low, high) - standing)
        points = np.tile(np.concatenate([np.zeros(trajectory.ROOT_UNKNOWNS), joints]), (basis.point_count, 1))
        start = trajectory.Trajectory(basis, body.robot.link_rotations[:1], points)
        found, cost = trajectory.minimise_trajectory(body.tree, terms, costs, start, max_iterations=25, min_decrease=1e-3)
        if cost < best[0]:
            best = cost, found.unknowns[0, trajectory.ROOT_UNKNOWNS :]
    return np.clip(best[1], low, high)


def find_start(body: RobotBody, targets: RobotTargets) -> trajectory.Trajectory:
    """Return the easy posture carried along the path, turned as the performer's pelvis."""
    count = len(targets.hips)
    basis = trajectory.build_spline_basis(count, targets.rate, max(1, round(targets.rate / SEARCH.control_rate)))
    quaternions = make_quaternions_continuous(Rotation.from_matrix(targets.pelvis).as_quat())
    pelvis = Rotation.from_quat(basis.evaluate(basis.fit(quaternions))).as_matrix()
    references = np.ascontiguousarray(pelvis @ body.robot.link_rotations[0])
    points = np.zeros((basis.point_count, trajectory.ROOT_UNKNOWNS + len(body.map.standing[list_leaders(body.robot)])))
    points[:, :3] = basis.fit(targets.hips - pelvis @ body.hip_centre)
    points[:, trajectory.ROOT_UNKNOWNS :] = find_posture(body, targets)
    return trajectory.Trajectory(basis, references, points)


def solve_windows(
    body: RobotBody, targets: RobotTargets, costs: trajectory.ControlCosts, start: trajectory.Trajectory, stage: SolveStage
) -> trajectory.Trajectory:
    """Return the trajectory of least cost, solved in windows that overlap.

    In an overlap the control points of one window lead over into those of the next.
    """
    interval = max(1, round(targets.rate / stage.control_rate))
    if interval != start.basis.interval:
        basis = trajectory.build_spline_basis(len(start.references), targets.rate, interval)
        start = trajectory.Trajectory(basis, start.references, basis.fit(start.unknowns))
    basis, points = start.basis, start.points.copy()
    length, overlap = (round(seconds / basis.interval_s) for seconds in (WINDOW_S, OVERLAP_S))
    first, count = 0, len(points)
    while True:
        stop = count if first + length + overlap + 3 >= count else first + length
        window = start.select_points(first, stop)
        frame = first * basis.interval
        terms = targets.select_frames(slice(frame, frame + len(window.references)))
        window, _ = trajectory.minimise_trajectory(
            body.tree, terms, costs, window,
            frame_step=1 if stage.counts_all else interval,
            max_iterations=stage.max_iterations, min_decrease=stage.min_decrease, damping=stage.damping,
        )  # fmt: skip
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
    positions, rotations = trajectory.place_points(tree, references, unknowns, links, np.zeros((len(links), 3)))
    joints = tree.offsets + tree.factors * unknowns[:, trajectory.ROOT_UNKNOWNS + tree.unknowns] + body.robot.zero_positions
    return RobotMotion(body.robot, rate, references, unknowns, joints, positions, rotations)
