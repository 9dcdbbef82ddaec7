"""What is written of a robot: NPZ with names, a GLB to look at, and on request the CSV of Unitree and the pickle of GMR.

Files of data have metres, radians and Z up, with the floor at height 0. The order of quaternions differs: w x y z in NPZ, as
MuJoCo's qpos has them, and x y z w in CSV and pickle. In the GLB the robot is a character of its links and collision shapes.
"""

import json
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from mocapfix.animations.repair_methods import make_quaternions_continuous
from mocapfix.characters.body_frames import BodyFrame, SegmentMotion, build_body_frame, compute_segment_motion
from mocapfix.characters.character import (
    BoneMapping,
    Character,
    CharacterMotion,
    CharacterSource,
    build_cmu31_character,
    convert_motion,
)
from mocapfix.characters.kept_positions import resample_foot_contacts
from mocapfix.contacts.contacts import BodyContacts
from mocapfix.errors import WriteError
from mocapfix.io.files import replace_atomically
from mocapfix.io.gltf import GlbContent, build_glb, build_skinned_document
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, decompose_transforms, make_names_unique
from mocapfix.options import OutputOptions
from mocapfix.robots.retarget_robot import RobotMotion, differentiate, retarget_to_robot
from mocapfix.robots.robot import LIMBS, LinkPoint, load_robot
from mocapfix.robots.robot_map import find_robot_map, read_robot_map, turn_upright, write_robot_map
from mocapfix.robots.robot_targets import (
    ROBOT_AXES,
    RobotBody,
    RobotTargets,
    build_robot_body,
    compute_mass_centre,
    compute_robot_targets,
    place_soles,
)
from mocapfix.solve.trajectory import compute_hinged_costs, place_points
from mocapfix.stats.rigid_alignment import compute_rotation_vectors

MAX_LIMB_DEG = 8.0
"""Mean angle from the performer's limbs from which a robot does something else: on three captures 11 to 14 degrees for a robot
whose file has the limits of other joints, 6.1 at most for nine others."""
AT_LIMIT_RAD = 0.005  # distance from a limit within which a joint counts as at it
ON_FLOOR_M = 0.015  # height up to which the lowest corner of the soles is on the floor
OVERLAP_M = 0.005  # depth from which parts that overlap count as colliding
EXTRA_SUFFIXES = {"robot-csv": ("csv", "columns.json"), "robot-pkl": ("pkl",)}


@dataclass(frozen=True)
class RobotFiles:
    """What is written of a robot."""

    body: RobotBody
    options: OutputOptions

    @cached_property
    def character(self) -> Character:
        """The robot as a character."""
        return build_robot_character(self.body)

    @property
    def suffixes(self) -> tuple[str, ...]:
        """The suffixes of the files, after the stem of the take."""
        extra = [suffix for name in dict.fromkeys(self.options.extra_formats) for suffix in EXTRA_SUFFIXES.get(name, ())]
        return tuple(f"{self.body.robot.name}.{ending}" for ending in ("npz", "glb", "map.yaml", *extra))

    def write(
        self, target: Path, skeleton: Skeleton, motion: Motion, rate: float, contacts: BodyContacts | None, frames: slice,
        is_solved: Bool[np.ndarray, " J"],
    ) -> tuple[list[str], CharacterMotion]:  # fmt: skip
        """Write some frames of the motion of a solved skeleton, of `rate` frames per second, as the robot's, all but the GLB.

        Returns sentences for the report on these frames, and the motion of `character`. The contacts may have another rate.
        Raises WriteError if a file is not writable, or if no frame is left.
        """
        source = build_body_frame(build_cmu31_character(skeleton))
        segments = compute_segment_motion(source, convert_motion(motion, rate))
        feet = None if contacts is None else resample_foot_contacts(contacts, motion.frame_count, rate)
        targets = compute_robot_targets(self.body, source, segments, feet, rate, is_solved)
        moved = retarget_to_robot(self.body, targets).select_frames(frames)
        if not len(moved.root_position):
            raise WriteError(f"{target.name}: none of its frames is among those of --trim; name frames of the take.")
        figures = measure_robot_motion(self.body, replace(targets, terms=targets.select_frames(frames)), moved)
        arrays = build_robot_arrays(moved)
        if feet is not None:
            arrays |= {"contact_joints": np.array(feet.joints), "contacts": feet.is_contact[frames]}
        with replace_atomically(target) as part, part.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        write_robot_map(target.with_suffix(".map.yaml"), self.body.robot, self.body.map)
        if "robot-csv" in self.options.extra_formats:
            write_robot_csv(target.with_suffix(".csv"), moved)
        if "robot-pkl" in self.options.extra_formats:
            write_robot_pickle(target.with_suffix(".pkl"), moved)
        scale = self.body.leg_length_m / source.leg_length_m
        origin = " ".join([self.body.map.reason, *self.body.robot.notes, f"Places are scaled by {scale:.3f}, as the legs are."])
        balance = "" if feet is None else describe_balance(self.body, moved, source, segments, feet, frames)
        return [f"{target.name}: {each}" for each in (origin, figures.describe() + balance)], convert_robot_motion(moved)


def load_robot_files(path: Path, options: OutputOptions) -> RobotFiles:
    """Return the files of a robot. Raises ReadError or SceneError if it, or the file of its body, cannot be used."""
    find = partial(read_robot_map, Path(options.character_map)) if options.character_map else find_robot_map
    return RobotFiles(build_robot_body(*turn_upright(load_robot(path), find)), options)


class RobotFigures(NamedTuple):
    """How well a robot's motion follows the performer, and what it touches."""

    limb_count: int  # of the limbs that the take shows
    limb_deg: tuple[float, float]  # angle between these and the performer's: mean, and 95th percentile
    trunk_deg: tuple[float, float]  # the 95th percentile of that of pelvis and chest
    at_limit_share: float  # of the frames in which a joint is at one of its limits
    limited_joint: str  # the one that is so most often
    speed_ratio: float  # largest speed of a joint over its limit
    fastest_joint: str
    has_speed_limit: bool  # whether the file states it
    overlap_share: float  # of the frames in which parts overlap by more than OVERLAP_M
    overlap_m: float  # the deepest
    on_floor_share: float  # of the frames in which a sole is on the floor

    def describe(self) -> str:
        """Return sentences."""
        mean, high = self.limb_deg
        overlap = f"parts overlap in {self.overlap_share:.1%} of the frames, by {self.overlap_m * 1e3:.0f} mm at most"
        limbs = "Limbs" if self.limb_count == len(LIMBS) else f"The {self.limb_count} limbs that the take shows"
        problem = "It does something else: check the limits of its joints, and its map. " if mean > MAX_LIMB_DEG else ""
        return (
            f"{problem}{limbs} point as the performer's within {mean:.1f} degrees in the mean, 95 % within {high:.1f}, "
            f"pelvis and chest are turned within {self.trunk_deg[0]:.1f} and {self.trunk_deg[1]:.1f}; "
            f"a sole is on the floor in {self.on_floor_share:.0%} of the frames; "
            f"{overlap if self.overlap_share else 'no parts overlap'}. A joint is at a limit in {self.at_limit_share:.0%} of the "
            f"frames{f', mostly {self.limited_joint}' * (self.at_limit_share > 0)}; the fastest, {self.fastest_joint}, reaches "
            f"{self.speed_ratio:.0%} of {'its' if self.has_speed_limit else 'the assumed'} limit of speed."
        )


def measure_robot_motion(body: RobotBody, targets: RobotTargets, motion: RobotMotion) -> RobotFigures:
    """Return the figures of a motion."""
    cosines = (compute_limb_directions(body, motion) * targets.terms.line.directions[:, : len(body.map.limbs)]).sum(axis=2)
    is_shown = targets.terms.line.weights[0, : len(body.map.limbs)] > 0.0
    angles = np.degrees(np.arccos(np.clip(cosines[:, is_shown], -1.0, 1.0))) if is_shown.any() else np.zeros(1)
    gaps = np.minimum(motion.joint_positions - body.robot.limits[:, 0], body.robot.limits[:, 1] - motion.joint_positions)
    is_at_limit, rotation = gaps < AT_LIMIT_RAD, targets.terms.rotation
    turns = motion.link_rotations[:, rotation.links[:2]].swapaxes(2, 3) @ rotation.rotations[:, :2]
    turn_rad = np.linalg.norm(compute_rotation_vectors(turns), axis=-1)
    ratio = np.abs(motion.joint_velocities).max(axis=0) / body.speed_limits
    fastest = int(np.argmax(ratio))
    costs = compute_hinged_costs(body.tree, targets.isolate_collisions(), motion.references, motion.unknowns)
    depths = np.sqrt(2.0 * costs)  # the root of the sum of their squares
    corners, _ = place_points(body.tree, motion.references, motion.unknowns, body.corner_links, body.corner_offsets)
    return RobotFigures(
        int(is_shown.sum()),
        (float(angles.mean()), float(np.percentile(angles, 95))),
        tuple(np.degrees(np.percentile(turn_rad, 95, axis=0)).tolist()),
        float(is_at_limit.any(axis=1).mean()),
        body.robot.joint_names[int(is_at_limit.sum(axis=0).argmax())],
        float(ratio[fastest]),
        body.robot.joint_names[fastest],
        bool(np.isfinite(body.robot.speed_limits[fastest])),
        float((depths > OVERLAP_M).mean()),
        float(depths.max()),
        float((corners[..., 2].min(axis=1) < ON_FLOOR_M).mean()),
    )


def describe_balance(
    body: RobotBody, moved: RobotMotion, source: BodyFrame, segments: SegmentMotion, contacts: BodyContacts, frames: slice
) -> str:
    """Return a sentence on the balance of a robot in some `frames`, and of the performer, whose soles have usual sizes."""
    edges = contacts.select_feet(frames).is_contact
    if not (is_flat := (edges[:, ::2] & edges[:, 1::2]).any(axis=1)).any():
        return ""
    corners, _ = place_points(body.tree, moved.references, moved.unknowns, body.corner_links, body.corner_offsets)
    centre = np.average(moved.mass_centres, axis=1, weights=body.robot.masses)
    share = find_outside(centre[:, :2], corners[..., :2], edges)[is_flat].mean()
    corners = place_soles(source, segments)[frames]
    other = find_outside(compute_mass_centre(segments)[frames][:, ::2], corners[..., ::2], edges)[is_flat].mean()
    return (
        f" While a foot stands flat, the centre of mass is outside of the standing soles in {share:.0%} of the frames, "
        f"the performer's in {other:.0%}."
    )


def find_outside(
    centres: Float[np.ndarray, "T 2"], corners: Float[np.ndarray, "T 8 2"], is_contact: Bool[np.ndarray, "T 4"]
) -> Bool[np.ndarray, " T"]:
    """Return where points on the floor are outside of the hull of the corners of edges in contact; True without such edges.

    It is outside where the directions to the corners leave more than half a turn free. Edges are in the order of
    `RobotBody.edge_links`, corners in that of `RobotBody.corner_links`.
    """
    lines = corners - centres[:, None]
    turns = np.where(np.repeat(is_contact, 2, axis=1), np.arctan2(lines[..., 1], lines[..., 0]), np.inf)
    first = np.minimum(turns.min(axis=1, keepdims=True), np.pi)
    turns = np.sort(np.where(np.isinf(turns), first, turns), axis=1)
    return np.diff(turns, axis=1, append=first + 2.0 * np.pi).max(axis=1) > np.pi


def compute_limb_directions(body: RobotBody, motion: RobotMotion) -> Float[np.ndarray, "T S 3"]:
    """Return the directions of the robot's limbs in the order of its map."""
    near, far = (
        np.stack([motion.link_positions[:, p.link] + motion.link_rotations[:, p.link] @ p.position for p in points], axis=1)
        for points in zip(*body.map.limbs.values(), strict=True)
    )
    return (far - near) / np.linalg.norm(far - near, axis=2, keepdims=True)


def build_robot_arrays(motion: RobotMotion) -> dict[str, np.ndarray]:
    """Return the arrays of the NPZ.

    The keys of BeyondMimic have its conventions: velocities of links are those of their centres of mass, in the world.
    """
    robot, rate = motion.robot, motion.rate
    quaternions = _compute_quaternions(motion.link_rotations)
    qpos = np.concatenate([motion.root_position, quaternions[:, 0], motion.joint_positions], axis=1)
    return {
        "fps": np.array(rate),
        "root_pos": motion.root_position,
        "root_quat": quaternions[:, 0],
        "joint_pos": motion.joint_positions,
        "joint_vel": motion.joint_velocities,
        "joint_names": np.array(robot.joint_names),
        "qpos": qpos,
        "body_names": np.array(robot.link_names),
        "body_pos_w": motion.link_positions,
        "body_quat_w": quaternions,
        "body_lin_vel_w": differentiate(motion.mass_centres, rate),
        "body_ang_vel_w": _compute_angular_velocities(motion.link_rotations, rate),
        "units": np.array("metres, radians, seconds; Z up, floor at 0; quaternions w x y z; velocities in the world"),
    }


def _compute_quaternions(rotations: Float[np.ndarray, "T L 3 3"]) -> Float[np.ndarray, "T L 4"]:
    """Return w x y z without jumps of the sign over time; in the first frame w is not negative."""
    links = [Rotation.from_matrix(rotations[:, link]).as_quat(canonical=True) for link in range(rotations.shape[1])]
    return np.stack([make_quaternions_continuous(each) for each in links], axis=1)[..., [3, 0, 1, 2]]


def _compute_angular_velocities(rotations: Float[np.ndarray, "T L 3 3"], rate: float) -> Float[np.ndarray, "T L 3"]:
    """Return central differences of rotations in the world, radians per second; of a single frame 0."""
    before, after = (np.clip(np.arange(len(rotations)) + step, 0, len(rotations) - 1) for step in (-1, 1))
    vectors = compute_rotation_vectors(rotations[after] @ np.swapaxes(rotations[before], 2, 3))
    return vectors * (rate / np.maximum(after - before, 1))[:, None, None]


def write_robot_csv(target: Path, motion: RobotMotion) -> None:
    """Write the layout of Unitree: no header, x y z, quaternion x y z w, joints. Names and rate are in a JSON beside it."""
    quaternions = _compute_quaternions(motion.link_rotations[:, :1])[:, 0, [1, 2, 3, 0]]
    with replace_atomically(target) as part:
        np.savetxt(part, np.hstack([motion.root_position, quaternions, motion.joint_positions]), "%.6f", ",")
    columns = [*(f"root_{axis}" for axis in "xyz"), *(f"root_q{axis}" for axis in "xyzw"), *motion.robot.joint_names]
    with replace_atomically(target.with_suffix(".columns.json")) as part:
        part.write_text(json.dumps({"fps": motion.rate, "columns": columns}, indent=1) + "\n", encoding="utf-8")


def write_robot_pickle(target: Path, motion: RobotMotion) -> None:
    """Write the dictionary of GMR: quaternions x y z w."""
    content = {
        "fps": motion.rate,
        "root_pos": motion.root_position,
        "root_rot": _compute_quaternions(motion.link_rotations[:, :1])[:, 0, [1, 2, 3, 0]],
        "dof_pos": motion.joint_positions,
        "local_body_pos": None,
        "link_body_list": list(motion.robot.link_names),
        "joint_names": list(motion.robot.joint_names),
    }
    with replace_atomically(target) as part:
        part.write_bytes(pickle.dumps(content))


def build_robot_character(body: RobotBody) -> Character:
    """Return a robot as a character in its upright stance, with Y up, and a mesh of its links, collision shapes and soles."""
    robot, links = body.robot, np.arange(len(body.robot.parents))
    soles = [body.standing.place(LinkPoint(sole.link, corner)) for sole in body.soles.values() for corner in sole.corners]
    positions = (body.standing.positions - [0.0, 0.0, np.min(soles, axis=0)[2]]) @ ROBOT_AXES
    offsets, local_rotations = decompose_transforms(positions, ROBOT_AXES.T @ body.standing.rotations, robot.parents)
    names, no_ends = make_names_unique(robot.link_names), np.full((len(links), 3), np.nan)
    skeleton = Skeleton(names, robot.parents, offsets, no_ends, local_rotations)
    buffer = build_skinned_document(skeleton, robot.parents, _list_shapes(body))
    data = build_glb(GlbContent(buffer.document, buffer.finish()))
    segments = {"pelvis": (0,)} | {name: (start.link,) for name, (start, _) in body.map.limbs.items()}
    source = CharacterSource(robot.name, data, links, "gltf")
    return Character(robot.name, skeleton, BoneMapping(segments, reason=body.map.reason), np.ones(len(links)), source=source)


def _list_shapes(body: RobotBody) -> Sequence[tuple[int, Float[np.ndarray, "C 3"]]]:
    """Return the link of each collision shape and sole, and the corners of its triangles in the link's axes."""
    shapes, heights = body.robot.collision, np.linspace(-1.0, 1.0, 32)[:, None]  # a spiral on the unit sphere
    turns = np.arange(len(heights)) * np.pi * (3.0 - 5.0**0.5)
    sphere = np.hstack([np.sqrt(1.0 - heights**2) * np.stack([np.cos(turns), np.sin(turns)], axis=1), heights])
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    capsules = zip(shapes.ends, shapes.radii, strict=True)
    points = [np.unique((ends[:, None] + radius * sphere).reshape(-1, 3), axis=0) for ends, radius in capsules]
    boxes = zip(shapes.box_centres, shapes.box_rotations, shapes.box_halves, strict=True)
    points += [centre + signs * halves @ rotation.T for centre, rotation, halves in boxes]
    points += [np.vstack([sole.corners, np.zeros(3)]) for sole in body.soles.values()]
    links = [*shapes.links, *shapes.box_links, *(sole.link for sole in body.soles.values())]
    return [(int(link), _triangulate_hull(each)) for link, each in zip(links, points, strict=True)]


def _triangulate_hull(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "C 3"]:
    """Return the corners of the triangles of a convex hull, three each, in the order in which they face outwards."""
    hull = ConvexHull(points, qhull_options="QJ")  # flat ones too
    triangles = points[hull.simplices]
    outward = (np.cross(*np.diff(triangles, axis=1).swapaxes(0, 1)) * hull.equations[:, :3]).sum(axis=1)
    triangles[outward < 0.0] = triangles[outward < 0.0, ::-1]
    return triangles[outward != 0.0].reshape(-1, 3)


def convert_robot_motion(motion: RobotMotion) -> CharacterMotion:
    """Return the motion of a robot as that of its character."""
    positions, rotations = decompose_transforms(motion.link_positions, motion.link_rotations, motion.robot.parents)
    rotations[:, 0] = ROBOT_AXES.T @ rotations[:, 0]
    joints = motion.robot.is_slide | motion.robot.joint_anchors.any(axis=1)  # those that move the origin of their link
    moved = {int(link): positions[:, link] for link in motion.robot.joint_links[joints]}
    return CharacterMotion(positions[:, 0] @ ROBOT_AXES, rotations, motion.rate, moved)
