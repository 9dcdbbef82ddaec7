"""Filling from the solved body: the marker's place on its segment, and the residual at the gap's edges carried across."""

import numpy as np

from mocapfix.kernels import kinematics
from mocapfix.kernels.course import across
from mocapfix.motion import Motion
from mocapfix.subject import Subject

FADE = 0.2  # seconds after which a residual has lost most of its memory
REACH = 0.3  # seconds on either side of a gap that are listened to
NOISE = 0.0005  # metres: what cameras add to a sample
LEAST = 0.002  # metres: least size of a residual's course
SURE = 0.0005  # metres: no fill is surer than this
ASTRAY, FARTHER = 0.05, 4.0  # metres, and times the usual residual: a sample so far from the body is no edge to hold on to


def markers(worn: np.ndarray, wanted: np.ndarray, subject: Subject, motion: Motion, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, K, 3) at the samples `wanted` (T, K), NaN elsewhere, and their standard deviation per axis (T, K).

    In a gap the residual is the marker's stray from its place on the segment and the error of a pose that was not told of the
    marker. Both are known at the gap's edges and forgotten as the residual's course forgets.

    worn  (T, K, 3) metres, the subject's markers, NaN where not seen or not believed
    """
    position, rotation = kinematics.world(subject.skeleton, motion)
    out, deviation = np.full(worn.shape, np.nan), np.full(wanted.shape, np.nan)
    for k, joint in enumerate(subject.joints):
        if not wanted[:, k].any():
            continue
        turn, placed = rotation[:, joint], position[:, joint] + rotation[:, joint] @ subject.places[k]
        residual = np.einsum("tba,tb->ta", turn, worn[:, k] - placed)
        distance = np.linalg.norm(residual, axis=1)
        if (known := ~np.isnan(distance)).any():
            residual[distance > max(ASTRAY, FARTHER * float(np.median(distance[known])))] = np.nan
        course, variance, power = across(residual, wanted[:, k], rate, FADE, REACH, NOISE, LEAST)
        where = wanted[:, k]
        out[where, k] = placed[where] + np.einsum("tab,tb->ta", turn[where], course[where])
        deviation[where, k] = np.sqrt(np.maximum(variance[where] * (1 + motion.deviation[where, k] ** 2 / power), SURE**2))
    return out, deviation
