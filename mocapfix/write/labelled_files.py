"""Labelled copies of files: the bytes of a file whose unlabelled trajectories got the names of markers.

Where each trajectory is one marker, only its name is replaced. Otherwise each marker gets a column of its own, before the other
columns of the file, to which its samples move with all of their words, and trajectories without samples are left out. A text
table is written again, in the unit and axes and with the decimals of a new one.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mocapfix.files.layouts import C3dLayout
from mocapfix.files.output_files import make_scratch_folder
from mocapfix.take import Take
from mocapfix.write import patches, text_tables
from mocapfix.write.c3d_parameter_records import replace_point_parameters
from mocapfix.write.source_file import read_source_bytes

NO_FILE = Path("labelled")  # in messages, in place of a file that is not yet written


@dataclass(frozen=True)
class LabelledColumns:
    """P columns of a labelled file.

    Attributes:
        labels: Their labels.
        source_points: Index of the file's point from which each sample comes, -1 for a missing sample.
        moves_samples: Whether any sample gets another column; if not, the points are those of the file.
    """

    labels: tuple[str, ...]
    source_points: Int[np.ndarray, "T P"]
    moves_samples: bool


def plan_columns(
    point_labels: list[str],
    columns: Int[np.ndarray, " C"],
    marker_indices: Int[np.ndarray, "T C"],
    is_visible: np.ndarray,
    labels: tuple[str, ...],
) -> LabelledColumns:
    """Return the columns of a labelled file.

    Args:
        point_labels: Labels of all points of the file.
        columns: Indices of the unlabelled points among them.
        marker_indices: Index of the marker to which each of their samples belongs, -1 for none.
        is_visible: (T, C) which samples are present.
        labels: Labels of the markers.
    """
    frame_count = len(marker_indices)
    own = [np.unique(marker_indices[is_visible[:, c], c]) for c in range(len(columns))]
    single = [int(each[0]) for each in own if len(each) == 1 and each[0] >= 0]
    identity = np.arange(len(point_labels))
    if all(len(each) <= 1 for each in own) and len(set(single)) == len(single):
        names = list(point_labels)
        for point, each in zip(columns.tolist(), own, strict=True):
            if len(each) and each[0] >= 0:
                names[point] = labels[each[0]]
        return LabelledColumns(tuple(names), np.tile(identity, (frame_count, 1)), moves_samples=False)
    found = np.unique(marker_indices[is_visible & (marker_indices >= 0)])
    sources = np.full((frame_count, len(found)), -1)
    rows, places = np.nonzero(is_visible & (marker_indices >= 0))
    sources[rows, np.searchsorted(found, marker_indices[rows, places])] = columns[places]
    rest = np.where(is_visible & (marker_indices < 0), columns, -1)
    kept = (rest >= 0).any(0)
    others = np.setdiff1d(identity, columns)
    return LabelledColumns(
        (*(labels[m] for m in found), *(point_labels[p] for p in others), *(point_labels[p] for p in columns[kept])),
        np.concatenate([sources, np.tile(others, (frame_count, 1)), rest[:, kept]], axis=1),
        moves_samples=True,
    )


def build_labelled_c3d(take: Take, columns: LabelledColumns) -> bytes:
    """Return the bytes of a take's C3D with other columns. Raises WriteError if the file cannot be read any more."""
    layout = take.layout
    assert isinstance(layout, C3dLayout)
    data = read_source_bytes(NO_FILE, take.path, layout.data_start_byte + layout.frame_count * layout.frame_stride_bytes)
    stop_byte = layout.data_start_byte + layout.frame_count * layout.frame_stride_bytes
    head = replace_point_parameters(
        bytes(data[: layout.data_start_byte]), columns.labels, has_same_points=not columns.moves_samples
    )
    if not columns.moves_samples:
        return head + bytes(data[layout.data_start_byte :])
    return head + _build_frames(layout, data, columns.source_points) + bytes(data[stop_byte:])


def _build_frames(layout: C3dLayout, data: bytearray, source_points: Int[np.ndarray, "T P"]) -> bytes:
    """Return the data section with other points; the analog samples of each frame are unchanged."""
    words = layout.view_words(data)
    missing = patches.encode_missing_sample(layout)
    moved = words[np.arange(layout.frame_count)[:, None], source_points]
    moved[source_points < 0] = missing
    point_bytes = np.ascontiguousarray(moved).view(np.uint8).reshape(layout.frame_count, -1)
    old_point_bytes = layout.point_count * 4 * layout.word_size_bytes
    shape = layout.frame_count, layout.frame_stride_bytes - old_point_bytes
    strides = layout.frame_stride_bytes, 1
    analog = np.ndarray(shape, np.uint8, data, layout.data_start_byte + old_point_bytes, strides)
    return np.concatenate([point_bytes, analog], axis=1).tobytes()


def build_labelled_table(take: Take, positions: Float[np.ndarray, "T P 3"], labels: tuple[str, ...]) -> bytes:
    """Return the bytes of a new text table: a TRC for a TRC, else a plain CSV. Positions are in metres, Y up."""
    labelled = replace(
        take, markers=positions, labels=labels, unlabelled=None, computed_points=None, point_columns=np.zeros(0, int)
    )
    write = text_tables.write_trc if take.path and take.path.suffix.lower() == ".trc" else text_tables.write_csv
    with make_scratch_folder() as folder:
        path = folder / "labelled"
        write(path, labelled)
        return path.read_bytes()
