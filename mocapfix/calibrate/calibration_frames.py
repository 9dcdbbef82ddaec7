"""Calibration frames: the best frames of one subject in one take, from which the person is calibrated together with other takes.

They are all that a calibration needs of a take: a few hundred kilobytes instead of the file.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float, Int

from mocapfix.calibrate.body_size import scale_skeleton
from mocapfix.errors import ReadError
from mocapfix.files.output_files import replace_atomically
from mocapfix.skeleton import BodyModel
from mocapfix.subject import Subject


@dataclass(frozen=True)
class CalibrationFrames:
    """N frames of one subject in a take, with the poses of the average body in them.

    Attributes:
        take: id of the take.
        subject_name: name of the subject in the take; "" if its labels have none.
        marker_set: name of the marker set.
        labels: K marker labels, as the marker set names them.
        joints: (K,) the joint that carries each marker.
        marker_offsets: (K, 3) metres, of the marker set on the average body.
        marker_spread: (K,) metres, how much people's marker offsets differ.
        size_ratio: size of the body relative to the average one.
        times_s: (N,) seconds, of the frames.
        markers: (N, K, 3) metres, NaN if not visible or an outlier.
        root_position: (N, 3) metres.
        local_rotations: (N, J, 3, 3).
    """

    take: str
    subject_name: str
    marker_set: str
    labels: tuple[str, ...]
    joints: Int[np.ndarray, " K"]
    marker_offsets: Float[np.ndarray, "K 3"]
    marker_spread: Float[np.ndarray, " K"]
    size_ratio: float
    times_s: Float[np.ndarray, " N"]
    markers: Float[np.ndarray, "N K 3"]
    root_position: Float[np.ndarray, "N 3"]
    local_rotations: Float[np.ndarray, "N J 3 3"]

    @property
    def pose_variation_rad(self) -> float:
        """How much the poses vary: the root mean square deviation of the joints below the root from the take's mean rotation."""
        below_root = self.local_rotations[:, 1:]
        variance = 3 - np.square(below_root.mean(0)).sum((-2, -1))  # of the chordal distance
        return float(np.sqrt(np.maximum(variance, 0.0).mean() / 2))


def build_average_subject(frames: CalibrationFrames, body: BodyModel, size_ratio: float) -> Subject:
    """Return the average body at a size, with the markers of the frames."""
    return Subject(
        skeleton=scale_skeleton(body.skeleton, size_ratio),
        marker_set=frames.marker_set,
        labels=frames.labels,
        joints=frames.joints,
        marker_offsets=frames.marker_offsets * size_ratio,
        marker_spread=frames.marker_spread,
    )


def write_calibration_frames(path: Path, frames: CalibrationFrames) -> None:
    """Write frames as a compressed NumPy archive. Raises WriteError."""
    arrays: dict[str, Any] = {each.name: np.asarray(getattr(frames, each.name)) for each in fields(frames)}
    for name in ("markers", "root_position", "local_rotations"):
        arrays[name] = arrays[name].astype(np.float32)
    with replace_atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_calibration_frames(path: Path) -> CalibrationFrames:
    """Return the frames in a file. Raises ReadError."""
    try:
        with np.load(path) as archive:
            arrays = {each.name: archive[each.name] for each in fields(CalibrationFrames)}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise ReadError(
            f"{path}: is not an archive of calibration frames ({error}); remove it and survey the take again."
        ) from error
    return CalibrationFrames(
        take=str(arrays["take"]),
        subject_name=str(arrays["subject_name"]),
        marker_set=str(arrays["marker_set"]),
        labels=tuple(str(label) for label in arrays["labels"]),
        joints=arrays["joints"],
        marker_offsets=arrays["marker_offsets"],
        marker_spread=arrays["marker_spread"],
        size_ratio=float(arrays["size_ratio"]),
        times_s=arrays["times_s"],
        markers=arrays["markers"].astype(float),
        root_position=arrays["root_position"].astype(float),
        local_rotations=arrays["local_rotations"].astype(float),
    )
