"""BVH and AMC of any body whose joints mocapfix knows by name."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from mocapfix.animation import Animation
from mocapfix.animations import joint_mapping, retarget
from mocapfix.animations.retarget import align_skeleton
from mocapfix.errors import ReadError
from mocapfix.read import amc as amc_file
from mocapfix.read import bvh as bvh_file
from mocapfix.train import amass_recordings, shard_recordings
from mocapfix.train.shard_recordings import Recording, compute_frame_step, infer_subject


# MERGED: mocapfix.train.recordings.animations
def read_bvh_recording(path: Path) -> Iterator[Recording]:
    """Yield the motion of a BVH. Raises ReadError where it is none or not of a whole body."""
    yield _read_recording(path, bvh_file.read_bvh)


def read_amc_recording(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMC. Raises ReadError where it is none, its ASF is not beside it, or it is not of a whole body."""
    yield _read_recording(path, amc_file.read_amc)


def _read_recording(path: Path, read: Callable[[Path], Animation]) -> Recording:
    animation = read(path)
    choice = joint_mapping.map_joints(animation.names, animation.parents)
    if choice.mapping is None:
        raise ReadError(f"{path}: {choice.reason}")
    fit = align_skeleton(animation, choice.mapping)
    if fit is None:
        raise ReadError(f"{path}: its figure never stands, so how its joints turn cannot be told.")
    every = compute_frame_step(animation.rate)
    kept = animation.replace_values(animation.values[int(animation.has_reference_pose) :: every])
    _, rotations = retarget.convert_to_cmu31(kept, fit)
    whole = ~np.isnan(rotations).any((1, 2, 3))
    return Recording(path.stem, infer_subject(path), rotations[whole], animation.rate / every)


# MERGED: mocapfix.train.recordings
# Motion to learn from: shards of the CMU database, BVH, ASF/AMC, and AMASS npz, all as rotations of the 31 joints.
RECORDING_READERS: tuple[tuple[str, Callable[[Path], Iterator[Recording]]], ...] = (
    ("*.npz", shard_recordings.read_shard_recordings),
    ("*.npz", amass_recordings.read_amass_recordings),
    ("*.bvh", read_bvh_recording),
    ("*.amc", read_amc_recording),
)


def read_recordings(folder: Path) -> Iterator[Recording]:
    """Yield all the motion in a folder and the folders in it, always in the same order.

    Raises ReadError where there is none, or naming the file that is not what it should be.
    """
    found = False
    for pattern, reader in RECORDING_READERS:
        for path in sorted(Path(folder).rglob(pattern)):
            for recording in reader(path):
                found = True
                yield recording
    if not found:
        raise ReadError(f"{folder}: holds no motion; give a folder of BVH, ASF/AMC, AMASS npz, or shards of CMU motion.")
