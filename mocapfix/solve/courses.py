"""The smooth courses of all joints and the root, as pulls on the poses, joint by joint.

A pull to each joint's own course, once, does as well as all poses of a gap solved together with the smoothness between
them (block-banded Gauss-Newton), in gaps of seconds too, at a small part of the cost; more rounds change little.
The matrices of all joints over a long take are large, so each function here holds as few of them as it can and says which
it writes into.
"""

import numpy as np

from mocapfix.kernels import quaternions
from mocapfix.kernels.problem import Uncertainty
from mocapfix.kernels.terms import Courses
from mocapfix.solve import temporal
from mocapfix.solve.options import SolveOptions

LOOSEST = 0.5  # radians: the weakest pull to a joint's course


def bridges(
    local: np.ndarray, variance: np.ndarray, unsure: np.ndarray, rate: float, options: SolveOptions
) -> tuple[Courses, np.ndarray]:
    """-> where each joint's course leads while the joint itself is unsure, as a pull as strong as that course is certain,
    and the course's variance (T, J), rad^2, there.

    local (T, J, 3, 3), variance (T, J) rad^2: each frame's own solve; unsure (T, J) bool
    """
    rotations, weight, left_open = local.copy(), np.zeros(unsure.shape), np.zeros(unsure.shape)
    for j in np.flatnonzero(unsure.any(0)):
        turns = quaternions.of_joint(local, j, ~unsure[:, j])
        course, left_open[:, j] = temporal.bridged(turns, variance[:, j], unsure[:, j], rate)
        quaternions.into_joint(course, j, rotations)
        weight[:, j] = np.where(unsure[:, j], 1 / (left_open[:, j] + options.turn_sd**2), 0.0)
    return Courses(rotations, weight, np.zeros((len(local), 3)), np.zeros(len(local))), left_open


def smooth(
    root: np.ndarray, local: np.ndarray, known: Uncertainty, free: np.ndarray, rate: float, options: SolveOptions
) -> Courses:
    """-> the smooth course of every free joint and the root, as a pull for each frame. Its rotations lie in `local`.

    root (T, 3) metres, local (T, J, 3, 3) and how far they are known: what is smoothed
    """
    weight, everywhere = np.zeros(local.shape[:2]), np.ones(len(local), bool)
    for j in np.flatnonzero(free):
        variance = known.turns[:, j]
        course = temporal.smoothed_turns(quaternions.of_joint(local, j, everywhere), variance, rate)
        quaternions.into_joint(course, j, local)
        doubt = np.minimum(variance, LOOSEST**2)  # joints that share a turn, as the spine's do, are unsure one by one
        weight[:, j] = 1 / (options.turn_sd**2 + doubt)
    smooth_root, left_open = temporal.smoothed_root(root, known.root, rate)
    return Courses(local, weight, smooth_root, 1 / (options.shift_sd**2 + left_open))


def polished(root: np.ndarray, local: np.ndarray, free: np.ndarray, rate: float, options: SolveOptions) -> np.ndarray:
    """Take from `local` (T, J, 3, 3) the tremble that skin and cameras give each frame of its own. -> root (T, 3) likewise"""
    everywhere, tremble = np.ones(len(local), bool), np.full(len(local), options.tremble_turn**2)
    for j in np.flatnonzero(free):
        course = temporal.smoothed_turns(quaternions.of_joint(local, j, everywhere), tremble, rate)
        quaternions.into_joint(course, j, local)
    return temporal.smoothed_root(root, np.full(len(root), options.tremble_shift**2), rate)[0]
