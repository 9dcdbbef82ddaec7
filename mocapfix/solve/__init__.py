"""The solve: the pose of every frame that agrees best with markers, prior and time."""

from dataclasses import dataclass

import numpy as np

from mocapfix.kernels.levenberg import Attached, Pull, Tree, solve_frames, uncertainties
from mocapfix.kernels.threads import over_frames
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.skeleton import Body
from mocapfix.solve import recall, temporal
from mocapfix.subject import Subject
from mocapfix.take import Take


@dataclass(frozen=True)
class SolveOptions:
    """How the solve weighs what it is told."""

    marker_sd: float = 0.010
    """how far a sound marker lies from its place on the body, metres (standard deviation per axis)"""
    robust: tuple[float, ...] = (0.2, 0.1, 0.05)
    """Geman-McClure scales, metres, one after the other: a marker farther off than the last hardly counts"""
    habit: float = 1.0
    """how long a pose goes on, seconds: the prior speaks once in that time, not anew in every frame"""
    turn_sd: float = 0.02
    """how far a joint strays from its smooth course, radians"""
    shift_sd: float = 0.003
    """how far the root strays from its smooth course, metres"""


def motion(worn: Take, subject: Subject, body: Body, prior: Prior, start: Motion, options: SolveOptions) -> Motion:
    """-> poses, and the standard deviation of every marker the body places.

    Each frame is solved alone first; the joints' smooth courses through what that says, and how surely, then pull the
    frames to each other in a second solve.

    worn  the take's markers in the subject's order, NaN where not seen or not believed
    """
    tree, attached = Tree(subject.skeleton.parents, subject.skeleton.offsets, body.free), Attached(subject.joints, subject.places)
    believed = ~np.isnan(worn.markers[..., 0])
    seen, weight = np.where(believed[..., None], worn.markers, 0.0), believed / options.marker_sd**2
    scales2 = (np.array(options.robust) / options.marker_sd) ** 2
    joints = len(tree.parents)
    said_once = prior.weakened(1 / (options.habit * worn.rate))
    pose = Pull(prior.rotations[None], said_once.information[None], np.zeros((1, 3)), np.zeros(1))
    none = Pull(np.zeros((1, joints, 3, 3)), np.zeros((1, joints, 3, 3)), np.zeros((1, 3)), np.zeros(1))
    frames = worn.frames
    root, local = start.root.copy(), start.rotations.copy()
    status, iterations = np.zeros(frames, int), np.zeros(frames, int)
    deviation, variance, root_variance = np.zeros(weight.shape), np.zeros((frames, joints)), np.zeros(frames)
    over_frames(solve_frames, frames, tree, attached, seen, weight, scales2, none, pose, root, local, 12, status, iterations)
    over_frames(
        uncertainties, frames, tree, attached, seen, weight, scales2[-1], none, pose, root, local, deviation, variance, root_variance
    )
    known, sure = recall.recalled(root, local, variance, body.free, worn.rate)
    target = smooth(root, known, sure, root_variance, body.free, worn.rate, options)
    spent = iterations.copy()
    root, local = target.root.copy(), target.rotations.copy()
    over_frames(solve_frames, frames, tree, attached, seen, weight, scales2[-1:], target, pose, root, local, 12, status, iterations)
    over_frames(
        uncertainties, frames, tree, attached, seen, weight, scales2[-1], target, pose, root, local, deviation, variance, root_variance
    )
    status[believed.sum(1) < 3] = 3
    return Motion(root, local, status, spent + iterations, deviation)


def smooth(root, local, variance, root_variance, free, rate, options: SolveOptions) -> Pull:
    """-> the smooth course of every free joint and the root, as a pull for each frame."""
    rotations, information = local.copy(), np.zeros_like(local)
    for j in np.flatnonzero(free):
        rotations[:, j] = temporal.smoothed_rotations(local[:, j], variance[:, j], rate)
        information[:, j] = np.eye(3) / options.turn_sd**2
    smooth_root = temporal.smoothed_root(root, root_variance, rate)
    return Pull(rotations, information, smooth_root, np.full(len(root), 1 / options.shift_sd**2))
