"""Long takes: the windows in which they are cleaned, the files that hold their arrays, and what goes on over the end of a window.

Neighbouring windows overlap. Each frame of the result comes from one window, in which it is at least OVERLAP_S from the ends,
except at the ends of the take. A survey of short pieces of the whole take shows what must be the same in all windows: labels,
marker set and body.
"""

import copyreg
import mmap
import tempfile
import weakref
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.model.body_fit import BodyFit
from mocapfix.model.changes import Change, SampleState
from mocapfix.model.detected import Detected
from mocapfix.model.faults import Fault, MarkerShift
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take, TakePart

MAX_PIECE_FRAMES = 36_000  # of a take that is cleaned in one piece: 5 minutes at 120 Hz
WINDOW_FRAMES = 9_000  # 75 s at 120 Hz: two windows of 53 markers at a time take less than 2 GB
MAX_WINDOWS_AT_ONCE = 2
OVERLAP_S = 3.0  # by which a window goes on beyond the frames that are taken from it
MAX_OVERLAP_S = 20.0  # the same, at most, where a gap ends only there
CUT_SEARCH_S = 5.0  # around the regular place of a cut, in which the frame with the most complete markers is sought
CUT_SMOOTHING_S = 1.0  # time around a cut in which markers should be complete
MIN_SHOWN_S = 10.0  # for which half of the markers of a window are visible, at least; otherwise it is joined to the next
PIECE_COUNT, PIECE_S = 18, 5.0  # of a survey, evenly spaced: the calibration selects 150 of its frames
MAX_BLOCK_FRAMES = 8192  # of a long take that are compared or written at once
BREAK_S = 1.0  # without samples between two pieces, so that nothing is taken for one motion
MIN_SURVEYED_S = 0.5  # for which a survey shows each marker, if the take does


class Window(NamedTuple):
    """The frames first..stop - 1 of a take, which are cleaned together. The result has start..end - 1 of them."""

    first: int
    stop: int
    start: int
    end: int


def plan_windows(visible: Bool[np.ndarray, "T M"], rate: float, window_frames: int = WINDOW_FRAMES) -> list[Window]:
    """Return the windows in which a long take is cleaned, in order.

    Args:
        visible: Which samples the take has.
        window_frames: The length of a window without its overlaps, about.
    """
    frame_count = len(visible)
    count = -(-frame_count // window_frames)
    cuts = [_find_cut(visible, round(n * frame_count / count), rate, frame_count // (4 * count)) for n in range(1, count)]
    is_shown, edges = visible.sum(1) >= visible.shape[1] / 2, [0]
    for cut in [*cuts, frame_count]:
        edges += [cut] * bool(is_shown[edges[-1] : cut].sum() >= MIN_SHOWN_S * rate)
    edges = [0, *edges[1:-1], frame_count]  # what is too short at the end belongs to the last window
    overlaps = [(0, 0), *(_measure_overlap(visible, cut, rate) for cut in edges[1:-1]), (0, 0)]
    return [
        Window(max(0, start - before), min(frame_count, end + after), start, end)
        for (start, end), ((before, _), (_, after)) in zip(pairwise(edges), pairwise(overlaps), strict=True)
    ]


def _find_cut(visible: Bool[np.ndarray, "T M"], place: int, rate: float, max_distance: int) -> int:
    """Return the frame near a place around which fewest samples are missing; the nearest of these."""
    reach, margin = min(round(CUT_SEARCH_S * rate), max_distance), round(CUT_SMOOTHING_S * rate)
    first, frames = max(0, place - reach - margin), np.arange(place - reach, place + reach)
    missing = np.convolve((~visible[first : place + reach + margin]).sum(1), np.ones(2 * margin + 1), "same")
    return int(frames[(missing[frames - first] + np.abs(frames - place) / (2 * reach)).argmin()])


def _measure_overlap(visible: Bool[np.ndarray, "T M"], cut: int, rate: float) -> tuple[int, int]:
    """Return by how many frames the windows overlap before and after a cut: gaps across it end within, if they are short."""
    longest = round(MAX_OVERLAP_S * rate)
    sides = visible[max(0, cut - longest) : cut][::-1], visible[cut : cut + longest]
    gaps = [np.where(side.any(0), side.argmax(0), 0).max() for side in sides]
    before, after = (round(max(OVERLAP_S * rate, min(gap + CUT_SMOOTHING_S * rate, longest))) for gap in gaps)
    return before, after


def build_survey(take: Take) -> tuple[Take, Int[np.ndarray, " S"]]:
    """Return pieces of a take as one take of S frames, and which frames of the take they are, -1 between two pieces."""
    length, visible = round(PIECE_S * take.rate), take.visible
    starts, is_surveyed = np.linspace(0, take.frame_count - length, PIECE_COUNT).astype(int), np.zeros(take.frame_count, bool)
    is_surveyed[starts[:, None] + np.arange(length)] = True
    for m in np.flatnonzero(visible.any(0)):
        if visible[is_surveyed, m].sum() < MIN_SURVEYED_S * take.rate:
            shown = np.flatnonzero(visible[:, m])
            start = min(max(0, int(shown[len(shown) // 2]) - length // 2), take.frame_count - length)
            is_surveyed[start : start + length] = True
    frames = np.flatnonzero(is_surveyed)
    pieces = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    order = np.concatenate([part for piece in pieces for part in (piece, np.full(round(BREAK_S * take.rate), -1))][:-1])
    survey = select_frames(replace(take, layout=None, labelled_file=None, unlabelled=None, computed_points=None), order)
    return replace(survey, markers=np.where((order >= 0)[:, None, None], survey.markers, np.nan)), order


Value = TypeVar("Value")


def map_arrays(value: Value, frame_count: int, change: Callable[[str, np.ndarray], np.ndarray], path: str = "") -> Value:
    """Return a value, of nested data classes, with others in place of the arrays that have a row for each frame.

    Args:
        change: Called with the names of the fields that lead to an array, and the array.
    """
    given: Any = value
    if isinstance(given, np.ndarray):
        given = change(path, given) if given.ndim and len(given) == frame_count else given
    elif is_dataclass(value) or hasattr(given, "_fields"):
        names = [each.name for each in fields(given)] if is_dataclass(value) else given._fields
        new = {name: map_arrays(getattr(given, name), frame_count, change, f"{path}.{name}") for name in names}
        given = replace(given, **new) if is_dataclass(value) else given._replace(**new)
    return cast("Value", given)


def select_frames(take: Take, frames: slice | Int[np.ndarray, " N"]) -> Take:
    """Return some frames of a long take, in double precision."""

    def select(_: str, array: np.ndarray) -> np.ndarray:
        return np.array(array[frames], float if array.dtype == np.float32 else array.dtype)

    first = frames.start if isinstance(frames, slice) else 0
    return replace(map_arrays(take, take.frame_count, select), first_frame=take.first_frame + first)


def extract_window(take: Take, window: Window) -> Take:
    """Return the frames of a window as a part of the take."""
    sides = take.visible[: window.first][::-1], take.visible[window.stop :]
    is_seen = np.stack([side.any(0) for side in sides])
    gaps = [np.where(seen, side.argmax(0) if len(side) else 0, len(side)) for seen, side in zip(is_seen, sides, strict=True)]
    return replace(select_frames(take, slice(window.first, window.stop)), part=TakePart(window.first, np.stack(gaps), is_seen))


def select_marker_places(detected: Detected, body: BodyFit, frame: int) -> Subject:
    """Return the subject with its markers where they are on the body in a frame: markers may have been moved before or after."""
    subject, epochs, columns = body.subject, detected.epochs, body.marker_columns
    offsets, count = subject.marker_offsets.copy(), len(subject.labels)
    carrier = {int(epochs.column_marker[column]): k for k, column in enumerate(columns[:count].tolist()) if column >= 0}
    for n in range(count, len(columns)):
        if epochs.is_active[frame, columns[n]]:
            offsets[carrier[int(epochs.column_marker[columns[n]])]] = body.extended_subject.marker_offsets[n]
    return replace(subject, marker_offsets=offsets)


def crop_intervals(items: Iterable[Value], frames: slice) -> list[Value]:
    """Return the intervals, such as faults, that meet some frames: their part within, counted from the first of the frames.

    A marker shift, which goes on to the end, is left out unless it begins within them.
    """
    cropped: list[Any] = []
    for each in cast("Iterable[Any]", items):
        first, end = each.first - frames.start, frames.stop - 1 - frames.start
        last = min(each.last - frames.start, end)
        if not isinstance(each, MarkerShift):
            cropped += [replace(each, first=max(first, 0), last=last)] if max(first, 0) <= last else []
        elif 0 <= first <= end:
            cropped.append(replace(each, first=first, last=end, settled_frame=each.settled_frame - frames.start))
    return cropped


def join_at_cuts(items: Iterable[Value], cuts: Collection[int], get_key: Callable[[Value], Hashable]) -> list[Value]:
    """Return intervals in order of their first frames, with those as one that meet at a cut and have the same key."""
    joined: list[Any] = []
    latest: dict[Hashable, int] = {}
    for each in sorted(cast("Iterable[Any]", items), key=lambda item: item.first):
        key = get_key(each)
        n = latest.get(key, -1)
        if n >= 0 and each.first in cuts and joined[n].last + 1 == each.first:
            joined[n] = _join_two(joined[n], each)
        else:
            latest[key] = len(joined)
            joined.append(each)
    return joined


def _join_two(one: Any, other: Any) -> Any:
    """Return two parts of an interval as one: as the more severe of a fault, as the longer of a change with the error of both."""
    if isinstance(one, Fault):
        return replace(other if other.severity > one.severity else one, first=one.first, last=other.last)
    if not isinstance(one, Change):
        return replace(one, last=other.last)
    main = one if one.samples >= other.samples else other
    before = SampleState(one.before.missing + other.before.missing, main.before.off_body_mm)
    after, samples = SampleState(one.after.missing + other.after.missing, main.after.off_body_mm), one.samples + other.samples
    frames = [each.last + 1 - each.first for each in (one, other) if each.predicted_mm is not None]
    squares = [each.predicted_mm**2 for each in (one, other) if each.predicted_mm is not None]
    joined = replace(main, id=one.id, first=one.first, last=other.last, samples=samples, before=before, after=after)
    return replace(joined, predicted_mm=round(float(np.sqrt(np.average(squares, weights=frames))), 1) if squares else None)


def _send_array(array: "np.memmap[Any, Any]") -> Any:
    """Return how an array is pickled: that of a whole file by the file's name."""
    is_whole = isinstance(array.base, mmap.mmap) and len(array.base) == array.nbytes
    return (np.memmap, (array.filename, array.dtype, "r", 0, array.shape)) if is_whole else np.asarray(array).__reduce__()


copyreg.pickle(np.memmap, _send_array)
ARRAY_FOLDER: dict[str, Any] = {"prefix": "mocapfix-", "ignore_cleanup_errors": True}


def write_rows(path: Path, first: int, values: np.ndarray) -> np.ndarray:
    """Write some rows of an array, of which `first` is the first, into its file, numbers in 32 bits. Returns none of the rows."""
    values = values.astype({"f": np.float32, "i": np.int32}.get(values.dtype.kind, values.dtype), copy=False)
    path.touch()
    with path.open("r+b") as file:
        file.seek(first * values[:1].nbytes)
        file.write(np.ascontiguousarray(values).data)
    return np.empty((0, *values.shape[1:]), values.dtype)


def open_array(folder: tempfile.TemporaryDirectory[str], name: str, like: np.ndarray, frame_count: int) -> np.ndarray:
    """Return the array in a file of a folder, which is removed with the last of them; `like` itself where there is no file."""
    path, shape = Path(folder.name) / name, (frame_count, *like.shape[1:])
    if not path.exists() or 0 in shape:
        return np.empty(shape, like.dtype) if path.exists() else like
    array = np.memmap(path, like.dtype, "r", shape=shape)
    weakref.finalize(array.base, id, folder)  # keeps the folder until then
    return array


def release_pages(value: object, frame_count: int) -> None:
    """Give back the memory of what was read from the files of a value's arrays, where the system allows that."""

    def release(_: str, array: np.ndarray) -> np.ndarray:
        if isinstance(array.base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
            array.base.madvise(mmap.MADV_DONTNEED)
        return array

    map_arrays(value, frame_count, release)


def iterate_blocks(value: Value, frame_count: int, block_frames: int = 0) -> Iterator[tuple[slice, Value]]:
    """Yield blocks of frames, and a value there. What was read from the files of its arrays leaves the memory after each."""
    for first in range(0, frame_count, length := block_frames or MAX_BLOCK_FRAMES):
        frames = slice(first, min(first + length, frame_count))
        yield frames, select_block(value, frame_count, frames)
        release_pages(value, frame_count)


def select_block(value: Value, frame_count: int, frames: slice) -> Value:
    """Return a value there."""
    return map_arrays(value, frame_count, lambda name, of: of if name.endswith("point_columns") else of[frames])


def join_columns(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays of T frames side by side along their second axis: in a file if the first is in one, itself if it is alone."""
    if len(parts) == 1:
        return parts[0]
    if not isinstance(parts[0].base, mmap.mmap):
        return np.concatenate(parts, axis=1)
    folder, joined = tempfile.TemporaryDirectory(**ARRAY_FOLDER), parts[0]
    for first in range(0, len(parts[0]), MAX_BLOCK_FRAMES):
        rows = np.concatenate([each[first : first + MAX_BLOCK_FRAMES] for each in parts], axis=1)
        joined = write_rows(Path(folder.name) / "joined", first, rows)
    return open_array(folder, "joined", joined, len(parts[0]))


def store_take(take: Take) -> Take:
    """Return a long take with its arrays in files, positions in single precision: it `is_stored`, and cleaned in windows."""
    folder = tempfile.TemporaryDirectory(**ARRAY_FOLDER)

    def store(path: str, array: np.ndarray) -> np.ndarray:
        return open_array(folder, path, write_rows(Path(folder.name) / path, 0, array), take.frame_count)

    return map_arrays(take, take.frame_count, store)


def is_stored(take: Take) -> bool:
    """Return whether a take is cleaned in windows: `store_take` returned it, or it was extracted from such a take."""
    return take.markers.dtype == np.float32
