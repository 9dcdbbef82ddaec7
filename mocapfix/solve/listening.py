"""What the solve listens to: samples that do not lie beside a gap; and the joints of which none of them tells."""

import numpy as np

from mocapfix.subject import Subject
from mocapfix.take import runs

FLICKER = 0.025  # seconds


def beside_gaps(believed: np.ndarray, gone: np.ndarray, rate: float, longest: float) -> np.ndarray:
    """-> (T, K) bool: the samples on either side of a marker's gaps, for up to `longest` seconds.

    The pose shall not listen to them: a marker pulls the body to itself, so a body that lets go of it where its gap
    begins would jump, and the residual carried across the gap would be the residual of another pose. The last samples
    before a marker is lost are its worst, too. Flicker loses none, and neither does a gap in which the marker's joint is
    `gone` (T, K) from end to end: there is no other pose then, for the course of a lost joint leads on from its last one.
    """
    mask = np.zeros_like(believed)
    for k in range(believed.shape[1]):
        for first, last in runs(~believed[:, k]):
            span = round(rate * min(longest, (last - first + 1) / rate - FLICKER))
            if span > 0 and not gone[first : last + 1, k].all():
                mask[max(0, first - span) : last + 1 + span, k] = True
    return mask


def missed(listened: np.ndarray, subject: Subject) -> np.ndarray:
    """-> (T, J) bool: joints that miss a marker, their own or a child's, that the take shows at other times.

    listened  (T, K): the subject's markers that the solve listens to
    """
    lacking = np.zeros((len(listened), len(subject.skeleton.names)), bool)
    for k in np.flatnonzero(listened.any(0)):
        joint = subject.joints[k]
        lacking[:, joint] |= ~listened[:, k]
        lacking[:, max(subject.skeleton.parents[joint], 0)] |= ~listened[:, k]
    lacking[:, 0] = False
    return lacking


def lost(listened: np.ndarray, subject: Subject, free: np.ndarray) -> np.ndarray:
    """-> (T, J) bool: free joints below the root that no marker tells of: none on them or farther out is there.

    listened  (T, K): the subject's markers that the solve listens to
    """
    told = np.zeros((len(listened), len(free)), bool)
    for k, joint in enumerate(subject.joints):
        told[:, joint] |= listened[:, k]
    for j in range(len(free) - 1, 0, -1):
        told[:, subject.skeleton.parents[j]] |= told[:, j]
    carrying = told.any(0)
    return ~told & free & carrying & (np.arange(len(free)) > 0)
