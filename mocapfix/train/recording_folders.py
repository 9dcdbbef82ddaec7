"""Folders of training motion: shards of the CMU database, BVH, ASF/AMC and AMASS npz, as rotations of the 31 CMU joints."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from mocapfix.animation import Animation
from mocapfix.animations.joint_mapping import map_joints
from mocapfix.animations.retarget import align_skeleton, convert_to_cmu31
from mocapfix.errors import ReadError
from mocapfix.read.amc import read_amc
from mocapfix.read.bvh import read_bvh
from mocapfix.train.amass_recordings import read_amass_recordings
from mocapfix.train.shard_recordings import Recording, compute_frame_step, infer_subject, read_shard_recordings


def read_recordings(folder: Path) -> Iterator[Recording]:
    """Yield all motion in a folder and its subfolders, always in the same order.

    Raises ReadError if there is none, or if a file is invalid.
    """
    is_empty = True
    for pattern, read in RECORDING_READERS:
        for path in sorted(Path(folder).rglob(pattern)):
            for recording in read(path):
                is_empty = False
                yield recording
    if is_empty:
        raise ReadError(f"{folder}: holds no motion; give a folder of BVH, ASF/AMC, AMASS npz, or shards of CMU motion.")


def read_bvh_recording(path: Path) -> Iterator[Recording]:
    """Yield the motion of a BVH. Raises ReadError if it is invalid or does not animate a whole body."""
    yield _read_recording(path, read_bvh)


def read_amc_recording(path: Path) -> Iterator[Recording]:
    """Yield the motion of an AMC. Raises ReadError if it is invalid, has no ASF, or does not animate a whole body."""
    yield _read_recording(path, read_amc)


def _read_recording(path: Path, read: Callable[[Path], Animation]) -> Recording:
    animation = read(path)
    result = map_joints(animation.names, animation.parents)
    if result.file_joints is None:
        raise ReadError(f"{path}: {result.reason}")
    alignment = align_skeleton(animation, result.file_joints)
    if alignment is None:
        raise ReadError(f"{path}: the figure never stands upright, so the axes of its joints cannot be determined.")
    step = compute_frame_step(animation.rate)
    kept = animation.replace_values(animation.values[int(animation.has_reference_pose) :: step])
    _, rotations = convert_to_cmu31(kept, alignment)
    is_complete = ~np.isnan(rotations).any((1, 2, 3))
    return Recording(path.stem, infer_subject(path), rotations[is_complete], animation.rate / step)


RECORDING_READERS: tuple[tuple[str, Callable[[Path], Iterator[Recording]]], ...] = (
    ("*.npz", read_shard_recordings),
    ("*.npz", read_amass_recordings),
    ("*.bvh", read_bvh_recording),
    ("*.amc", read_amc_recording),
)
