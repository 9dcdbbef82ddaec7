"""Observability: which marker samples the solver uses, and which joints they determine."""

import numpy as np
from jaxtyping import Bool

from mocapfix.stats.sequences import find_runs
from mocapfix.subject import Subject

MIN_GAP_DURATION_S = 0.025
"""Gaps up to this duration are flicker and have no borders."""


def find_gap_borders(
    is_inlier: Bool[np.ndarray, "T K"], is_unobserved: Bool[np.ndarray, "T K"], rate: float, max_border_s: float
) -> Bool[np.ndarray, "T K"]:
    """Find the samples on either side of each marker's gaps, for up to `max_border_s` seconds, with the gaps themselves.

    The solver must not use them. A marker attracts the body, so the pose would jump where a gap begins, and the residual that is
    interpolated across the gap would be that of another pose. Samples next to a gap are also the least accurate. Flicker has no
    borders, and neither has a gap in which the marker's joint is unobserved throughout: the pose does not change there, since
    the trajectory of an unobserved joint continues from its last pose.

    is_inlier      samples that are visible and no outliers
    is_unobserved  whether the joint of the marker is unobserved
    """
    mask = np.zeros_like(is_inlier)
    for k in range(is_inlier.shape[1]):
        for first, last in find_runs(~is_inlier[:, k]):
            border = round(rate * min(max_border_s, (last - first + 1) / rate - MIN_GAP_DURATION_S))
            if border > 0 and not is_unobserved[first : last + 1, k].all():
                mask[max(0, first - border) : last + 1 + border, k] = True
    return mask


def find_partly_observed_joints(is_used: Bool[np.ndarray, "T K"], subject: Subject) -> Bool[np.ndarray, "T J"]:
    """Find the joints that lack a marker of their own or of a child which other frames show.

    is_used  samples of the subject's markers that the solver uses
    """
    is_partly_observed = np.zeros((len(is_used), len(subject.skeleton.names)), bool)
    for k in np.flatnonzero(is_used.any(0)):
        joint = subject.joints[k]
        is_partly_observed[:, joint] |= ~is_used[:, k]
        is_partly_observed[:, max(subject.skeleton.parents[joint], 0)] |= ~is_used[:, k]
    is_partly_observed[:, 0] = False
    return is_partly_observed


def find_unobserved_joints(
    is_used: Bool[np.ndarray, "T K"], subject: Subject, free_joints: Bool[np.ndarray, " J"]
) -> Bool[np.ndarray, "T J"]:
    """Find the free joints below the root without any used marker on them or on their descendants, if other frames have one.

    is_used  samples of the subject's markers that the solver uses
    """
    is_observed = np.zeros((len(is_used), len(free_joints)), bool)
    for k, joint in enumerate(subject.joints):
        is_observed[:, joint] |= is_used[:, k]
    for j in range(len(free_joints) - 1, 0, -1):
        is_observed[:, subject.skeleton.parents[j]] |= is_observed[:, j]
    is_ever_observed = is_observed.any(0)
    return ~is_observed & free_joints & is_ever_observed & (np.arange(len(free_joints)) > 0)
