"""Everything solved as NumPy arrays (.npz), for one's own programs: np.load("walk.npz"), without pickle.

Metres, seconds, radians, Y up, right-handed. Of T frames of the body, J joints, F frames of the take, M markers:

    format          "mocapfix 1"
    units           a sentence that says so
    rate, first_frame   frames a second of the body; the file's own number of its first frame
    names (J,)      joints, parents before children;  parents (J,), -1 for the root
    offsets (J, 3)  each joint in its parent's axes;  ends (J, 3) a last bone's end in its joint's, NaN for the others
    root (T, 3)     the root's place in the world
    rotations (T, J, 4)  each joint's axes in its parent's (the root's in the world) as quaternions x, y, z, w, without flips
    joints (T, J, 3)     their places in the world;  joint_sd (T, J) predicted standard deviation along each axis
    status (T,)     an index into status_texts (S,), which say how sure each frame's pose is
    labels (M,)     markers as the file names them
    markers (F, M, 3)    as they were mended, NaN where there is none
    marker_sd (F, M)     predicted standard deviation along each axis of the samples that mocapfix put there, NaN elsewhere
    marker_rate     frames a second of the markers, which stay at the take's own

A take without a body has no names, parents, offsets, ends, root, rotations, joints, joint_sd, status and status_texts.
"""

from pathlib import Path

import numpy as np

from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels import quaternions
from mocapfix.motion import FrameStatus, Motion
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.take import Take

NPZ_FORMAT, NPZ_UNITS = "mocapfix 1", "metres, seconds, radians; Y up, right-handed; quaternions x, y, z, w"


def write_npz(
    target: Path, take: Take, skeleton: Skeleton | None = None, motion: Motion | None = None, rate: float | None = None
) -> None:
    """Write the mended markers of `take` and, where it has a body, its `motion` at `rate` frames a second (by default the
    take's); whole or not at all.

    Raises WriteError where the folder cannot be written.
    """
    arrays = {
        "format": np.array(NPZ_FORMAT),
        "units": np.array(NPZ_UNITS),
        "rate": np.array(float(rate or take.rate)),
        "first_frame": np.array(take.first_frame),
        "labels": np.array(take.labels),
        "markers": take.markers,
        "marker_sd": np.full(take.visible.shape, np.nan) if take.sample_sd is None else take.sample_sd,
        "marker_rate": np.array(float(take.rate)),
    }
    if skeleton is not None and motion is not None:
        arrays |= _build_body_arrays(skeleton, motion)
    with replace_atomically(Path(target)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _build_body_arrays(skeleton: Skeleton, motion: Motion) -> dict[str, np.ndarray]:
    known = np.ones(motion.frame_count, bool)
    turns = [quaternions.extract_joint_quaternions(motion.local_rotations, joint, known) for joint in range(len(skeleton.names))]
    return {
        "names": np.array(skeleton.names),
        "parents": skeleton.parents,
        "offsets": skeleton.offsets,
        "ends": skeleton.ends,
        "root": motion.root_position,
        "rotations": np.stack(turns, axis=1),
        "joints": kinematics.compute_world_poses(skeleton, motion)[0],
        "joint_sd": motion.joint_sd,
        "status": motion.status,
        "status_texts": np.array([status.description for status in FrameStatus]),
    }
