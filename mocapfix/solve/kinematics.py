"""Forward kinematics of motions: world positions of joints and markers; and legs that reach a place, in closed form."""

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels import lie
from mocapfix.kernels.forward_kinematics import KinematicTree, compute_marker_frames, compute_world_frames
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, find_common_joint
from mocapfix.model.subject import Subject
from mocapfix.solve.parallel import run_in_parallel, run_over_frames
from mocapfix.stats.rigid_alignment import compute_lengths, compute_shortest_rotations, split_along_line
from mocapfix.stats.sequences import interpolate_rows, smooth_path

Poses: TypeAlias = tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T J 3 3"]]  # root positions in metres and local rotations


def build_kinematic_tree(skeleton: Skeleton) -> KinematicTree:
    """Return the skeleton for the kernels, all joints free."""
    return KinematicTree(skeleton.parents, skeleton.offsets, np.ones(len(skeleton.parents), bool))


def compute_world_poses(skeleton: Skeleton, motion: Motion) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
    """Return joint positions in metres and rotations, in the world."""
    return compute_tree_poses(build_kinematic_tree(skeleton), motion.root_position, motion.local_rotations)


def compute_tree_poses(
    tree: KinematicTree, root_position: Float[np.ndarray, "T 3"], local_rotations: Float[np.ndarray, "T J 3 3"]
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
    """Return joint positions in metres and rotations, in the world, of poses of a tree."""
    position, rotation = np.empty(local_rotations.shape[:3]), np.empty(local_rotations.shape)
    run_over_frames(compute_world_frames, len(root_position), tree, root_position, local_rotations, position, rotation)
    return position, rotation


def interpolate_poses(poses: Poses, frames: Int[np.ndarray, " N"], frame_count: int) -> Poses:
    """Return the poses of all frames of a take, given those of some, the first and the last among them, in rising order."""
    every, rotations = np.arange(frame_count), np.ascontiguousarray(poses[1])
    between, is_known = np.empty((frame_count, *rotations.shape[1:])), np.ones(len(frames), bool)

    def interpolate_joint(joint: int) -> None:
        quaternions = lie.extract_joint_quaternions(rotations, joint, is_known)
        lie.store_joint_quaternions(interpolate_rows(quaternions, frames, every), joint, between)

    run_in_parallel(interpolate_joint, range(rotations.shape[1]))
    return interpolate_rows(poses[0], frames, every), between


def compute_anchor_offset(tree: KinematicTree, local_rotations: Float[np.ndarray, "T J 3 3"]) -> Float[np.ndarray, "T 3"]:
    """Return the position relative to the root, in metres, of the joint nearest to it whose motion markers show.

    It is 0 for a whole body. The root of a part of a body may be far from all markers, so that a small rotation displaces it far.
    """
    origin, free_below_root = np.zeros((len(local_rotations), 3)), np.flatnonzero(tree.free)[1:].tolist()
    anchor = find_common_joint(tree.parents, free_below_root) if free_below_root else 0
    return compute_tree_poses(tree, origin, local_rotations)[0][:, anchor] if anchor else origin


def compute_joint_and_marker_positions(
    subject: Subject, motion: Motion
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T K 3"]]:
    """Return world positions of the joints and of the subject's markers, in metres."""
    return _compute_positions(subject, (motion.root_position, motion.local_rotations))


def predict_markers(subject: Subject, pose: Poses) -> Float[np.ndarray, "T K 3"]:
    """Return where the body carries the subject's markers, in metres."""
    return _compute_positions(subject, pose)[1]


def compute_marker_distances(subject: Subject, pose: Poses, markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T K"]:
    """Return the distances in metres of markers from where the body carries them, NaN where missing."""
    predicted = predict_markers(subject, pose)
    return compute_lengths(np.subtract(markers, predicted, out=predicted))


def _compute_positions(subject: Subject, pose: Poses) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T K 3"]]:
    frames = len(pose[0])
    joints, markers = np.empty(pose[1].shape[:3]), np.empty((frames, len(subject.joints), 3))
    run_over_frames(
        compute_marker_frames, frames, build_kinematic_tree(subject.skeleton), subject.joints, subject.marker_offsets, *pose,
        joints, markers,
    )  # fmt: skip
    return joints, markers


PLANE_REACH_M = 0.01  # distance of a knee from the line from hip to ankle below which its usual plane counts
MIN_LENGTH_M = 1e-9  # of a vector that has a direction


class LegPath(NamedTuple):
    """The joints of one leg in the world, in every frame, in metres."""

    hip: Float[np.ndarray, "T 3"]
    knee: Float[np.ndarray, "T 3"]
    ankle: Float[np.ndarray, "T 3"]
    usual_bend: Float[np.ndarray, "T 3"]  # the direction in which the knee bends, of length 1

    @classmethod
    def build(cls, joints: Float[np.ndarray, "T 3 3"], thigh_axes: Float[np.ndarray, "T 3 3"]) -> "LegPath":
        """Return the leg of hip, knee and ankle; its knee usually bends as it does on average, in the axes of its thigh."""
        hip, knee, ankle = joints.swapaxes(0, 1)
        bend = thigh_axes @ np.einsum("tji,tj->i", thigh_axes, split_along_line(knee, hip, ankle)[1])
        bend = split_along_line(hip + bend, hip, ankle)[1]
        return cls(hip, knee, ankle, bend / measure_length(bend)[:, None])

    @property
    def lengths_m(self) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]:
        """The lengths of thigh and shin."""
        return measure_length(self.knee - self.hip), measure_length(self.ankle - self.knee)

    @property
    def knee_angle(self) -> Float[np.ndarray, " T"]:
        """The angle between thigh and shin in radians, pi for a straight leg."""
        return self.find_knee_angle(measure_length(self.ankle - self.hip))

    def find_knee_angle(self, reach_m: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """Return the angle with which the ankle is at a distance from the hip; that of a straight leg if it is too far."""
        thigh, shin = self.lengths_m
        return np.arccos(np.clip((thigh**2 + shin**2 - reach_m**2) / (2 * thigh * shin), -1, 1))

    def measure_reach(self, knee_angle: Float[np.ndarray, " T"]) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]:
        """Return the distance of the ankle from the hip, in metres, and its change with the angle, in m/rad."""
        thigh, shin = self.lengths_m
        reach = np.sqrt(np.maximum(thigh**2 + shin**2 - 2 * thigh * shin * np.cos(knee_angle), 1e-9))
        return reach, thigh * shin * np.sin(knee_angle) / reach

    def pose(
        self, hip: Float[np.ndarray, "T 3"], ankle: Float[np.ndarray, "T 3"], reach_m: Float[np.ndarray, " T"]
    ) -> tuple["LegPath", Float[np.ndarray, "T 3 3"], Float[np.ndarray, "T 3 3"]]:
        """Return the leg with its hip at another place, and the turns of thigh and shin in the world.

        Its ankle is at a distance from the hip, in the direction of another place. The knee stays in the plane of the leg; where
        that is nearly straight, it bends as it usually does.
        """
        thigh, shin = self.lengths_m
        direction = (ankle - hip) / measure_length(ankle - hip)[:, None]
        along = (thigh**2 + reach_m**2 - shin**2) / (2 * reach_m)
        across = np.sqrt(np.maximum(thigh**2 - along**2, 0.0))
        turn = compute_shortest_rotations(self.ankle - self.hip, direction)
        bend = split_along_line(self.knee, self.hip, self.ankle)[1]
        change_m = across - measure_length(bend)
        bend = bend + self.usual_bend * (change_m**2 / (np.abs(change_m) + PLANE_REACH_M))[:, None]
        bend = np.einsum("tij,tj->ti", turn, bend / measure_length(bend)[:, None])
        knee, ankle = hip + along[:, None] * direction + across[:, None] * bend, hip + reach_m[:, None] * direction
        thigh_turn, shin_turn = (
            compute_shortest_rotations(np.einsum("tij,tj->ti", turn, old), new) @ turn
            for old, new in ((self.knee - self.hip, knee - hip), (self.ankle - self.knee, ankle - knee))
        )
        return self._replace(hip=hip, knee=knee, ankle=ankle), thigh_turn, shin_turn


def measure_length(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, " T"]:
    """Return the length of each vector, at least a nanometre."""
    return np.maximum(np.linalg.norm(vectors, axis=1), MIN_LENGTH_M)


ANKLE_SD_M = 0.002  # standard deviation of an ankle about where its foot is held: it yields for a knee not to jump
KNEE_CHANGE_SD_RAD = 0.05
KNEE_TIME_S = 0.05  # size and time constant of the change of a knee's angle
MIN_REACH_CHANGE_M = 0.014  # change of a leg's reach by the knee's angle, per radian, below which it counts as straight


def reach_ankle(
    leg: LegPath, hip: Float[np.ndarray, "T 3"], ankle: Float[np.ndarray, "T 3"], rate: float
) -> Float[np.ndarray, " T"]:
    """Return the distances from a hip at which a leg has its ankle near a place, in metres.

    The knee's angle changes smoothly: where the leg is nearly straight, the ankle yields along it.
    """
    angle = leg.knee_angle
    wanted = leg.find_knee_angle(measure_length(ankle - hip)) - angle
    change = leg.measure_reach(np.minimum(angle, angle + wanted))[1]
    variance = rate * (ANKLE_SD_M / np.maximum(change, MIN_REACH_CHANGE_M)) ** 2
    power = np.full(len(angle), (KNEE_CHANGE_SD_RAD / KNEE_TIME_S**2) ** 2)
    return leg.measure_reach(np.minimum(angle + smooth_path(wanted[:, None], variance, power, rate)[:, 0], np.pi))[0]
