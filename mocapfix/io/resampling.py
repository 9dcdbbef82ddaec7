"""Resampling of a motion to another frame rate.

Rotations follow a rotation spline with continuous angular velocity and acceleration (scipy's RotationSpline), the root a cubic
spline. For four CMU captures at 120 Hz, joints reconstructed from every second frame have a root mean square error of 0.4 to
0.7 mm in the frames between, from every fourth 1.0 to 1.3 mm; spherical linear interpolation (slerp) is 2 to 40 % worse. There is
no low-pass filter before frames are dropped: motion above the Nyquist frequency of 30 Hz is a millimetre on average, but removing
it would move the feet by one to two centimetres when they strike the floor.
"""

import numpy as np

from mocapfix.model.motion import Motion

FRAME_TOLERANCE = 1e-9  # distance in frames below which a new frame coincides with an original one


def is_frame_subset(rate: float, new_rate: float) -> bool:
    """Return whether all frames at `new_rate` are frames at `rate`."""
    step = rate / new_rate
    return step > 1 - FRAME_TOLERANCE and abs(step - round(step)) < FRAME_TOLERANCE


def resample_motion(motion: Motion, rate: float, new_rate: float) -> Motion:
    """Return the motion, which has the frame rate `rate`, at `new_rate` (Hz), from its first frame on.

    If the new frames are a subset of the original ones, these are selected; at the same rate the motion itself is returned.
    Status and iterations are those of the nearest frame, standard deviations the larger of the two neighbouring frames.
    """
    if rate == new_rate:
        return motion
    count = int((motion.frame_count - 1) * new_rate / rate + FRAME_TOLERANCE) + 1
    new_frames = np.arange(count) * rate / new_rate  # in frames of the motion
    nearest = np.rint(new_frames).astype(int)
    if motion.frame_count == 1 or is_frame_subset(rate, new_rate):
        return motion.select_frames(nearest)
    from scipy.interpolate import CubicSpline  # slow to import
    from scipy.spatial.transform import Rotation, RotationSpline

    frames = np.arange(motion.frame_count)
    new_frames = np.minimum(new_frames, frames[-1])
    below, above = np.floor(new_frames).astype(int), np.ceil(new_frames).astype(int)
    local_rotations = np.empty((len(new_frames), *motion.local_rotations.shape[1:]))
    for joint in range(motion.local_rotations.shape[1]):
        spline = RotationSpline(frames, Rotation.from_matrix(motion.local_rotations[:, joint]))
        local_rotations[:, joint] = spline(new_frames).as_matrix()
    root_position = CubicSpline(frames, motion.root_position)(new_frames)
    marker_sd, joint_sd = (np.maximum(sd[below], sd[above]) for sd in (motion.marker_sd, motion.joint_sd))
    return Motion(root_position, local_rotations, motion.status[nearest], motion.iterations[nearest], marker_sd, joint_sd)
