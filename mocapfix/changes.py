"""Changes: what was done to a take, interval by interval, and what somebody decides of it."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

import numpy as np

from mocapfix.faults import EXTERNAL_FILL_KINDS, LABEL_KINDS, REPLACED_SAMPLE_KINDS, Fault, Fragment, MarkerShift
from mocapfix.take import Take

# MERGED: mocapfix.changes
Decision = Literal["accept", "reject", "keep"]


@dataclass(frozen=True)
class SampleState:
    """An interval's samples at one time: how many are missing, and how far, by the median, the others lie from where the solved
    body has the marker, in millimetres (None where nobody knows)."""

    missing: int
    off_body_mm: float | None


@dataclass(frozen=True)
class Change:
    """One interval of one marker, or of several whose labels it is about, and what was done there.

    id         names it in the record, the same whenever the take is cleaned
    markers    labels: the marker's, then the others' concerned, and the donor's of a fragment
    first, last  the file's own frame numbers, inclusive
    why        what was wrong, one sentence
    samples    how many samples are other than they were
    method     how it was mended
    predicted_mm  root mean square of the predicted error, a distance; None where nothing was estimated
    decision   "accept": it is made; "reject": it is not; "keep": it is not, and what was measured is believed
    """

    id: str
    kind: str
    markers: tuple[str, ...]
    first: int
    last: int
    samples: int
    why: str
    method: str
    before: SampleState
    after: SampleState
    predicted_mm: float | None
    decision: Decision = "accept"


def list_affected_markers(fault: Fault, marker_count: int) -> list[int]:
    """-> of a take's `count` markers those whose samples a fault is about."""
    donor = (fault.donor,) if isinstance(fault, Fragment) else ()
    return list(dict.fromkeys(m for m in (*fault.markers, *donor) if m < marker_count))


def build_affected_mask(fault: Fault, relabelled: Take) -> np.ndarray:
    """-> (T, M) bool: the samples that a fault is about, in a take whose labels are right; what is missing among samples that
    are judged faulty is a gap's matter."""
    mask = np.zeros(relabelled.visible.shape, bool)
    mask[fault.frame_slice, list_affected_markers(fault, len(relabelled.labels))] = True
    return mask & relabelled.visible if fault.kind in (*REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS) else mask


def compare_samples(before: Take, after: Take) -> np.ndarray:
    """-> (T, M) bool: is the sample another one, or gone, or there, or did it come from elsewhere?"""
    same = (before.markers == after.markers).all(-1) | ~before.visible & ~after.visible
    return ~same | (before.source_points != after.source_points) & (before.visible | after.visible)


def build_changes(
    before: Take,
    relabelled: Take,
    after: Take,
    faults: Iterable[Fault],
    body_markers: np.ndarray | None,
    fill_methods: np.ndarray,
) -> list[tuple[Change, Fault]]:
    """-> an entry for every fault of which something was made, in the order of the faults.

    before, labelled, after  the take as it was read, with its labels right, and as it was mended
    body  (T, M, 3) metres: where the solved body has the markers, NaN where it has none; None without one
    ways  (T, M) how each sample was found that was filled, "" for others
    """
    changed, found, names = compare_samples(before, after), [], {}
    for fault in faults:
        where = build_affected_mask(fault, relabelled)
        count = 0 if isinstance(fault, MarkerShift) else int(changed[where].sum())
        if not count and not isinstance(fault, MarkerShift):
            continue
        label, first = before.get_label(fault.marker), before.get_frame_number(fault.first)
        name = f"{fault.kind}-{label}-{first}".replace(" ", "-")
        names[name] = names.get(name, 0) + 1
        change = Change(
            id=name if names[name] == 1 else f"{name}-{names[name]}",
            kind=fault.kind,
            markers=tuple(before.get_label(m) for m in _list_named_markers(fault)),
            first=first,
            last=before.get_frame_number(fault.last),
            samples=count,
            why=fault.reason,
            method=_describe_method(fault, before, fill_methods[where]),
            before=_measure_state(before if affects_labels(fault) else relabelled, where, body_markers),
            after=_measure_state(after, where, body_markers),
            predicted_mm=_compute_predicted_error_mm(after, where),
        )
        found.append((change, fault))
    return found


def _list_named_markers(fault: Fault) -> tuple[int, ...]:
    donor = (fault.donor,) if isinstance(fault, Fragment) else ()
    return tuple(dict.fromkeys((*fault.markers, *donor)))


def affects_labels(fault: Fault) -> bool:
    """Is it about whose the samples are?"""
    return fault.kind in LABEL_KINDS or isinstance(fault, Fragment)


def _describe_method(fault: Fault, take: Take, fill_methods: np.ndarray) -> str:
    if fault.kind in LABEL_KINDS:
        return "labels exchanged back"
    if isinstance(fault, Fragment):
        return f"samples of {take.get_label(fault.donor)} taken over"
    if isinstance(fault, MarkerShift):
        return "given its new place on the body; its samples stay as measured"
    found = Counter(way for way in fill_methods.ravel() if way)
    return f"estimated, mostly from {found.most_common(1)[0][0]}" if found else "taken out"


def _measure_state(take: Take, mask: np.ndarray, body_markers: np.ndarray | None) -> SampleState:
    off = np.full(1, np.nan) if body_markers is None else np.linalg.norm(take.markers[mask] - body_markers[mask], axis=-1)
    known = off[~np.isnan(off)]
    return SampleState(int((~take.visible[mask]).sum()), round(float(np.median(known)) * 1e3, 1) if len(known) else None)


def _compute_predicted_error_mm(take: Take, mask: np.ndarray) -> float | None:
    deviation = np.zeros(0) if take.sample_sd is None else take.sample_sd[mask]
    known = deviation[~np.isnan(deviation)]
    return round(float(np.sqrt(3 * (known**2).mean())) * 1e3, 1) if len(known) else None


# MERGED: mocapfix.left
# What a cleaning leaves empty.
@dataclass(frozen=True)
class UnfilledRun:
    """Samples that stay missing: a marker over first..last (indices into the take, inclusive), and why."""

    marker: int
    first: int
    last: int
    reason: str


def expand_unfilled_reasons(unfilled: Iterable[UnfilledRun], shape: tuple[int, int]) -> np.ndarray:
    """-> `shape` (T, M) object: why each sample is left empty, "" where nobody said."""
    said = np.full(shape, "", object)
    for each in unfilled:
        said[each.first : each.last + 1, each.marker] = each.reason
    return said


def find_unfilled_runs(take: Take, reasons: np.ndarray) -> tuple[UnfilledRun, ...]:
    """-> what is missing in a take, in runs of one reason each, by marker and first frame; `said` (T, M) as `reasons`."""
    found = []
    for m in range(len(take.labels)):
        for reason, frames in groupby(np.flatnonzero(~take.visible[:, m]), key=lambda t, m=m: reasons[t, m]):
            each = list(frames)
            breaks = np.flatnonzero(np.diff(each) > 1)
            for a, b in zip([0, *(breaks + 1)], [*breaks, len(each) - 1], strict=True):
                found.append(UnfilledRun(m, int(each[a]), int(each[b]), reason))
    return tuple(sorted(found, key=lambda one: (one.marker, one.first)))
