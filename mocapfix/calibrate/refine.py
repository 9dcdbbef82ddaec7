"""Bones, marker places and the poses of many frames fitted together.

Levenberg-Marquardt over the unknowns that the frames share (size, bone groups' scales, marker places); at each step the
frames' poses are solved anew and eliminated exactly (variable projection; Golub & Pereyra 1973), so that the step sees
how the poses give way. The nominal places and lengths are the prior that settles what the take leaves open.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.kernels.levenberg import Attached, Pull, Tree, solve_frames
from mocapfix.kernels.registration import poses
from mocapfix.kernels.shared import add_frames
from mocapfix.kernels.threads import over_frames
from mocapfix.marker_set import MarkerSet
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.skeleton import Body
from mocapfix.subject import Subject

MARKER_SD = 0.020  # metres: skin and place together, and not independent from frame to frame
ROBUST = 0.050  # metres: Geman-McClure scale
PLACE_SD = 0.020  # metres: a person's marker about the average body's place
GROUP_SD = 0.08  # logarithm of a bone group's scale
PRIOR_WEIGHT = 0.01  # a take's mean pose is not people's mean pose: full weight would bend bones and places to it
ROUNDS = 25
ENOUGH = 1e-3  # relative fall of the cost under which calibration ends


@dataclass
class Shape:
    """The shared unknowns: log of the size, logs of G group scales, marker places (K, 3) in metres."""

    size: float
    groups: np.ndarray
    places: np.ndarray

    def moved(self, step: np.ndarray) -> "Shape":
        g = len(self.groups)
        return Shape(self.size + step[0], self.groups + step[1 : 1 + g], self.places + step[1 + g :].reshape(-1, 3))


def group_of(body: Body) -> np.ndarray:
    """-> (J,) index of each joint's bone group, -1 for none."""
    of = np.full(len(body.skeleton.names), -1)
    for g, joints in enumerate(body.groups.values()):
        of[list(joints)] = g
    return of


def pull_to(prior: Prior) -> Pull:
    """-> the pose prior as a pull, as weak as calibration wants it."""
    return Pull(prior.rotations[None], prior.weakened(PRIOR_WEIGHT).information[None], np.zeros((1, 3)), np.zeros(1))


def no_pull(joints: int) -> Pull:
    """-> a pull that pulls nothing."""
    return Pull(np.zeros((1, joints, 3, 3)), np.zeros((1, joints, 3, 3)), np.zeros((1, 3)), np.zeros(1))


def tree_of(subject: Subject, body: Body, groups: np.ndarray, shape: Shape | None = None) -> Tree:
    offsets = subject.skeleton.offsets
    if shape is not None:
        offsets = offsets * np.exp(shape.size + np.where(groups >= 0, shape.groups[groups], 0.0))[:, None]
    return Tree(subject.skeleton.parents, offsets, body.free)


def solve(tree, attached, markers, prior, motion, scales, most) -> None:
    """Solve the frames' poses in place from where they are."""
    believed = ~np.isnan(markers[..., 0])
    weight = believed / MARKER_SD**2
    seen = np.where(believed[..., None], markers, 0.0)
    scales2 = (np.asarray(scales) / MARKER_SD) ** 2
    none = no_pull(len(tree.parents))
    over_frames(
        solve_frames, len(markers), tree, attached, seen, weight, scales2, none, prior, motion.root, motion.rotations, most,
        motion.status, motion.iterations,
    )  # fmt: skip


def posed(start: Subject, body: Body, prior: Prior, markers: np.ndarray) -> Motion:
    """-> poses of frames (N, K, 3) on a body not yet calibrated, robustly, so that spikes do not pass for variety."""
    motion = poses(start, body.free, prior, markers)
    tree, attached = tree_of(start, body, group_of(body)), Attached(start.joints, start.places)
    solve(tree, attached, markers, pull_to(prior), motion, (0.4, 0.2, 0.1), 8)
    return motion


def refined(start, body, prior, marker_set: MarkerSet, markers, motion: Motion, chosen: np.ndarray) -> Subject:
    """-> `start` with the bones and places that fit the frames `markers` (N, K, 3) best; their poses are motion[chosen]."""
    motion = Motion(*(np.ascontiguousarray(field[chosen]) for field in vars(motion).values()))
    groups, pull = group_of(body), pull_to(prior)
    believed = ~np.isnan(markers[..., 0])
    seen, weight = np.where(believed[..., None], markers, 0.0), believed / MARKER_SD**2
    shape = Shape(0.0, np.zeros(len(body.groups)), start.places.copy())
    damping, last = 1e-3, np.inf
    system = None
    for _ in range(ROUNDS):
        trial_motion = Motion(*(field.copy() for field in vars(motion).values()))
        trial = shape if system is None else shape.moved(step(*system, damping))
        tree, attached = tree_of(start, body, groups, trial), Attached(start.joints, trial.places)
        solve(tree, attached, markers, pull, trial_motion, (ROBUST,), 6)
        now = reduced(tree, attached, groups, len(body.groups), seen, weight, pull, trial_motion, start, trial)
        if now[0] < last:
            enough = last - now[0] < ENOUGH * now[0]
            shape, motion, last, system = trial, trial_motion, now[0], now[1:]
            damping = max(damping / 5, 1e-6)
            if enough:
                break
        else:
            damping = max(damping * 10, 1e-3)
            if damping > 1e3:
                break
    return finished(start, body, groups, shape, markers, motion)


def reduced(tree, attached, groups, count, seen, weight, pull, motion, start, shape):
    """-> cost, curvature (P, P) and gradient (P,) of the shared unknowns with the poses eliminated and priors added."""
    frames, unknowns = len(seen), 1 + count + 3 * len(attached.joints)
    curvature, gradient, cost = np.zeros((frames, unknowns, unknowns)), np.zeros((frames, unknowns)), np.zeros(frames)
    none = no_pull(len(tree.parents))
    over_frames(
        add_frames, frames, tree, attached, groups, count, seen, weight, (ROBUST / MARKER_SD) ** 2, none, pull, motion.root,
        motion.rotations, curvature, gradient, cost,
    )  # fmt: skip
    away = np.r_[0.0, shape.groups, (shape.places - start.places).ravel()]
    information = np.r_[1e-6, np.full(count, 1 / GROUP_SD**2), np.full(shape.places.size, 1 / PLACE_SD**2)]
    total = cost.sum() + 0.5 * (information * away**2).sum()
    return total, curvature.sum(0) + np.diag(information), gradient.sum(0) + information * away


def step(curvature, gradient, damping) -> np.ndarray:
    """-> (P,) the damped Gauss-Newton step (Marquardt 1963)."""
    symmetric = (curvature + curvature.T) / 2
    return np.linalg.solve(symmetric + damping * np.diag(np.diag(symmetric)), -gradient)


def finished(start, body, groups, shape, markers, motion) -> Subject:
    tree, attached = tree_of(start, body, groups, shape), Attached(start.joints, shape.places)
    skeleton = replace(start.skeleton, offsets=tree.offsets, ends=start.skeleton.ends * np.exp(shape.size))
    from mocapfix.kernels.kinematics import markers as carried
    from mocapfix.kernels.kinematics import world

    subject = replace(start, skeleton=skeleton, places=shape.places, frames=len(markers))
    distance = np.linalg.norm(markers - carried(subject, *world(skeleton, motion)), axis=-1)
    seen = (~np.isnan(distance)).any(0)
    spread = start.spread.copy()
    spread[seen] = np.sqrt(np.nanmedian(distance[:, seen] ** 2, axis=0) / 3)
    return replace(subject, spread=spread)
