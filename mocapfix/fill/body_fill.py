"""Filling from the solved body: the marker's place on its segment, and the residual at the gap's edges carried across."""

import numpy as np

from mocapfix.motion import Motion
from mocapfix.solve import kinematics
from mocapfix.stats.residual_process import interpolate_residual
from mocapfix.subject import Subject

BODY_RESIDUAL_FADE_S = 0.2  # seconds after which a residual has lost most of its memory
BODY_RESIDUAL_REACH_S = 0.3  # seconds on either side of a gap that are listened to
BODY_SAMPLE_NOISE_M = 0.0005  # metres: what cameras add to a sample
MIN_BODY_RESIDUAL_M = 0.002  # metres: least size of a residual's course
MIN_BODY_FILL_SD_M = 0.0005  # metres: no fill is surer than this
MAX_EDGE_RESIDUAL_M, MAX_EDGE_RESIDUAL_RATIO = (
    0.05,
    4.0,
)  # metres, and times the usual residual: a sample so far from the body is no edge to hold on to


def fill_from_body(
    markers: np.ndarray, is_wanted: np.ndarray, subject: Subject, motion: Motion, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, K, 3) at the samples `wanted` (T, K), NaN elsewhere, and their standard deviation per axis (T, K).

    In a gap the residual is the marker's stray from its place on the segment and the error of a pose that was not told of the
    marker. Both are known at the gap's edges and forgotten as the residual's course forgets.

    worn  (T, K, 3) metres, the subject's markers, NaN where not seen or not believed
    """
    position, rotation = kinematics.compute_world_poses(subject.skeleton, motion)
    out, deviation = np.full(markers.shape, np.nan), np.full(is_wanted.shape, np.nan)
    for k, joint in enumerate(subject.joints):
        if not is_wanted[:, k].any():
            continue
        turn, placed = rotation[:, joint], position[:, joint] + rotation[:, joint] @ subject.marker_offsets[k]
        residual = np.einsum("tba,tb->ta", turn, markers[:, k] - placed)
        distance = np.linalg.norm(residual, axis=1)
        if (known := ~np.isnan(distance)).any():
            residual[distance > max(MAX_EDGE_RESIDUAL_M, MAX_EDGE_RESIDUAL_RATIO * float(np.median(distance[known])))] = np.nan
        course, variance, power = interpolate_residual(
            residual,
            is_wanted[:, k],
            rate,
            time_scale_s=BODY_RESIDUAL_FADE_S,
            margin_s=BODY_RESIDUAL_REACH_S,
            noise_sd=BODY_SAMPLE_NOISE_M,
            min_sd=MIN_BODY_RESIDUAL_M,
        )
        where = is_wanted[:, k]
        out[where, k] = placed[where] + np.einsum("tab,tb->ta", turn[where], course[where])
        deviation[where, k] = np.sqrt(
            np.maximum(variance[where] * (1 + motion.marker_sd[where, k] ** 2 / power), MIN_BODY_FILL_SD_M**2)
        )
    return out, deviation
