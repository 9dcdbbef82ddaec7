"""What the picture of a change shows: the markers' paths over the change's frames and half a second beside them.

Paths are seen from the markers nearest by, which takes the body's own motion out of the picture; for a marker that moved on
its segment there are its distances from those that show it best instead, which do not heed how the segment turns. A joint's
tip is seen from the tip of the joint it hangs on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mocapfix.animation import Animation
from mocapfix.faults import LABEL_KINDS, Fault, MarkerShift
from mocapfix.report.comparison import CleaningComparison
from mocapfix.take import Take

CURVE_MARGIN_S = 0.5  # seconds before and after the change
MAX_CURVE_POINTS = 150  # of a path over the whole picture, and as many over the change alone, at most
REFERENCE_MARKER_COUNT, MAX_REFERENCE_DISTANCE_M = 3, 0.6  # markers from which a picture is seen, and metres from them at most
REFERENCE_CANDIDATE_COUNT = 10  # near markers, of which those that show best that one moved are taken
MAX_CURVE_MARKERS = 3  # paths in a picture
MAX_LABEL_CURVE_DURATION_S = 5.0  # seconds of an exchange of labels: what follows looks the same
BAND_SD_MULTIPLE = 2  # standard deviations to either side of a path: 95 in 100 lie between


@dataclass(frozen=True)
class MarkerCurve:
    """One marker's path: how it was ("was"), is ("now"), or both ("kept"); values (N, S) millimetres, NaN where it is not.

    rank  0 for the marker that the change is about, 1, 2 for the others concerned
    """

    kind: Literal["kept", "was", "now"]
    values_mm: np.ndarray
    rank: int = 0


@dataclass(frozen=True)
class ChangeCurves:
    """frames (N,) indices of the values; strips S names of what they are; seen_from names of markers, none for the room;
    band (N, S, 2) millimetres, NaN where nothing was estimated: the path with its predicted error to either side."""

    frames: np.ndarray
    axis_names: tuple[str, ...]
    reference_labels: tuple[str, ...]
    curves: tuple[MarkerCurve, ...]
    band_mm: np.ndarray


def build_change_curves(comparison: CleaningComparison, fault: Fault) -> ChangeCurves:
    """-> the paths of the markers that a fault is about, before and after."""
    frames, about = _select_frames(fault, comparison.cleaned_take), comparison.find_affected_trajectories(fault)
    near = _find_reference_markers(comparison.cleaned_take, about, frames)
    if isinstance(fault, MarkerShift) and near:
        return _build_distance_curves(comparison.cleaned_take, fault, frames, near[:REFERENCE_CANDIDATE_COUNT])
    beside = near[:REFERENCE_MARKER_COUNT]
    labels = tuple(comparison.cleaned_take.labels[m] for m in beside)
    origin = comparison.cleaned_take.markers[frames][:, beside].mean(axis=1) if beside else np.zeros((len(frames), 3))
    paths: list[MarkerCurve] = []
    for rank, m in enumerate(about[:MAX_CURVE_MARKERS]):
        was, now = (1e3 * (_get_position(take, m)[frames] - origin) for take in (comparison.input_take, comparison.cleaned_take))
        paths += _split_by_change(was, now, rank)
    now, sure = (
        1e3 * (_get_position(comparison.cleaned_take, about[0])[frames] - origin),
        _get_fill_sd(comparison.cleaned_take, about[0])[frames, None],
    )
    band = np.stack([now - BAND_SD_MULTIPLE * 1e3 * sure, now + BAND_SD_MULTIPLE * 1e3 * sure], axis=-1)
    return ChangeCurves(frames, ("x", "y", "z"), labels, tuple(paths), band)


def _select_frames(fault: Fault, take: Take) -> np.ndarray:
    """-> the frames of a picture: those of a short change all, those of a long one now and then."""
    margin = max(2, round(CURVE_MARGIN_S * take.rate))
    last = (
        min(fault.last, fault.first + round(MAX_LABEL_CURVE_DURATION_S * take.rate)) if fault.kind in LABEL_KINDS else fault.last
    )
    begin, end = 0 if isinstance(fault, MarkerShift) else max(0, fault.first - margin), min(take.frame_count - 1, last + margin)
    inside = np.linspace(max(begin, fault.first - 1), min(end, last + 1), MAX_CURVE_POINTS)
    return np.unique(np.concatenate([np.linspace(begin, end, MAX_CURVE_POINTS), inside]).round().astype(int))


def _find_reference_markers(take: Take, trajectories: Sequence[int], frames: np.ndarray) -> list[int]:
    """-> the markers near the first one of `about` that are there whenever it is, the nearest first; none of `about`.
    Of an animation's joint it is the one that it hangs on."""
    if isinstance(take.layout, Animation):
        above = [*take.layout.parents, -1][trajectories[0]]
        return [int(above)] if above >= 0 else []
    path = _get_position(take, trajectories[0])[frames]
    there = ~np.isnan(path[:, 0])
    if not there.any():
        return []
    middle = np.median(np.linalg.norm(take.markers[frames[there]] - path[there, None], axis=-1), axis=0)  # NaN where one is not
    middle[[m for m in trajectories if m < len(take.labels)]] = np.nan
    return [int(m) for m in np.argsort(middle) if middle[m] < MAX_REFERENCE_DISTANCE_M]


def _get_position(take: Take, index: int) -> np.ndarray:
    """-> (T, 3) metres: a marker's path or, from their number on, an unlabelled trajectory's."""
    if index < len(take.labels) or take.unlabelled is None:
        return take.markers[:, index]
    return take.unlabelled.markers[:, index - len(take.labels)]


def _get_fill_sd(take: Take, index: int) -> np.ndarray:
    """-> (T,) metres: the samples' predicted standard deviation, NaN where they were measured."""
    if take.sample_sd is None or index >= len(take.labels):
        return np.full(take.frame_count, np.nan)
    return take.sample_sd[:, index]


def _split_by_change(before_mm: np.ndarray, after_mm: np.ndarray, rank: int) -> list[MarkerCurve]:
    """was, now (N, 3) -> what is as it was, what was otherwise, and how that is now; each reaches to the next sample."""
    changed = ~((before_mm == after_mm) | np.isnan(before_mm) & np.isnan(after_mm)).all(axis=1)
    reach = changed.copy()
    reach[1:] |= changed[:-1]
    reach[:-1] |= changed[1:]
    return [
        MarkerCurve("kept", _mask_values(~changed, after_mm), rank),
        MarkerCurve("was", _mask_values(reach, before_mm), rank),
        MarkerCurve("now", _mask_values(reach, after_mm), rank),
    ]


def _mask_values(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.where(mask[:, None], values, np.nan)


def _build_distance_curves(take: Take, fault: MarkerShift, frames: np.ndarray, reference_markers: Sequence[int]) -> ChangeCurves:
    """-> how far a marker that moved is from the neighbours that show it best: at its old place, on the way, at its new one."""
    apart = 1e3 * np.linalg.norm(
        take.markers[frames][:, reference_markers] - take.markers[frames, fault.marker][:, None], axis=-1
    )
    old, new = frames < fault.first, frames >= fault.settled_frame
    clear = np.zeros(len(reference_markers))
    if (seen := ~np.isnan(apart[:, 0]))[old].any() and seen[new].any():
        (was, scatter), (now, rest) = ((each.mean(axis=0), each.std(axis=0)) for each in (apart[old & seen], apart[new & seen]))
        clear = abs(now - was) / (scatter + rest + 1e-9)
    best = np.argsort(-clear, kind="stable")[:REFERENCE_MARKER_COUNT]
    apart, strips = apart[:, best], tuple(take.bare_labels[reference_markers[n]] for n in best)
    paths = (
        MarkerCurve("was", _mask_values(old, apart)),
        MarkerCurve("kept", _mask_values(~old & ~new, apart)),
        MarkerCurve("now", _mask_values(new, apart)),
    )
    return ChangeCurves(frames, strips, (), paths, np.full((*apart.shape, 2), np.nan))
