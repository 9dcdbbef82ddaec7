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

SAME = 1e-9  # of a frame: so near to one of the motion's own a new one is that frame


def picks(rate: float, fps: float) -> bool:
    """-> are the frames of a motion at `fps` all frames of it at `rate`?"""
    step = rate / fps
    return step > 1 - SAME and abs(step - round(step)) < SAME


def resampled(motion: Motion, rate: float, fps: float) -> Motion:
    """-> the motion, which has `rate` frames a second, at `fps`: from its first frame on, as many as lie within it.

    Where the new frames are all frames of the motion, those are picked; with `fps` the same as `rate` it is the motion itself.
    Statuses and iterations are the nearest frame's, deviations the larger of the two frames' around.
    """
    if rate == fps:
        return motion
    at = np.arange(int((motion.frames - 1) * fps / rate + SAME) + 1) * rate / fps  # in frames of the motion
    nearest = np.rint(at).astype(int)
    if motion.frames == 1 or picks(rate, fps):
        return motion.at(nearest)
    frames = np.arange(motion.frames)
    at = np.minimum(at, frames[-1])
    below, above = np.floor(at).astype(int), np.ceil(at).astype(int)
    return Motion(
        root=CubicSpline(frames, motion.root)(at),
        rotations=_between(frames, motion.rotations, at),
        status=motion.status[nearest],
        iterations=motion.iterations[nearest],
        deviation=np.maximum(motion.deviation[below], motion.deviation[above]),
        joint_deviation=np.maximum(motion.joint_deviation[below], motion.joint_deviation[above]),
    )


def _between(frames: np.ndarray, rotations: np.ndarray, at: np.ndarray) -> np.ndarray:
    """-> (N, J, 3, 3) the rotations (T, J, 3, 3) at times within theirs."""
    out = np.empty((len(at), *rotations.shape[1:]))
    for joint in range(rotations.shape[1]):
        out[:, joint] = RotationSpline(frames, Rotation.from_matrix(rotations[:, joint]))(at).as_matrix()
    return out
