"""Three composed seconds in which one of each goes wrong that a technician may decide upon, and nothing else."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.files.layouts import C3dLayout
from mocapfix.read import capture
from mocapfix.result import CleaningResult
from mocapfix.stats.sequences import find_runs
from mocapfix.subject import Subject
from mocapfix.synthetic import SyntheticTake
from mocapfix.take import Take
from tests.c3d_files import c3d_bytes

FIRST = 301  # the file's number of the first frame
FEET_UP = {"POINT:X_SCREEN": "+X", "POINT:Y_SCREEN": "+Z"}
CAMERAS = 7 << 8  # the residual word's high byte: three cameras saw it

# What is wrong, by the ids of the record: the labels concerned and the frames, indices into the take.
SPIKE, GAP = "spike-STRN-321", "gap-RELB-341"
FRAGMENT, LOOSE = "fragment-RFHD-401", "fragment-RHEE-451"
SWAP, INSIDE = "swap-LWRA-521", "spike-LWRB-551"  # the spike is under LWRA's label and LWRB's own
WRONG = {
    SPIKE: (("STRN",), 20, 20),
    GAP: (("RELB",), 40, 59),
    FRAGMENT: (("RFHD", "RFHD-1"), 100, 159),
    LOOSE: (("RHEE", "*12"), 150, 199),
    SWAP: (("LWRA", "LWRB"), 220, 289),
    INSIDE: (("LWRB",), 250, 250),
}


@dataclass(frozen=True)
class Muddled:
    """The take's file, what came of it, and that as a C3D; `truth` (T, M, 3) metres by the labels of the take."""

    path: Path
    subject: Subject
    truth: np.ndarray
    result: CleaningResult
    output: Path


def words(shape: tuple[int, int]) -> np.ndarray:
    """-> (T, P) residual words that tell every sample from those beside it."""
    frames, points = np.indices(shape)
    return CAMERAS + (31 * points + frames) % 256


def write(path: Path, truth: SyntheticTake) -> None:
    """Write the take, numbered from FIRST: mm, Z up, floats, with one labelled donor and one that nobody named."""
    labels = [*truth.labels, "RFHD-1", "*12"]
    markers = np.full((truth.motion.frame_count, len(labels), 3), np.nan)
    markers[:, :-2] = truth.marker_positions
    of = {label: m for m, label in enumerate(labels)}
    markers[20, of["STRN"]] += [0.2, 0.0, 0.0]
    markers[40:60, of["RELB"]] = np.nan
    markers[250, of["LWRB"]] += [0.0, 0.2, 0.0]
    markers[220:290, [of["LWRA"], of["LWRB"]]] = markers[220:290, [of["LWRB"], of["LWRA"]]]
    for whose, donor, first, last in (("RFHD", "RFHD-1", 100, 159), ("RHEE", "*12", 150, 199)):
        markers[first : last + 1, of[donor]] = markers[first : last + 1, of[whose]]
        markers[first : last + 1, of[whose]] = np.nan
    missing = np.isnan(markers[..., 0])
    counts = np.where(missing[..., None], 0.0, markers[..., [2, 0, 1]] * 1000)
    path.write_bytes(c3d_bytes(counts, labels, np.where(missing, -1, words(missing.shape)), first=FIRST, extra=FEET_UP))


def sample_words(path: Path) -> np.ndarray:
    """-> (T, P, 4) the words of every point of a file."""
    layout = capture.read_capture(path).layout
    assert isinstance(layout, C3dLayout)
    return layout.view_words(path.read_bytes())


def columns(take: Take) -> dict[str, int]:
    """-> the file's point of each marker and unlabelled trajectory."""
    named = dict(zip(take.labels, take.point_columns.tolist(), strict=True))
    loose = take.unlabelled
    return named | (dict(zip(loose.labels, loose.point_columns.tolist(), strict=True)) if loose else {})


def differing(one: Path, other: Path) -> set[tuple[str, int, int]]:
    """-> the runs of samples any of whose bits differ: point, first and last index. All other bytes must be the same."""
    take = capture.read_capture(one)
    old, new = (sample_words(path) for path in (one, other))
    differs = (old.view("u4") != new.view("u4")).any(-1)
    rest = [bytearray(path.read_bytes()) for path in (one, other)]
    assert isinstance(take.layout, C3dLayout)
    for data in rest:
        take.layout.view_words(data)[differs] = 0
    assert rest[0] == rest[1]
    names = {column: label for each in (take, capture.read_capture(other)) for label, column in columns(each).items()}
    return {(names[p], first, last) for p in range(differs.shape[1]) for first, last in find_runs(differs[:, p])}
