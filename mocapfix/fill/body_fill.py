"""Filling from the solved body: the marker's offset on its joint, plus the interpolated residual at the edges of the gap."""

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.motion import Motion
from mocapfix.solve import kinematics
from mocapfix.stats.residual_process import interpolate_residual
from mocapfix.subject import Subject

BODY_RESIDUAL_FADE_S = 0.2
"""Time scale of the correlation of a marker's residual."""
BODY_RESIDUAL_REACH_S = 0.3
"""Time on either side of a gap that is used."""
BODY_SAMPLE_NOISE_M = 0.0005
"""Noise of a sample, caused by the cameras."""
MIN_BODY_RESIDUAL_M = 0.002
"""Smallest standard deviation of the residual."""
MIN_BODY_FILL_SD_M = 0.0005
"""Smallest standard deviation of a fill."""
MAX_EDGE_RESIDUAL_M = 0.05
"""Residual of a sample above which it may be unusable as the edge of a gap; it must also exceed MAX_EDGE_RESIDUAL_RATIO."""
MAX_EDGE_RESIDUAL_RATIO = 4.0
"""The same relative to the marker's median residual."""


def fill_from_body(
    markers: Float[np.ndarray, "T K 3"], is_wanted: Bool[np.ndarray, "T K"], subject: Subject, motion: Motion, rate: float
) -> tuple[Float[np.ndarray, "T K 3"], Float[np.ndarray, "T K"]]:
    """Return positions of the wanted samples in metres, and their standard deviations per axis; NaN elsewhere.

    In a gap the residual consists of the marker's motion relative to its joint and of the error of a pose that was solved without
    this marker. Both are known at the edges of the gap, and decay with the correlation of the residual.

    markers  in metres in the subject's order, NaN if not visible or an outlier
    """
    joint_positions, joint_rotations = kinematics.compute_world_poses(subject.skeleton, motion)
    filled, sd = np.full(markers.shape, np.nan), np.full(is_wanted.shape, np.nan)
    for k, joint in enumerate(subject.joints):
        wanted = is_wanted[:, k]
        if not wanted.any():
            continue
        rotation = joint_rotations[:, joint]
        predicted = joint_positions[:, joint] + rotation @ subject.marker_offsets[k]
        residual = np.einsum("tba,tb->ta", rotation, markers[:, k] - predicted)
        distance = np.linalg.norm(residual, axis=1)
        if (is_known := ~np.isnan(distance)).any():
            median = float(np.median(distance[is_known]))
            residual[distance > max(MAX_EDGE_RESIDUAL_M, MAX_EDGE_RESIDUAL_RATIO * median)] = np.nan
        interpolated, variance, power = interpolate_residual(
            residual,
            wanted,
            rate,
            time_scale_s=BODY_RESIDUAL_FADE_S,
            margin_s=BODY_RESIDUAL_REACH_S,
            noise_sd=BODY_SAMPLE_NOISE_M,
            min_sd=MIN_BODY_RESIDUAL_M,
        )
        filled[wanted, k] = predicted[wanted] + np.einsum("tab,tb->ta", rotation[wanted], interpolated[wanted])
        total_variance = variance[wanted] * (1 + motion.marker_sd[wanted, k] ** 2 / power)
        sd[wanted, k] = np.sqrt(np.maximum(total_variance, MIN_BODY_FILL_SD_M**2))
    return filled, sd
