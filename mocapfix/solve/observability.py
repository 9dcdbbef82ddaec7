"""What the solve listens to: samples that do not lie beside a gap; and the joints of which none of them tells."""

import numpy as np

from mocapfix.stats.runs import find_runs
from mocapfix.subject import Subject

MIN_GAP_DURATION_S = 0.025  # seconds


def find_gap_borders(is_inlier: np.ndarray, is_unobserved: np.ndarray, rate: float, max_border_s: float) -> np.ndarray:
    """-> (T, K) bool: the samples on either side of a marker's gaps, for up to `longest` seconds.

    The pose shall not listen to them: a marker pulls the body to itself, so a body that lets go of it where its gap
    begins would jump, and the residual carried across the gap would be the residual of another pose. The last samples
    before a marker is lost are its worst, too. Flicker loses none, and neither does a gap in which the marker's joint is
    `gone` (T, K) from end to end: there is no other pose then, for the course of a lost joint leads on from its last one.
    """
    mask = np.zeros_like(is_inlier)
    for k in range(is_inlier.shape[1]):
        for first, last in find_runs(~is_inlier[:, k]):
            span = round(rate * min(max_border_s, (last - first + 1) / rate - MIN_GAP_DURATION_S))
            if span > 0 and not is_unobserved[first : last + 1, k].all():
                mask[max(0, first - span) : last + 1 + span, k] = True
    return mask


def find_partly_observed_joints(is_used: np.ndarray, subject: Subject) -> np.ndarray:
    """-> (T, J) bool: joints that miss a marker, their own or a child's, that the take shows at other times.

    listened  (T, K): the subject's markers that the solve listens to
    """
    lacking = np.zeros((len(is_used), len(subject.skeleton.names)), bool)
    for k in np.flatnonzero(is_used.any(0)):
        joint = subject.joints[k]
        lacking[:, joint] |= ~is_used[:, k]
        lacking[:, max(subject.skeleton.parents[joint], 0)] |= ~is_used[:, k]
    lacking[:, 0] = False
    return lacking


def find_unobserved_joints(is_used: np.ndarray, subject: Subject, free_joints: np.ndarray) -> np.ndarray:
    """-> (T, J) bool: free joints below the root that no marker tells of: none on them or farther out is there.

    listened  (T, K): the subject's markers that the solve listens to
    """
    told = np.zeros((len(is_used), len(free_joints)), bool)
    for k, joint in enumerate(subject.joints):
        told[:, joint] |= is_used[:, k]
    for j in range(len(free_joints) - 1, 0, -1):
        told[:, subject.skeleton.parents[j]] |= told[:, j]
    carrying = told.any(0)
    return ~told & free_joints & carrying & (np.arange(len(free_joints)) > 0)
