"""Bones, marker places and the poses of many frames fitted together.

Levenberg-Marquardt over the unknowns that the frames share (size, bones, marker places); at each step the
frames' poses are solved anew and eliminated exactly (variable projection; Golub & Pereyra 1973), so that the step sees
how the poses give way. The nominal places and lengths are the prior that settles what the take leaves open.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.calibrate import freedom
from mocapfix.calibrate.freedom import Freedom
from mocapfix.kernels import kinematics
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.problem import Attached, Problem, no_limits, no_pull, pull_to
from mocapfix.kernels.registration import poses
from mocapfix.kernels.shared import Responses, reduced, responses
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.skeleton import Body
from mocapfix.subject import Subject

MARKER_SD = 0.010  # metres: skin slides less, but neighbouring frames tell the same of it
ROBUST = 0.050  # metres: Geman-McClure scale
POSE_WEIGHT = 0.02  # of how poses stray from their take's mean: with more, longer bones win, for on them all turns are smaller
ROUNDS = 25
ENOUGH = 1e-3  # relative fall of the cost under which calibration ends


@dataclass(frozen=True)
class Fit:
    """A body, the poses of N frames on it, and what they say of the shared unknowns (Q,) there.

    cost       half a sum of squares in standard deviations, priors included
    curvature  (Q, Q) its second derivative and (Q,) its slope, the poses giving way
    """

    unknowns: np.ndarray
    problem: Problem
    root: np.ndarray
    local: np.ndarray
    found: Responses
    cost: float
    curvature: np.ndarray
    gradient: np.ndarray


def problem_of(start: Subject, body: Body, prior: Prior, markers: np.ndarray, offsets, places, turns) -> Problem:
    """-> the pose problem of frames (N, K, 3) on a body with these offsets (J, 3) and marker places (K, 3), their mean pose
    turned from people's by (J, 3) radians."""
    tree, pull = Tree(start.skeleton.parents, offsets, body.free), pull_to(prior.within().weakened(POSE_WEIGHT))
    listened, limits = ~np.isnan(markers[..., 0]), no_limits(len(offsets))
    return Problem(tree, Attached(start.joints, places), markers, listened, MARKER_SD, pull._replace(vectors=turns), limits)


def posed(start: Subject, body: Body, prior: Prior, markers: np.ndarray) -> Motion:
    """-> poses of frames (N, K, 3) on a body not yet calibrated, robustly, so that spikes do not pass for variety."""
    motion = poses(start, body.free, prior, markers)
    problem = problem_of(start, body, prior, markers, start.skeleton.offsets, start.places, np.zeros((len(body.free), 3)))
    problem.solve(motion.root, motion.rotations, no_pull(len(body.free)), (0.4, 0.2, 0.1), 8)
    return motion


def refined(start: Subject, body: Body, prior: Prior, markers: np.ndarray, motion: Motion) -> Subject:
    """-> `start` with the bones and places that fit the frames `markers` (N, K, 3), posed by `motion`, best."""
    free = freedom.of(start, body, prior)

    def fit(unknowns: np.ndarray, root: np.ndarray, local: np.ndarray) -> Fit:
        return fitted(free, problem_of(start, body, prior, markers, *free.body(unknowns)), unknowns, root.copy(), local.copy())

    best, damping = fit(np.zeros(len(free.information)), motion.root, motion.rotations), 1e-3
    for _ in range(ROUNDS):
        trial = fit(best.unknowns + step(best.curvature, best.gradient, damping), best.root, best.local)
        if trial.cost < best.cost:
            enough = best.cost - trial.cost < ENOUGH * trial.cost
            best, damping = trial, max(damping / 5, 1e-6)
            if enough:
                break
        else:
            damping *= 10
            if damping > 1e3:
                break
    return finished(start, best)


def fitted(free: Freedom, problem: Problem, unknowns: np.ndarray, root: np.ndarray, local: np.ndarray) -> Fit:
    """-> the frames solved anew from the poses given, which are spoilt, and what they and the priors say together."""
    problem.solve(root, local, no_pull(local.shape[1]), (ROBUST,), 6)
    return linearised(free, problem, unknowns, root, local)


def linearised(free: Freedom, problem: Problem, unknowns: np.ndarray, root: np.ndarray, local: np.ndarray) -> Fit:
    """-> what frames and priors say together at these poses, as they are."""
    still = no_pull(local.shape[1])
    found = responses(problem, free.deformations, still, ROBUST, root, local)
    curvature, gradient = reduced(found)
    habit = free.information @ unknowns
    cost = float(found.cost.sum() + 0.5 * unknowns @ habit)
    return Fit(unknowns, problem, root, local, found, cost, curvature + free.information, gradient + habit)


def step(curvature: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    """-> (Q,) the damped Gauss-Newton step (Marquardt 1963)."""
    return np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient)


def doubt(found: Responses, curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> standard deviations per axis, metres, by which what is left open of the shared unknowns displaces the joints (J,)
    and the markers (K,), each frame's pose giving way; root mean squares over the frames.

    curvature  (Q, Q) of the shared unknowns, priors included: their inverse covariance
    """
    half = np.linalg.inv(np.linalg.cholesky(curvature))  # half' half is the covariance
    displaced = (half @ moved.reshape(*moved.shape[:2], -1) for moved in (found.carried, found.moved[:, :-1]))
    joints, markers = (np.sqrt((d**2).sum(1).mean(0).reshape(-1, 3).mean(1)) for d in displaced)
    return joints, markers


def finished(start: Subject, fit: Fit) -> Subject:
    """-> the subject of a fit; a marker's spread is the median of its distances, per axis."""
    tree, places = fit.problem.tree, fit.problem.attached.places
    size = np.linalg.norm(tree.offsets) / np.linalg.norm(start.skeleton.offsets)
    skeleton = replace(start.skeleton, offsets=tree.offsets, ends=start.skeleton.ends * size)
    joint_sd, marker_sd = doubt(fit.found, fit.curvature)
    subject = replace(start, skeleton=skeleton, places=places, frames=len(fit.root), joint_sd=joint_sd, marker_sd=marker_sd)
    nothing = np.zeros(len(fit.root), int)
    motion = Motion(fit.root, fit.local, nothing, nothing, np.zeros(0), np.zeros(0))
    _, placed = kinematics.placed(subject, motion)
    distance = np.linalg.norm(fit.problem.markers - placed, axis=-1)
    seen = (~np.isnan(distance)).any(0)
    spread = start.spread.copy()
    spread[seen] = np.sqrt(np.nanmedian(distance[:, seen] ** 2, axis=0) / 3)
    return replace(subject, spread=spread)
