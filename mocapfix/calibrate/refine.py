"""Bones, marker places and the poses of many frames fitted together.

Levenberg-Marquardt over the unknowns that the frames share (size, bone groups' scales, marker places); at each step the
frames' poses are solved anew and eliminated exactly (variable projection; Golub & Pereyra 1973), so that the step sees
how the poses give way. The nominal places and lengths are the prior that settles what the take leaves open.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.kernels import kinematics
from mocapfix.kernels.levenberg import Attached, Tree
from mocapfix.kernels.problem import Problem, no_pull, pull_to
from mocapfix.kernels.registration import poses
from mocapfix.kernels.shared import add_frames
from mocapfix.kernels.threads import over_frames
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


def problem_of(start: Subject, body: Body, prior: Prior, markers: np.ndarray, shape: Shape) -> Problem:
    """-> the pose problem of frames (N, K, 3) on the body that `shape` makes of `start`."""
    groups = group_of(body)
    scale = np.exp(shape.size + np.where(groups >= 0, shape.groups[groups], 0.0))
    tree = Tree(start.skeleton.parents, start.skeleton.offsets * scale[:, None], body.free)
    pull = pull_to(prior.weakened(PRIOR_WEIGHT))
    return Problem(tree, Attached(start.joints, shape.places), markers, ~np.isnan(markers[..., 0]), MARKER_SD, pull)


def unchanged(start: Subject, body: Body) -> Shape:
    """-> the shape that leaves `start` as it is."""
    return Shape(0.0, np.zeros(len(body.groups)), start.places.copy())


def posed(start: Subject, body: Body, prior: Prior, markers: np.ndarray) -> Motion:
    """-> poses of frames (N, K, 3) on a body not yet calibrated, robustly, so that spikes do not pass for variety."""
    motion = poses(start, body.free, prior, markers)
    problem = problem_of(start, body, prior, markers, unchanged(start, body))
    problem.solve(motion.root, motion.rotations, no_pull(len(body.free)), (0.4, 0.2, 0.1), 8)
    return motion


def refined(start: Subject, body: Body, prior: Prior, markers: np.ndarray, motion: Motion) -> Subject:
    """-> `start` with the bones and places that fit the frames `markers` (N, K, 3), posed by `motion`, best."""
    root, local = motion.root.copy(), motion.rotations.copy()
    shape, damping, last, system = unchanged(start, body), 1e-3, np.inf, None
    for _ in range(ROUNDS):
        trial = shape if system is None else shape.moved(step(*system, damping))
        problem, trial_root, trial_local = problem_of(start, body, prior, markers, trial), root.copy(), local.copy()
        problem.solve(trial_root, trial_local, no_pull(len(body.free)), (ROBUST,), 6)
        cost, *trial_system = reduced(problem, group_of(body), trial_root, trial_local, start, trial)
        if cost < last:
            enough = last - cost < ENOUGH * cost
            shape, root, local, last, system = trial, trial_root, trial_local, cost, trial_system
            damping = max(damping / 5, 1e-6)
            if enough:
                break
        else:
            damping *= 10
            if damping > 1e3:
                break
    return finished(start, problem_of(start, body, prior, markers, shape), root, local)


def reduced(problem: Problem, groups: np.ndarray, root, local, start: Subject, shape: Shape):
    """-> cost, curvature (P, P) and gradient (P,) of the shared unknowns with the poses eliminated and priors added."""
    frames, count = len(root), len(shape.groups)
    unknowns = 1 + count + shape.places.size
    curvature, gradient, cost = np.zeros((frames, unknowns, unknowns)), np.zeros((frames, unknowns)), np.zeros(frames)
    over_frames(
        add_frames, frames, problem.tree, problem.attached, groups, count, problem.seen, problem.weight,
        problem.scales2((ROBUST,))[0], no_pull(len(groups)), problem.prior, root, local, curvature, gradient, cost,
    )  # fmt: skip
    away = np.r_[0.0, shape.groups, (shape.places - start.places).ravel()]
    information = np.r_[1e-6, np.full(count, 1 / GROUP_SD**2), np.full(shape.places.size, 1 / PLACE_SD**2)]
    total = cost.sum() + 0.5 * (information * away**2).sum()
    return total, curvature.sum(0) + np.diag(information), gradient.sum(0) + information * away


def step(curvature, gradient, damping) -> np.ndarray:
    """-> (P,) the damped Gauss-Newton step (Marquardt 1963)."""
    symmetric = (curvature + curvature.T) / 2
    return np.linalg.solve(symmetric + damping * np.diag(np.diag(symmetric)), -gradient)


def finished(start: Subject, problem: Problem, root: np.ndarray, local: np.ndarray) -> Subject:
    """-> the subject of a solved problem; a marker's spread is the median of its distances, per axis."""
    tree, places = problem.tree, problem.attached.places
    size = np.linalg.norm(tree.offsets) / np.linalg.norm(start.skeleton.offsets)
    skeleton = replace(start.skeleton, offsets=tree.offsets, ends=start.skeleton.ends * size)
    subject = replace(start, skeleton=skeleton, places=places, frames=len(root))
    nothing = np.zeros(len(root), int)
    placed = kinematics.markers(subject, *kinematics.world(skeleton, Motion(root, local, nothing, nothing, np.zeros(0), np.zeros(0))))
    distance = np.linalg.norm(problem.markers - placed, axis=-1)
    seen = (~np.isnan(distance)).any(0)
    spread = start.spread.copy()
    spread[seen] = np.sqrt(np.nanmedian(distance[:, seen] ** 2, axis=0) / 3)
    return replace(subject, spread=spread)
