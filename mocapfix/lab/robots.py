"""Measure robots: their motion beside the performer's, on the floor, among their limits, and beside frame-by-frame solves.

Directions, soles and contacts are those of the robot's own map. Collisions are MuJoCo's contacts of the file's own shapes. Beside
a whole take solved at once stands mink (Zakka, mink: Python inverse kinematics based on MuJoCo) if it is installed: differential
inverse kinematics on the same targets with the same weights and joint limits, each frame from the one before it.

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
"""

import importlib
import importlib.util
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import build_cmu31_character
from mocapfix.characters.kept_positions import resample_foot_contacts
from mocapfix.errors import ReadError
from mocapfix.lab.retargeting import BenchMotion, load_bench_motions
from mocapfix.robots.retarget_robot import RobotMotion, compose_robot_motion, find_start, retarget_to_robot
from mocapfix.robots.robot import compile_model, load_robot, may_collide
from mocapfix.robots.robot_files import OVERLAP_M, build_robot_arrays, compute_limb_directions, measure_robot_motion
from mocapfix.robots.robot_map import find_robot_map, turn_upright
from mocapfix.robots.robot_targets import RobotBody, RobotTargets, build_robot_body, compute_robot_targets, stand_feet
from mocapfix.solve.trajectory import ROOT_UNKNOWNS, place_points

LIMIT_TOLERANCE_RAD = 1e-3  # excess from which a position violates a limit
DEEP_M, FLOATING_M = 0.010, 0.015  # depth and height from which a sole is in the floor or above it
FIRST_ITERATIONS, FRAME_ITERATIONS, FRAME_DECREASE = 100, 10, 1e-3  # of mink; relative decrease of the cost that ends a frame
FRAME_DAMPING, FRAME_STANDING_SD_M = 1e-3, 3e-4  # of joint steps; of standing soles: daqp fails with smaller ones

Row = dict[str, Any]


def list_robot_files(paths: Sequence[Path]) -> list[Path]:
    """Return files, and the MJCF files of folders. Raises ReadError if there is none."""
    found = [file for path in paths for file in ([path] if not path.is_dir() else sorted(path.rglob("*.xml"))) if file.is_file()]
    if not found:
        raise ReadError(f"{', '.join(map(str, paths))}: no robot (.xml, .urdf) is there; give files or a folder with some.")
    return found


def measure_robots(
    robots: Sequence[Path], takes: Sequence[Path], report_progress: Callable[[str], None] = lambda _: None
) -> list[Row]:
    """Return a row for each robot, take and program.

    Raises:
        ReadError: If a robot or a take cannot be read.
        TakeError: If a take shows no whole body.
    """
    motions: list[BenchMotion] = []
    for take in takes:
        report_progress(take.name)
        motions += load_bench_motions(None, take, "lock")
    rows: list[Row] = []
    for path, performed in product(list_robot_files(robots), motions):
        report_progress(f"{path.stem}, {performed.name}")
        rows += measure_robot(path, performed)
    return rows


def measure_robot(path: Path, performed: BenchMotion) -> list[Row]:
    """Return a row for each program; the second of two solves is timed, whose kernels are loaded."""
    robot, (model, _) = load_robot(path), compile_model(path)
    body, rate = build_robot_body(*turn_upright(robot, find_robot_map)), performed.motion.rate
    source = build_body_frame(build_cmu31_character(performed.skeleton))
    segments = compute_segment_motion(source, performed.motion)
    feet = resample_foot_contacts(performed.contacts, performed.motion.frame_count, rate)
    retarget_to_robot(body, compute_robot_targets(body, source, segments, feet, rate))
    start_s = time.process_time()
    targets = compute_robot_targets(body, source, segments, feet, rate)
    moved = retarget_to_robot(body, targets)
    spent_s = time.process_time() - start_s
    rows = [{"program": "mocapfix"} | measure_figures(body, model, targets, moved, spent_s)]
    if importlib.util.find_spec("mink") is not None and not robot.couplings:
        edges, _ = place_points(body.tree, moved.references, moved.unknowns, body.edge_links, body.edge_offsets)
        standing, start_s = stand_feet(body, targets, edges, FRAME_STANDING_SD_M), time.process_time()
        by_frame = retarget_by_mink(body, model, standing)
        rows.append({"program": "mink"} | measure_figures(body, model, targets, by_frame, time.process_time() - start_s))
    return [{"robot": robot.name, "take": performed.name} | row for row in rows]


def measure_figures(body: RobotBody, model: Any, targets: RobotTargets, motion: RobotMotion, spent_s: float) -> Row:
    """Return the figures of a motion; shares are of frames.

    Args:
        body: The robot.
        model: MuJoCo's model of it.
        targets: What it should do.
        motion: What it does.
        spent_s: Processor time of the retargeting, in seconds.
    """
    robot, rate, count = body.robot, motion.rate, len(motion.joint_positions)
    directions, wanted = compute_limb_directions(body, motion), targets.terms.line.directions[:, : len(body.map.limbs)]
    jerks = [float((np.diff(each, 3, axis=0) ** 2).sum(axis=2).mean(axis=0).sum()) for each in (directions, wanted)]
    mean_deg, high_deg = measure_robot_motion(body, targets, motion).limb_deg
    joints, (low, high) = motion.joint_positions, robot.limits.T
    slides, drifts = measure_standing(body, targets, motion)
    corners, _ = place_points(body.tree, motion.references, motion.unknowns, body.corner_links, body.corner_offsets)
    heights = corners[..., 2].reshape(count, 2, 4).min(axis=2) - targets.heights
    stands = np.zeros((count, 2), bool)
    for (side, _), runs in targets.contacts.items():
        for first, last in runs:
            stands[first : last + 1, 0 if side == "left" else 1] = True
    standing = heights[stands]
    depths = measure_collisions(model, motion)
    return {
        "limbs_deg": mean_deg,
        "limbs_95_deg": high_deg,
        "slide_mm_per_second": _find_mean(slides) * 1e3,
        "drift_mm": _find_mean(drifts) * 1e3,
        "stance_height_range_mm": float(np.ptp(np.percentile(standing, [5, 95]))) * 1e3 if len(standing) else np.nan,
        "penetration_share": float((heights.min(axis=1) < -DEEP_M).mean()),
        "floating_share": _find_mean(standing > FLOATING_M),
        "self_collision_share": float((depths > OVERLAP_M).mean()),
        "self_collision_mm": float(depths.max()) * 1e3,
        "limit_violations": int((np.maximum(low - joints, joints - high) > LIMIT_TOLERANCE_RAD).sum()),
        "speed_violations": int((np.abs(np.diff(joints, axis=0)) * rate > body.speed_limits).sum()),
        "limb_jerk_ratio": float(np.sqrt(jerks[0] / jerks[1])) if jerks[1] else np.nan,
        "frames_per_second": count / spent_s if spent_s else np.nan,
    }


def _find_mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def measure_standing(
    body: RobotBody, targets: RobotTargets, motion: RobotMotion
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " C"]]:
    """Return horizontal speeds of the edges of the soles in contact, and how far they go in each contact.

    Returns:
        Metres per second in each frame but the first and the last of a contact; the largest distance from the mean place, metres.
    """
    edges, _ = place_points(body.tree, motion.references, motion.unknowns, body.edge_links, body.edge_offsets)
    places, speeds, drifts = edges[..., :2], list[float](), list[float]()
    pace = np.linalg.norm(np.gradient(places, 1.0 / motion.rate, axis=0), axis=2) if len(places) > 1 else np.zeros((1, 4))
    for (side, end), runs in targets.contacts.items():
        edge = 2 * (side == "right") + end
        for first, last in runs:
            run = places[first : last + 1, edge]
            speeds += pace[first + 1 : last, edge].tolist()
            drifts.append(float(np.linalg.norm(run - run.mean(axis=0), axis=1).max()))
    return np.array(speeds), np.array(drifts)


def measure_collisions(model: Any, motion: RobotMotion) -> Float[np.ndarray, " T"]:
    """Return the depth of the deepest contact of parts of a robot that may collide in each frame, in metres."""
    mujoco: Any = importlib.import_module("mujoco")
    data, depths = mujoco.MjData(model), np.zeros(len(motion.joint_positions))
    for frame, positions in enumerate(build_robot_arrays(motion)["qpos"]):
        data.qpos[:] = positions
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact[: data.ncon]:
            shapes = int(contact.geom1), int(contact.geom2)
            if -contact.dist > depths[frame] and model.geom_bodyid[list(shapes)].all() and may_collide(model, *shapes):
                depths[frame] = -contact.dist
    return depths


def retarget_by_mink(body: RobotBody, model: Any, targets: RobotTargets) -> RobotMotion:
    """Return the motion by mink, each frame from the one before; soles stand where `targets` has them.

    Collisions and the floor are left out, as in programs that work so, and joints that follow others are not known.
    """
    mink, mujoco = importlib.import_module("mink"), importlib.import_module("mujoco")
    place, line, rotation = targets.terms.place, targets.terms.line, targets.terms.rotation
    bodies = np.array([model.body(name).id for name in body.robot.link_names])
    start = find_start(body, targets)
    root = np.concatenate([start.unknowns[0, :3], Rotation.from_matrix(start.references[0]).as_quat()[[3, 0, 1, 2]]])
    configuration = mink.Configuration(model, np.concatenate([root, start.unknowns[0, ROOT_UNKNOWNS:]]))

    def place_point(link: int, offset: Float[np.ndarray, " 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Return where a point of a link is, and its Jacobian."""
        data, jacobian = configuration.data, np.empty((3, model.nv))
        found = data.xpos[bodies[link]] + data.xmat[bodies[link]].reshape(3, 3) @ offset
        mujoco.mj_jac(model, data, jacobian, None, found, bodies[link])
        return found, jacobian

    class TargetTask(mink.Task):
        """The directions of limbs and the places of hips and soles."""

        def choose_frame(self, frame: int) -> None:
            self.frame, self.used = frame, np.flatnonzero(place.weights[frame].any(axis=1))
            self.cost = np.sqrt(np.concatenate([np.repeat(line.weights[frame], 3), place.weights[frame, self.used].ravel()]))

        def linearise(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
            errors, jacobians = list[np.ndarray](), list[np.ndarray]()
            for links, offsets, wanted in zip(line.links, line.offsets, line.directions[self.frame], strict=True):
                (near, near_slope), (far, far_slope) = map(place_point, links, offsets)
                length, direction = np.linalg.norm(far - near), (far - near) / np.linalg.norm(far - near)
                errors.append(direction - wanted)
                jacobians.append((np.eye(3) - np.outer(direction, direction)) @ (far_slope - near_slope) / length)
            for point in self.used:
                found, slope = place_point(place.links[point], place.offsets[point])
                errors.append(found - place.places[self.frame, point])
                jacobians.append(slope)
            return errors, jacobians

        def compute_error(self, configuration: Any) -> np.ndarray:
            return np.concatenate(self.linearise()[0])

        def compute_jacobian(self, configuration: Any) -> np.ndarray:
            return np.concatenate(self.linearise()[1])

        def compute_qp_residual(self, configuration: Any) -> Any:
            errors, jacobians = self.linearise()
            return self._weighted_residual(np.concatenate(errors), np.concatenate(jacobians))

    own = TargetTask(cost=np.zeros(0))
    turns = [
        mink.FrameTask(body.robot.link_names[link], "body", position_cost=0.0, orientation_cost=float(np.sqrt(weight)))
        for link, weight in zip(rotation.links, rotation.weights[0], strict=True)
    ]
    limits, found, step_s = [mink.ConfigurationLimit(model)], list[np.ndarray](), 1.0 / targets.rate
    for frame in range(len(targets.hips)):
        own.choose_frame(frame)
        for task, turn in zip(turns, rotation.rotations[frame], strict=True):
            task.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(turn), np.zeros(3)))
        cost = np.inf
        for _ in range(FRAME_ITERATIONS if frame else FIRST_ITERATIONS):
            velocity = mink.solve_ik(configuration, [own, *turns], step_s, "daqp", damping=FRAME_DAMPING, limits=limits)
            configuration.integrate_inplace(velocity, step_s)
            before, cost = cost, sum(float(((t.cost * t.compute_error(configuration)) ** 2).sum()) for t in (own, *turns))
            if before - cost < FRAME_DECREASE * before:
                break
        found.append(configuration.q.copy())
    qpos = np.array(found)
    references = np.ascontiguousarray(Rotation.from_quat(qpos[:, [4, 5, 6, 3]]).as_matrix())
    unknowns = np.concatenate([qpos[:, :3], np.zeros((len(qpos), ROOT_UNKNOWNS - 3)), qpos[:, 7:]], axis=1)
    return compose_robot_motion(body, targets.rate, references, unknowns)
