"""A synthetic take of three seconds with one fault of every kind that a reviewer decides on."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from mocapfix.io import capture
from mocapfix.model.subject import Subject
from mocapfix.model.take import C3dLayout, Take
from mocapfix.result import CleaningResult
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import SyntheticTake
from tests.c3d_files import c3d_bytes

FIRST_FRAME = 301
"""the first frame number of the take"""
AXIS_PARAMETERS = {"POINT:X_SCREEN": "+X", "POINT:Y_SCREEN": "+Z"}
"""C3D parameters that declare Z as the up axis"""
CAMERA_MASK = 7 << 8
"""the high byte of a residual word: three cameras saw the sample"""

# The ids of the changes in the review file. INSIDE_SWAP is a spike of LWRB while LWRB has the label LWRA.
SPIKE = "spike-STRN-321"
GAP = "gap-RELB-341"
LABELLED_FRAGMENT = "fragment-RFHD-401"
UNLABELLED_FRAGMENT = "fragment-RHEE-451"
SWAP = "swap-LWRA-521"
INSIDE_SWAP = "spike-LWRB-551"
FAULTS = {
    SPIKE: (("STRN",), 20, 20),
    GAP: (("RELB",), 40, 59),
    LABELLED_FRAGMENT: (("RFHD", "RFHD-1"), 100, 159),
    UNLABELLED_FRAGMENT: (("RHEE", "*12"), 150, 199),
    SWAP: (("LWRA", "LWRB"), 220, 289),
    INSIDE_SWAP: (("LWRB",), 250, 250),
}
"""the labels, and the first and last frame index, of every fault"""


@dataclass(frozen=True)
class FaultyTake:
    """The take's file, its cleaned result, and the result as a C3D.

    `truth` are the true marker positions (T, M, 3) in metres, in the order of the take's labels.
    """

    path: Path
    subject: Subject
    truth: np.ndarray
    result: CleaningResult
    output: Path


def build_residual_words(shape: tuple[int, int]) -> np.ndarray:
    """Return residual words (T, P) that distinguish every sample from its neighbours."""
    frames, points = np.indices(shape)
    return CAMERA_MASK + (31 * points + frames) % 256


def write_faulty_take(path: Path, truth: SyntheticTake) -> None:
    """Write the take as a C3D of floats: mm, Z up, numbered from FIRST_FRAME, with a labelled and an unlabelled fragment."""
    labels = [*truth.labels, "RFHD-1", "*12"]
    markers = np.full((truth.motion.frame_count, len(labels), 3), np.nan)
    markers[:, :-2] = truth.marker_positions
    index = {label: m for m, label in enumerate(labels)}
    markers[20, index["STRN"]] += [0.2, 0.0, 0.0]
    markers[40:60, index["RELB"]] = np.nan
    markers[250, index["LWRB"]] += [0.0, 0.2, 0.0]
    markers[220:290, [index["LWRA"], index["LWRB"]]] = markers[220:290, [index["LWRB"], index["LWRA"]]]
    for label, donor, first, last in (("RFHD", "RFHD-1", 100, 159), ("RHEE", "*12", 150, 199)):
        markers[first : last + 1, index[donor]] = markers[first : last + 1, index[label]]
        markers[first : last + 1, index[label]] = np.nan
    missing = np.isnan(markers[..., 0])
    counts = np.where(missing[..., None], 0.0, markers[..., [2, 0, 1]] * 1000)
    residual_words = np.where(missing, -1, build_residual_words(missing.shape))
    path.write_bytes(c3d_bytes(counts, labels, residual_words, first=FIRST_FRAME, extra=AXIS_PARAMETERS))


def view_sample_words(take: Take, data: bytearray) -> np.ndarray:
    """Return a view (T, P, 4) of the words of every point in the data of a C3D."""
    assert isinstance(take.layout, C3dLayout)
    return take.layout.view_words(data)


def map_labels_to_points(take: Take) -> dict[str, int]:
    """Return the index of the file's point by label of a marker or unlabelled trajectory."""
    points = dict(zip(take.labels, take.point_columns.tolist(), strict=True))
    unlabelled = take.unlabelled
    return points | (dict(zip(unlabelled.labels, unlabelled.point_columns.tolist(), strict=True)) if unlabelled else {})


@cache
def read_unchanged_take(path: Path, modified_ns: int):
    """Read a take, once for each time at which its file was modified: many tests compare with the same file."""
    return capture.read_take(path)


def find_changed_runs(path: Path, other_path: Path) -> set[tuple[str, int, int]]:
    """Return the runs of samples in which any bit differs: label, first and last frame index.

    All other bytes of the two files must be the same.
    """
    take, other_take = (read_unchanged_take(each, each.stat().st_mtime_ns) for each in (path, other_path))
    data, other_data = bytearray(path.read_bytes()), bytearray(other_path.read_bytes())
    words, other_words = view_sample_words(take, data), view_sample_words(take, other_data)
    is_changed = (words.view("u4") != other_words.view("u4")).any(-1)
    words[is_changed] = other_words[is_changed] = 0
    assert data == other_data
    label_of_point = {point: label for each in (take, other_take) for label, point in map_labels_to_points(each).items()}
    return {
        (label_of_point[point], first, last)
        for point in range(is_changed.shape[1])
        for first, last in find_runs(is_changed[:, point])
    }
