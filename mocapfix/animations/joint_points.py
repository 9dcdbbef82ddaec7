"""An animation's joints as points in the world: takes of them, for what looks at points and not at turns."""

import numpy as np

from mocapfix.animation import Animation
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take


def convert_to_take(capture: Take | Animation) -> Take:
    """Return a take as it is, and an animation as the take of its joints."""
    return build_joint_take(capture) if isinstance(capture, Animation) else capture


def build_joint_take(animation: Animation) -> Take:
    """-> the take of an animation: where each joint is."""
    return _build_point_take(animation, animation.compute_world_poses()[0], animation.names)


def build_tip_take(animation: Animation) -> Take:
    """-> the take by which its cleaning is told: where each joint's tip is, the middle of its children and end sites, and last
    the root. A joint that turns wrongly is at its place all the same, but its tip is not."""
    position, rotation = animation.compute_world_poses()
    markers = np.empty((animation.frame_count, len(animation.names) + 1, 3))
    for j in range(len(animation.names)):
        ends = animation.end_sites[j] @ animation.rotation_y_up_file.T * animation.unit_m
        beyond = position[:, [j]] + ends @ np.swapaxes(rotation[:, j], -1, -2)
        points = np.concatenate([position[:, animation.parents == j], beyond], axis=1)
        markers[:, j] = points.mean(1) if points.shape[1] else position[:, j]
    markers[:, -1] = position[:, 0]
    return _build_point_take(animation, markers, (*animation.names, f"{animation.names[0]}'s place"))


def get_animation(points: Take) -> Animation:
    """-> the animation that moves the points."""
    assert isinstance(points.layout, Animation)
    return points.layout


def compute_point_deviation(points: Take, variance: np.ndarray) -> np.ndarray:
    """-> (T, M) metres per axis: how unsure the tips or places of an animation's joints are where its joints' turns and last
    the root's place have a variance (T, J + 1), rad^2 and m^2 per axis.

    A turn by a small angle about an axis moves a point by that times its distance from the axis.
    """
    unsure, animation = np.flatnonzero(variance.any(1)), get_animation(points)
    joints, variance = animation.replace_values(animation.values[unsure]).compute_world_poses()[0], variance[unsure]
    square = np.tile(variance[:, -1:], (1, len(points.labels)))
    for j in range(len(animation.parents)):
        at = j
        while at >= 0:
            square[:, j] += variance[:, at] * ((points.markers[unsure, j] - joints[:, at]) ** 2).sum(-1) * 2 / 3
            at = animation.parents[at]
    out = np.zeros(points.visible.shape)
    out[unsure] = np.sqrt(square)
    return out


def build_joint_skeleton(animation: Animation) -> tuple[Skeleton, np.ndarray]:
    """-> the file's own skeleton, and (T, J, 3) metres: where its joints are."""
    offsets = animation.offsets @ animation.rotation_y_up_file.T * animation.unit_m
    return Skeleton(animation.names, animation.parents, offsets, np.full(offsets.shape, np.nan)), animation.compute_world_poses()[
        0
    ]


def _build_point_take(animation: Animation, markers: np.ndarray, labels: tuple[str, ...]) -> Take:
    return Take(markers, labels, animation.rate, animation.first_frame, animation.path, layout=animation, notes=animation.notes)
