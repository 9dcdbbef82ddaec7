"""How far the solved joints and markers lie from the truth: the posterior covariance of the poses, root to leaves.

The solve weighs its terms so that it withstands what may be wrong with a take: it takes a marker to lie 10 mm from its place,
and asks people's habits once in a while, for a take's frames are alike. How wrong its result is, is another question. It
is asked anew, of the same curvature and factorisation, with each term as uncertain as it really is:

- markers, as the distances show that they keep from the solved body: what the poses took up of them is made good for, as
  in the a posteriori variance of least squares;
- people's poses, in every frame: of one frame's pose they say no less for being said of its neighbours, too (limits
  stay as the solve has them: between their walls they say nothing);
- joints that lost a marker, by how far their course can be known that long after a gap's edge;
- calibration's own error, which no frame tells and the subject carries, beside all that.
"""

from dataclasses import replace

import numpy as np

from mocapfix.kernels import kinematics
from mocapfix.kernels.problem import Problem, pull_to
from mocapfix.kernels.terms import Courses
from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.subject import Subject

LEAST = 0.001  # metres: no marker keeps its place better
NORMAL = 2.366  # the median of a chi-squared of three degrees of freedom
HEARD = 0.9  # a marker whose error the pose takes up almost whole tells nothing of its size
PLACED = 0.75  # of the calibration's own deviation: people's marker places and bones stray less from the average than it allows


def deviations(
    problem: Problem, motion: Motion, subject: Subject, prior: Prior, alone: np.ndarray, time: Courses, robust: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> standard deviations per axis, metres, of the markers (T, K) as the body places them and of the joints (T, J).

    problem  as it was solved
    alone    (T, K) metres: the deviation of the markers that its own weights foretold
    time     what the moments around say of the joints that miss a marker and of the root, as surely as they do
    robust   metres: the scale beyond which the solve no longer believed a marker
    """
    _, markers = kinematics.placed(subject, motion)
    taken_up = (alone / problem.marker_sd) ** 2
    distance = np.linalg.norm(problem.markers - markers, axis=-1)
    marker_sd = strayed(distance, taken_up, problem.listened & (taken_up < HEARD), problem.marker_sd)
    honest = replace(problem, marker_sd=marker_sd, prior=pull_to(prior))
    posed = honest.uncertainty(motion.root, motion.rotations, time, robust)
    return np.hypot(posed.markers, PLACED * subject.marker_sd), np.hypot(posed.joints, PLACED * subject.joint_sd)


def strayed(distance: np.ndarray, taken_up: np.ndarray, tell: np.ndarray, otherwise: float) -> float:
    """-> metres per axis: by how much markers stray from their places, from their distances (T, K) to the body fitted to them.

    taken_up  (T, K) the part of a marker's error, squared, that the pose took up: 0 none, 1 all
    tell      (T, K) bool: the samples that are asked; where there are none, the answer is `otherwise`
    """
    if not tell.any():
        return otherwise
    return max(float(np.sqrt(np.median(distance[tell] ** 2 / (1 - taken_up[tell])) / NORMAL)), LEAST)
