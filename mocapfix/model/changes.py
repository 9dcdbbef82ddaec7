"""Changes to a take, interval by interval, and the runs of samples that a cleaning leaves unfilled."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.model.detected import Detected
from mocapfix.model.faults import EXTERNAL_FILL_KINDS, LABEL_KINDS, REPLACED_SAMPLE_KINDS, Decision, Fault, Fragment, MarkerShift
from mocapfix.model.take import Take
from mocapfix.options import FillOptions
from mocapfix.stats.marker_distances import RigidGroup
from mocapfix.stats.rigid_alignment import compute_lengths

KEYS_METHOD = "points that a reviewer set by hand"
# The frame and the marker of each of N samples.
_SampleIndices = tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]


@dataclass(frozen=True)
class SampleState:
    """The samples of an interval at one stage.

    Attributes:
        missing: Number of missing samples.
        off_body_mm: Median distance in millimetres of the other samples from the solved body's markers. None if unknown.
    """

    missing: int
    off_body_mm: float | None


@dataclass(frozen=True)
class Change:
    """A change to an interval of one marker, or of several markers whose labels are changed.

    Attributes:
        id: Name of the change in the report. Cleaning the same take again gives the same name.
        kind: The kind of fault that it repairs.
        markers: Labels of the marker, of the other markers concerned, and of a fragment's donor.
        first: First frame, in the file's own numbers.
        last: Last frame, in the file's own numbers, inclusive.
        samples: Number of samples that differ from the file.
        why: What is wrong, in one sentence.
        method: How it is repaired.
        before: The samples as they were.
        after: The samples as they are now.
        predicted_mm: Root mean square of the predicted distance error, in millimetres. None if nothing was estimated.
        decision: "accept": the change is made. "reject": it is not made. "keep": it is not made, and the solve uses the
            samples as measured.
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


def serialize_changes(changes: Iterable[Change]) -> list[dict[str, Any]]:
    """Return the changes as plain data, as in the changes file and the JSON report."""
    parts = ((vars(each), [*each.markers], {**vars(each.before)}, {**vars(each.after)}) for each in changes)
    return [{**own, "markers": markers, "before": before, "after": after} for own, markers, before, after in parts]


def list_affected_markers(fault: Fault, marker_count: int) -> list[int]:
    """Return the indices, below `marker_count`, of the markers whose samples a fault concerns."""
    return [m for m in _list_named_markers(fault) if m < marker_count]


def build_affected_mask(faults: Iterable[Fault], relabelled: Take) -> Bool[np.ndarray, "T M"]:
    """Return the mask of the samples that any of the faults concerns, in a take with correct labels.

    A fault of visible samples does not concern the missing samples among them: those belong to a gap.
    """
    mask = np.zeros(relabelled.visible.shape, bool)
    for fault in faults:
        mask[_find_affected_samples(fault, relabelled)] = True
    return mask


def _find_affected_samples(fault: Fault, relabelled: Take) -> _SampleIndices:
    """Return the indices (frames, markers) of the samples that a fault concerns (see `build_affected_mask`)."""
    markers = np.sort(np.array(list_affected_markers(fault, len(relabelled.labels)), int))
    concerns_missing = fault.kind not in (*REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS)
    frames, columns = np.nonzero(relabelled.visible[fault.frame_slice, markers] | concerns_missing)
    return frames + fault.first, markers[columns]


def compare_samples(before: Take, after: Take) -> Bool[np.ndarray, "T M"]:
    """Return the mask of the samples that changed, appeared, vanished or come from another point of the file."""
    is_same = (before.markers == after.markers).all(-1) | ~before.visible & ~after.visible
    return ~is_same | (before.source_points != after.source_points) & (before.visible | after.visible)


def build_changes(
    before: Take,
    relabelled: Take,
    after: Take,
    faults: Iterable[Fault],
    body_markers: Float[np.ndarray, "T M 3"] | None,
    fill_methods: Shaped[np.ndarray, "T M"],
) -> list[tuple[Change, Fault]]:
    """Build an entry for every fault that led to a change.

    Args:
        before: The take as read.
        relabelled: The take with correct labels.
        after: The repaired take.
        faults: The faults that were repaired.
        body_markers: World positions of the solved body's markers in metres, NaN for markers that it lacks. None without
            a solved body.
        fill_methods: The method by which each sample was filled, "" for samples that were not filled.

    Returns:
        The changes and their faults, in the order of the faults.
    """
    faults = list(faults)
    if not faults:
        return []
    is_changed = compare_samples(before, after)
    places = np.full(before.markers.shape, np.nan) if body_markers is None else body_markers
    off_body_m = {id(take): compute_lengths(take.markers - places) for take in (before, relabelled, after)}
    changes: list[tuple[Change, Fault]] = []
    id_counts: Counter[str] = Counter()
    for fault in faults:
        samples = _find_affected_samples(fault, relabelled)
        is_shift = isinstance(fault, MarkerShift)
        sample_count = 0 if is_shift else int(np.count_nonzero(is_changed[samples]))
        if not sample_count and not is_shift:
            continue
        label, first = before.get_label(fault.marker), before.get_frame_number(fault.first)
        name = f"{fault.kind}-{label}-{first}".replace(" ", "-")
        id_counts[name] += 1
        take_before = before if affects_labels(fault) else relabelled
        change = Change(
            id=name if id_counts[name] == 1 else f"{name}-{id_counts[name]}",
            kind=fault.kind,
            markers=tuple(before.get_label(m) for m in _list_named_markers(fault)),
            first=first,
            last=before.get_frame_number(fault.last),
            samples=sample_count,
            why=fault.reason,
            method=_describe_method(fault, before, fill_methods[samples]),
            before=_measure_state(take_before, samples, off_body_m[id(take_before)]),
            after=_measure_state(after, samples, off_body_m[id(after)]),
            predicted_mm=_compute_predicted_error_mm(after, samples),
        )
        changes.append((change, fault))
    return changes


def affects_labels(fault: Fault) -> bool:
    """Return whether the fault is about which marker the samples belong to."""
    return fault.kind in LABEL_KINDS or isinstance(fault, Fragment)


def _list_named_markers(fault: Fault) -> tuple[int, ...]:
    """Return the indices of the fault's markers and of a fragment's donor, without repetitions."""
    donor = (fault.donor,) if isinstance(fault, Fragment) else ()
    return tuple(dict.fromkeys((*fault.markers, *donor)))


def _describe_method(fault: Fault, take: Take, fill_methods: np.ndarray) -> str:
    if fault.kind in LABEL_KINDS:
        return "labels exchanged back"
    if isinstance(fault, Fragment):
        return f"samples of {take.get_label(fault.donor)} joined to the marker"
    if isinstance(fault, MarkerShift):
        return "new marker position on the body; the samples are unchanged"
    methods = Counter(filter(None, fill_methods.tolist()))
    by_hand = f", some from {KEYS_METHOD}" if len(methods) > 1 and KEYS_METHOD in methods else ""
    return f"estimated, mostly from {methods.most_common(1)[0][0]}{by_hand}" if methods else "removed"


def _measure_state(take: Take, samples: _SampleIndices, off_body_m: np.ndarray) -> SampleState:
    distance_m = off_body_m[samples]
    known = distance_m[~np.isnan(distance_m)]
    median_m = float(known[0] if len(known) == 1 else np.median(known)) if len(known) else None
    missing_count = len(distance_m) - int(np.count_nonzero(take.visible[samples]))
    return SampleState(missing_count, None if median_m is None else round(median_m * 1e3, 1))


def _compute_predicted_error_mm(take: Take, samples: _SampleIndices) -> float | None:
    sample_sd = np.zeros(0) if take.sample_sd is None else take.sample_sd[samples]
    known = sample_sd[~np.isnan(sample_sd)]
    return round(compute_distance_error_mm(known), 1) if len(known) else None


def compute_distance_error_mm(sd_m: Float[np.ndarray, " N"]) -> float:
    """Return the predicted error of N samples: the root mean square of the distance, which has three axes alike.

    Args:
        sd_m: The standard deviation of each per axis, in metres.
    """
    return float(np.sqrt(3 * (sd_m**2).mean())) * 1e3


@dataclass(frozen=True)
class UnfilledRun:
    """A run of samples that stay missing.

    Attributes:
        marker: Index of the marker.
        first: Index of the first frame.
        last: Index of the last frame, inclusive.
        reason: Why the samples are not filled.
    """

    marker: int
    first: int
    last: int
    reason: str


def find_unfilled_runs(take: Take, reasons: Shaped[np.ndarray, "T M"]) -> tuple[UnfilledRun, ...]:
    """Find the runs of missing samples with the same reason, "" without one, ordered by marker and first frame."""
    unfilled: list[UnfilledRun] = []
    for m in range(len(take.labels)):
        for reason, group in groupby(np.flatnonzero(~take.visible[:, m]), key=lambda t, m=m: reasons[t, m]):
            frames = list(group)
            breaks = np.flatnonzero(np.diff(frames) > 1)
            for a, b in zip([0, *(breaks + 1)], [*breaks, len(frames) - 1], strict=True):
                unfilled.append(UnfilledRun(m, int(frames[a]), int(frames[b]), str(reason)))
    return tuple(unfilled)


def compute_editable_mask(take: Take, options: FillOptions) -> Bool[np.ndarray, "T M"]:
    """Return which samples the options `keep` and `frames` allow to change."""
    is_editable = np.ones(take.visible.shape, bool)
    for m, (label, bare_label) in enumerate(zip(take.labels, take.bare_labels, strict=True)):
        is_editable[:, m] = label not in options.keep and bare_label not in options.keep
    if options.frames:
        numbers = take.first_frame + np.arange(take.frame_count)
        is_editable &= ((numbers >= options.frames[0]) & (numbers <= options.frames[1]))[:, None]
    return is_editable


@dataclass(frozen=True)
class Filled:
    """A take with every gap and faulty sample filled or emptied, before decisions are applied.

    Attributes:
        detected: Its faults.
        take: The filled take.
        unfilled_reasons: The reason why each sample stays empty, else "".
        methods: For each filled sample the name of its fill method, else "".
        body_markers: Metres: where the solved body carries the markers; None without a body.
        rigid_groups: Groups of markers that are not on the body, such as props.
    """

    detected: Detected
    take: Take
    unfilled_reasons: Shaped[np.ndarray, "T M"]
    methods: Shaped[np.ndarray, "T M"]
    body_markers: Float[np.ndarray, "T M 3"] | None
    rigid_groups: tuple[RigidGroup, ...] = ()


@dataclass(frozen=True)
class Decided:
    """A cleaned take, with every change that was considered and its decision, and the runs of samples that stay empty."""

    detected: Detected
    take: Take
    changes: tuple[Change, ...]
    unfilled_runs: tuple[UnfilledRun, ...]
    rigid_groups: tuple[RigidGroup, ...]  # those of `Filled`
