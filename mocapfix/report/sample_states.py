"""A take before and after cleaning: its faults, its changes and their events, and the state of every sample.

A sample is measured, filled, replaced, relabelled, reassigned, suspect or empty. The HTML report and the recording show this.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, cached_property
from itertools import product
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from mocapfix.contacts.contacts import BodyContacts
from mocapfix.model.changes import Change, list_affected_markers
from mocapfix.model.faults import REPLACED_SAMPLE_KINDS, Decision, Fault, Faults, Fragment, FrameInterval, build_fault_mask
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.take import Take
from mocapfix.model.windows import iterate_blocks
from mocapfix.report.terms import MARKER_TERMS, PointTerms
from mocapfix.stats.rigid_alignment import compute_lengths
from mocapfix.stats.sequences import sample_evenly


class SampleOutcome(IntEnum):
    """Outcome of the cleaning for one sample."""

    MEASURED = 0  # measured and unchanged
    FILLED = 1  # missing before, estimated now
    REPLACED = 2  # faulty before, estimated now
    RELABELLED = 3  # measured, but under another label before
    REASSIGNED = 4  # moved to another label; nothing took its place
    SUSPECT = 5  # judged faulty, but unchanged
    EMPTY = 6  # missing

    @property
    def label(self) -> str:
        """Name in reports and class in the style sheet."""
        return self.name.lower()


# Colours of the reports.
GREEN = "#1f9d57"
RED = "#d93a3a"
AMBER = "#e08a00"
VIOLET = "#7a5bd0"
BLUE = "#3f7fc4"


def classify_samples(
    input_take: Take, relabelled_take: Take, cleaned_take: Take, is_faulty: Bool[np.ndarray, "T M"]
) -> Int[np.ndarray, "T M"]:
    """Return the SampleOutcome of every sample.

    Args:
        relabelled_take: The same with corrected labels.
        cleaned_take: The same with filled and replaced samples.
        is_faulty: The samples of `relabelled_take` that have a fault, or are missing in its frames.
    """
    estimated = ~np.isnan(cleaned_take.estimated_sd)
    relabelled = cleaned_take.visible & (cleaned_take.source_points != input_take.source_points)
    reassigned = _find_reassigned_samples(input_take, cleaned_take, relabelled & ~estimated)
    outcomes = (
        (~cleaned_take.visible & reassigned, SampleOutcome.REASSIGNED),
        (~cleaned_take.visible, SampleOutcome.EMPTY),
        (estimated & ~relabelled_take.visible, SampleOutcome.FILLED),
        (estimated, SampleOutcome.REPLACED),
        (relabelled, SampleOutcome.RELABELLED),
        (is_faulty & relabelled_take.visible, SampleOutcome.SUSPECT),
    )
    conditions, values = zip(*outcomes, strict=True)
    return np.select(conditions, [np.int8(value) for value in values], np.int8(SampleOutcome.MEASURED))


def _find_reassigned_samples(
    input_take: Take, cleaned_take: Take, relabelled: Bool[np.ndarray, "T M"]
) -> Bool[np.ndarray, "T M"]:
    """Return the samples of the input that the cleaned take has under another label, those at `relabelled`."""
    points = input_take.point_indices
    marker_of_point = np.full(1 + max(points.max(initial=0), cleaned_take.source_points.max(initial=0)), -1)
    marker_of_point[points] = np.arange(len(points))
    frame, marker = np.nonzero(relabelled)
    donor = marker_of_point[cleaned_take.source_points[frame, marker]]
    reassigned = np.zeros(input_take.visible.shape, bool)
    reassigned[frame[donor >= 0], donor[donor >= 0]] = True
    return reassigned


def find_estimated_samples(outcome: Integer[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Return the mask of the samples that were estimated: filled or replaced."""
    return (outcome == SampleOutcome.FILLED) | (outcome == SampleOutcome.REPLACED)


def classify_input_samples(
    visible: Bool[np.ndarray, "*shape"], outcome: Integer[np.ndarray, "*shape"]
) -> Int[np.ndarray, "*shape"]:
    """Return the state of every input sample: MEASURED, SUSPECT (faulty), RELABELLED (of another marker) or EMPTY."""
    other_marker = np.isin(outcome, (SampleOutcome.RELABELLED, SampleOutcome.REASSIGNED, SampleOutcome.FILLED))
    states = [SampleOutcome.EMPTY, SampleOutcome.RELABELLED, SampleOutcome.SUSPECT]
    return np.select([~visible, other_marker, outcome != SampleOutcome.MEASURED], states, SampleOutcome.MEASURED)


@runtime_checkable
class ChangedInterval(FrameInterval, Protocol):
    """A change, as it is in the report or as it is in a changes file; see `Change`."""

    @property
    def markers(self) -> Sequence[str]:
        """The labels of its markers."""
        ...

    @property
    def predicted_mm(self) -> float | None:
        """Its predicted error; None if nothing was estimated."""
        ...

    @property
    def decision(self) -> Decision:
        """Whether it is made."""
        ...


ChangeT = TypeVar("ChangeT", bound=ChangedInterval)
# Two changes are of one event if they have at least this share of their frames in common, and the median distance of a marker of
# the one from a marker of the other is not larger. On composed takes of which a tenth is missing, all of 131 lost arms and legs
# are one event, and 42 of 1,485 events hold a gap of another cause.
MIN_EVENT_OVERLAP = 0.5
MAX_EVENT_DISTANCE_M = 0.35
MAX_EVENT_FRAMES = 50  # in which distances are measured


def find_worst_change(changes: Iterable[ChangeT]) -> ChangeT | None:
    """Return the change with the largest predicted error of those that are made; None without a prediction.

    Its error is the worst prediction of the take on all pages, in the tables, and on the terminal.
    """
    made = (each for each in changes if each.decision == "accept" and each.predicted_mm is not None)
    return max(made, key=lambda each: each.predicted_mm or 0.0, default=None)


def group_changes(
    changes: Iterable[ChangeT], labels: Sequence[str], markers: Float[np.ndarray, "T M 3"]
) -> list[tuple[ChangeT, ...]]:
    """Return the events of a take: the changes at one time of neighbouring markers, such as those of a lost arm.

    Events, and the changes of each, are in the order of time; each change is in one event.

    Args:
        labels: The labels of the M markers.
        markers: Their positions in metres after cleaning.
    """
    column, sampled = {label: m for m, label in enumerate(labels)}, markers[sample_evenly(len(markers), MAX_EVENT_FRAMES)]

    @cache
    def are_near(one: str, other: str) -> bool:
        if one == other or not {one, other} <= column.keys():
            return one == other
        distance_m = compute_lengths(sampled[:, column[one]] - sampled[:, column[other]])
        known = distance_m[np.isfinite(distance_m)]
        return bool(len(known) and np.median(known) <= MAX_EVENT_DISTANCE_M)

    ordered = sorted(changes, key=lambda each: each.first)
    events = [[n] for n in range(len(ordered))]  # of each change the changes of its event so far, one list for all of them
    for n, one in enumerate(ordered):
        for k in range(n + 1, len(ordered)):
            other = ordered[k]
            if other.first > one.last + 1 - MIN_EVENT_OVERLAP * (one.last - one.first + 1):
                break
            common, union = (end(one.last, other.last) + 1 for end in (min, max))
            is_same_time = common - other.first >= MIN_EVENT_OVERLAP * (union - one.first)
            pairs, joined = product(one.markers, other.markers), events[k]
            if joined is not events[n] and is_same_time and any(are_near(*pair) for pair in pairs):
                events[n] += joined
                for each in joined:
                    events[each] = events[n]
    return [tuple(ordered[n] for n in sorted(each)) for each in {id(each): each for each in events}.values()]


@dataclass(frozen=True)
class CleaningComparison:
    """A take before and after cleaning."""

    input_take: Take  # the take as read
    relabelled_take: Take  # the same with corrected labels
    cleaned_take: Take
    faults: Faults  # detected faults, indexing the markers of `relabelled_take`
    changes: tuple[Change, ...] = ()  # changes to the take, in the order of the faults
    skeleton: Skeleton | None = None  # skeleton of the solved body; None without a body
    joint_position_world: Float[np.ndarray, "T J 3"] | None = None  # m; None without a body
    # (T, M) distance of each inlier marker from the body in metres, NaN if unknown; None without a body
    residual_m: Float[np.ndarray, "T M"] | None = None
    terms: PointTerms = MARKER_TERMS  # words for the points: markers, or joints of an animation
    contacts: BodyContacts | None = None  # contacts of the body with the floor; None without a body
    # (T, C, 3) m, their joints if `skeleton` is not the body's, as in an animation
    contact_position_world: Float[np.ndarray, "T C 3"] | None = None

    def locate_contacts(self) -> Float[np.ndarray, "T C 3"] | None:
        """Return the positions in metres of the joints that can be in contact; None if they are not known."""
        if self.contact_position_world is not None or self.contacts is None:
            return self.contact_position_world
        if self.skeleton is None or self.joint_position_world is None:
            return None
        return self.joint_position_world[:, [self.skeleton.names.index(joint) for joint in self.contacts.joints]]

    @cached_property
    def sample_states(self) -> Int[np.ndarray, "T M"]:
        is_faulty = build_fault_mask(self.faults.select_kinds(*REPLACED_SAMPLE_KINDS), self.relabelled_take.markers.shape[:2])
        blocks = iterate_blocks(self, self.input_take.frame_count)
        parts = [classify_samples(each.input_take, each.relabelled_take, each.cleaned_take, is_faulty[t]) for t, each in blocks]
        return np.concatenate(parts)

    @cached_property
    def applied_changes(self) -> list[tuple[Change, Fault]]:
        """Changes that were applied, each with the fault that it corrects."""
        return [(change, fault) for change, fault in self._change_fault_pairs if change.decision == "accept"]

    @cached_property
    def events(self) -> list[tuple[Change, ...]]:
        """The events of all changes, the event and in it the change with the largest predicted error first."""
        worst_first = sorted(self.changes, key=lambda change: -(change.predicted_mm or 0.0))
        rank = {id(change): n for n, change in enumerate(worst_first)}
        events = group_changes(self.changes, self.cleaned_take.labels, self.cleaned_take.markers)
        return sorted((tuple(sorted(each, key=lambda x: rank[id(x)])) for each in events), key=lambda each: rank[id(each[0])])

    @cached_property
    def worst_moment(self) -> tuple[int, Change | None]:
        """The frame of the least certain sample of the change that is predicted worst, and this change.

        Without a prediction it is the frame with the most estimated or relabelled markers, then the most empty ones, and None.
        Frames without a body are excluded if there are others. Of several equal frames the middle one is taken.
        """
        worst, sd_m = find_worst_change(change for change, _ in self.applied_changes), self.cleaned_take.sample_sd
        if worst is not None and sd_m is not None:
            fault = next(fault for change, fault in self.applied_changes if change is worst)
            part = sd_m[fault.frame_slice, list_affected_markers(fault, sd_m.shape[1])]
            return fault.first + int(np.where(np.isfinite(part), part, -1.0).max(axis=1).argmax()), worst
        states, joints = self.sample_states, self.joint_position_world
        corrected = find_estimated_samples(states) | (states == SampleOutcome.RELABELLED)
        score = corrected.sum(axis=1) * (states.shape[1] + 1) + (states == SampleOutcome.EMPTY).sum(axis=1)
        if joints is not None:
            is_known = ~np.isnan(joints[..., 0])
            score = np.where(is_known[:, is_known.any(0)].all(1), score, -1)
        frames = np.flatnonzero(score == score.max())
        return int(frames[len(frames) // 2]), None

    @cached_property
    def unchanged_faults(self) -> list[Fault]:
        """Faults without a change, neither applied nor declined; not those of segments of which all gaps are filled."""
        paired, visible = {id(fault) for _, fault in self._change_fault_pairs}, self.cleaned_take.visible
        others = [fault for fault in self.faults.items if id(fault) not in paired]
        return [x for x in others if x.kind != "segment lost" or not visible[x.frame_slice, list(x.markers)].all()]

    def find_affected_trajectories(self, fault: Fault) -> list[int]:
        """Return the indices of the trajectories that a fault affects: markers first, then unlabelled trajectories."""
        unlabelled = self.input_take.unlabelled
        return list_affected_markers(fault, len(self.input_take.labels) + (len(unlabelled.labels) if unlabelled else 0))

    @cached_property
    def fragments_by_donor(self) -> dict[int, list[Fragment]]:
        """Fragments that were joined to a marker, by the index of the trajectory that they came from."""
        fragments: defaultdict[int, list[Fragment]] = defaultdict(list)
        for _, fault in self.applied_changes:
            if isinstance(fault, Fragment):
                fragments[fault.donor].append(fault)
        return dict(fragments)

    @cached_property
    def _change_fault_pairs(self) -> list[tuple[Change, Fault]]:
        """Changes with their faults, matched by kind, labels and first frame."""
        faults: defaultdict[tuple[str, tuple[str, ...], int], list[Fault]] = defaultdict(list)
        for fault in reversed(self.faults.items):
            labels = tuple(self.input_take.get_label(m) for m in self.find_affected_trajectories(fault))
            faults[fault.kind, labels, self.input_take.get_frame_number(fault.first)].append(fault)
        keys = [(change.kind, change.markers, change.first) for change in self.changes]
        return [(change, faults[key].pop()) for change, key in zip(self.changes, keys, strict=True) if faults[key]]
