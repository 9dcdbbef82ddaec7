"""Takes of an animation's joints as points in the world, for code that processes points instead of rotations."""

import numpy as np
from jaxtyping import Float

from mocapfix.animation import Animation
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take


def build_joint_take(animation: Animation) -> Take:
    """Build the take of an animation's joint positions."""
    return _build_point_take(animation, animation.compute_world_poses()[0], animation.names)


def build_tip_take(animation: Animation) -> Take:
    """Build the take of an animation's joint tips, followed by the position of the joint that moves the figure.

    The tip of a joint is the mean of its children and end sites. A rotation error of a joint displaces its tip but not the
    joint itself, so faults and changes refer to tips.
    """
    positions, rotations = animation.compute_world_poses()
    points = np.empty((animation.frame_count, len(animation.names) + 1, 3))
    for joint in range(len(animation.names)):
        end_offsets = animation.end_sites[joint] @ animation.rotation_y_up_file.T * animation.unit_m
        end_positions = positions[:, [joint]] + end_offsets @ np.swapaxes(rotations[:, joint], -1, -2)
        outer = np.concatenate([positions[:, animation.parents == joint], end_positions], axis=1)
        points[:, joint] = outer.mean(1) if outer.shape[1] else positions[:, joint]
    points[:, -1] = positions[:, animation.moving_joint]
    return _build_point_take(animation, points, list_track_names(animation.names, animation.moving_joint))


def list_track_names(joint_names: tuple[str, ...], moving_joint: int = 0) -> tuple[str, ...]:
    """Return the names of an animation's J + 1 tracks: the rotations of its joints and the position of the one that moves it."""
    return (*joint_names, f"{joint_names[moving_joint]} position")


def compute_joint_point_sd(animation: Animation, points: Take, variance: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T M"]:
    """Compute the standard deviations per axis, in metres, of an animation's joints or tips from those of its tracks.

    points    as from `build_joint_take` or `build_tip_take`
    variance  per axis, of the joints' rotations (rad^2) and of the root's position (m^2), as the last of N = J + 1 tracks

    A small rotation about an axis moves a point by the angle times the point's distance from the axis.
    """
    frames = np.flatnonzero(variance.any(1))
    positions, frame_variance = animation.replace_values(animation.values[frames]).compute_world_poses()[0], variance[frames]
    squared = np.tile(frame_variance[:, -1:], (1, len(points.labels)))
    for joint in range(len(animation.parents)):
        ancestor = joint
        while ancestor >= 0:
            squared_distance = ((points.markers[frames, joint] - positions[:, ancestor]) ** 2).sum(-1)
            squared[:, joint] += frame_variance[:, ancestor] * squared_distance * 2 / 3
            ancestor = animation.parents[ancestor]
    sd = np.zeros(points.visible.shape)
    sd[frames] = np.sqrt(squared)
    return sd


def build_joint_skeleton(animation: Animation) -> tuple[Skeleton, Float[np.ndarray, "T J 3"]]:
    """Return the file's own skeleton and the positions of its joints in the world, in metres."""
    offsets = animation.bone_offsets @ animation.rotation_y_up_file.T * animation.unit_m
    skeleton = Skeleton(animation.names, animation.parents, offsets, np.full(offsets.shape, np.nan))
    return skeleton, animation.compute_world_poses()[0]


def _build_point_take(animation: Animation, points: Float[np.ndarray, "T M 3"], labels: tuple[str, ...]) -> Take:
    return Take(
        points,
        labels,
        animation.rate,
        animation.first_frame,
        animation.path,
        notes=animation.notes,
        point_kind="joint",
    )
