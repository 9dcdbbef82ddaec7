"""Several subjects in one file: their labels exchanged back, and one take for each (`result.merge_results` merges them again).

Labels name the subject ("Jim:LFHD"). A file with one body, whole or in part, or with none is cleaned as one take: markers
that are not the body's (such as a prop) are filled from markers that move with them. Of a file with several bodies each is
cleaned separately, and the unassigned markers are cleaned together as one more take without a body.

For a while one person's label may have the other person's marker. One label may be exchanged, those of a limb, or those of the
whole person. Where labels leap from one person to the other, the physical trajectories do not: the points of both people are
linked into tracklets by their motion alone. Two tracklets belong to the same person if they keep the distance of their markers on
that person, and to two persons if they do not. Labels count with a weight that hardly matters beside the distances.

Tracklets are grouped by these relations, the strongest first, and each group belongs to the person whose labels it has for the
longer time. A tracklet that belongs to the other person than its label names shows an exchange, provided that the label of the
other person does not have another of their points. It is undone before each subject is cleaned as a take of its own.

Most pairs of many subjects show at once that they exchanged nothing: an exchange begins or ends with a leap to where the other
person's label was, or else puts a label beside the other person while it contradicts its own. Only the others are searched.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from itertools import chain, combinations, pairwise, product
from pathlib import Path
from typing import cast

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from mocapfix.errors import TakeError, format_name_list, join_names
from mocapfix.io.changes_file import SWAP_REASON, Review, read_changes_files
from mocapfix.labels.label_swaps import build_exchange_fault
from mocapfix.labels.tracklets import link_points
from mocapfix.model.changes import Change, build_changes, compute_editable_mask
from mocapfix.model.faults import MIN_LABEL_CONFIDENCE, Fault, overlap_in_time
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, SubjectOptions
from mocapfix.solve.parallel import map_in_threads
from mocapfix.stats.marker_distances import (
    BROKEN_DISTANCE_SD,
    MAX_NEAR_DISTANCE_M,
    build_trajectories,
    estimate_distance_statistics,
)
from mocapfix.stats.rigid_alignment import compute_lengths
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import UNASSIGNED_SUBJECT, choose_marker_set, load_requested_subject, select_subject

MAX_PAIR_EVIDENCE = 20.0  # largest evidence of one pair of tracklets: the frames of a long one are not independent
# Weight of a second with a person's label, in the unit of the evidence.
LABEL_WEIGHT_PER_S = 0.02
MAX_ASSIGNMENT_PASSES = 20


def sum_evidence(
    one: Int[np.ndarray, " F"], two: Int[np.ndarray, " F"], evidence: Float[np.ndarray, " F"], count: int
) -> "scipy.sparse.csr_array":
    """Sum the evidence that tracklets are of the same person (positive) or of two (negative).

    Args:
        one: Tracklets, -1 for none.
        two: The other tracklet of each pair.
        evidence: The evidence about each pair, NaN for none. A pair may occur several times.
        count: Number of tracklets, N.

    Returns:
        The evidence (N, N) about each pair, in both orders.
    """
    is_known = (one >= 0) & (two >= 0) & (one != two) & ~np.isnan(evidence)
    total = scipy.sparse.csr_array((evidence[is_known], (one[is_known], two[is_known])), (count, count))
    return scipy.sparse.csr_array(total + total.T)


def assign_persons(
    evidence: "scipy.sparse.csr_array", label_s: Float[np.ndarray, " N"]
) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Assign each tracklet to person 0 or 1.

    Groups of tracklets are joined, as those of one person or of two, those with the most evidence about one another first, and
    the evidence about others is added up (greedy additive edge contraction, Keuper et al. 2015). Each of the groups that are left
    is assigned by its labels. Then single tracklets are exchanged as long as this agrees better with all evidence.

    Args:
        evidence: The evidence about pairs of tracklets, as `sum_evidence` returns it.
        label_s: How many seconds longer each tracklet has labels of person 0 than of person 1.

    Returns:
        The person of each tracklet, and the evidence for it, given those of the others, over that for the other person.
    """
    side, groups = np.ones(len(label_s)), {n: [n] for n in range(len(label_s))}
    others_of = [
        dict(zip(evidence.indices[a:b].tolist(), evidence.data[a:b].tolist(), strict=True)) for a, b in pairwise(evidence.indptr)
    ]
    queue = [(-abs(each), a, b) for a, others in enumerate(others_of) for b, each in others.items() if a < b and each]
    heapify(queue)
    while queue:
        strength, a, b = heappop(queue)
        if -strength != abs(others_of[a].get(b, 0.0)):
            continue  # one of the groups has been joined to another since
        a, b = (a, b) if len(others_of[a]) > len(others_of[b]) else (b, a)
        sign = np.sign(others_of[a].pop(b))
        side[groups[b]] *= sign
        groups[a] += groups.pop(b)
        del others_of[b][a]
        for other in others_of[b]:
            total = others_of[a].get(other, 0.0) + sign * others_of[other].pop(b)
            others_of[a][other] = others_of[other][a] = total
            if total:
                heappush(queue, (-abs(total), a, other))
        others_of[b] = {}
    for group in groups.values():
        side[group] *= 1 if side[group] @ label_s[group] >= 0 else -1
    for _ in range(MAX_ASSIGNMENT_PASSES):
        before = side.copy()
        for n, (a, b) in enumerate(pairwise(evidence.indptr)):
            pull = evidence.data[a:b] @ side[evidence.indices[a:b]] + LABEL_WEIGHT_PER_S * label_s[n]
            side[n] *= -1 if pull * side[n] < 0 else 1
        if np.array_equal(side, before):
            break
    return np.where(side > 0, 0, 1), side * (evidence @ side + LABEL_WEIGHT_PER_S * label_s)


MIN_OWN_DISTANCE_FRACTION = 0.3  # of the frames with correct distances: an exchange may last for most of a take
MAX_COMPARED_PARTNERS = 6  # number of markers with which each is compared, those with the steadiest distances
MAX_COMPARED_SD_M = 0.04  # a distance with a larger standard deviation is compared only where no other connects two segments
# Deviation of a distance that is not broken in any case: a constant, and a fraction of the distance. Distances between two people
# differ by more, and those on one person change by more in motion that is rare in a take.
MIN_TOLERANCE_M = 0.02
RELATIVE_TOLERANCE = 0.1
# Distances between the labels of two subjects are compared in place of those of one subject if they are shorter, and if the ratio
# of their standard deviations is less than this.
MAX_CROSSED_SD_RATIO = 0.5
COMPARISON_INTERVAL_S = 0.025  # interval of the frames in which the distances are compared
MIN_PERSON_LEAP_M = 0.05  # nearer to the other person's label than to its own: a sample may be exchanged
MARKER_SPEED_M_PER_S = 10.0  # speed of a fast hand: a sample farther from where the other person's label was is not its next
MIN_BROKEN_DURATION_S = 0.1  # for so long, the distances of a label must be broken that may be exchanged
# A marker that was hidden is about where it was, within a constant and a distance that grows with the time.
POSITION_TOLERANCE_M = 0.1
PERSON_SPEED_M_PER_S = 2.0
MAX_HIDDEN_S = 2.0
POSITION_EVIDENCE = 2.0  # evidence of one position that is nearer by this much, in the unit of the evidence of distances
MIN_ONE_SIDED_EXCHANGE_S = 0.1  # an exchange with a label that has no sample is reported if it is at least this long
# Evidence, in tenths of a second of broken distances, that a tracklet needs to be assigned to the other person.
MIN_SUPPORT = 1.0
EVIDENCE_UNIT_S = 0.1


@dataclass(frozen=True)
class MarkerPairs:
    """K labels that two subjects have in common, and the distances between their markers."""

    columns: Int[np.ndarray, "2 K"]  # index (2, K) of each subject's marker in the take
    partners: Int[np.ndarray, "E 2"]  # pairs (E, 2) of labels whose distances are compared
    length_m: Float[np.ndarray, "2 E"]  # distances (2, E) on each subject
    tolerance_m: Float[np.ndarray, " E"]  # deviations (E,) from which they are broken


@dataclass(frozen=True)
class SubjectSamples:
    """The M markers of one subject, and what tells whether labels may have been exchanged with another one."""

    take: Take
    previous_frame: Int[np.ndarray, "T M"]  # the last earlier frame in which a marker is visible, -1 for none
    missing_count: Int[np.ndarray, "T M"]  # number of frames, up to each one, in which it is missing
    steps: Int[np.ndarray, "2 N"]  # frame and marker of the samples far from the last earlier ones of their labels
    box_m: Float[np.ndarray, "2 S 3"]  # the smallest and largest coordinates in the compared frames, NaN without a marker

    @staticmethod
    def measure(take: Take) -> "SubjectSamples":
        """Measure the samples of one subject's take."""
        previous = build_trajectories(take.markers, take.rate).previous_frame
        step = take.markers - np.take_along_axis(take.markers, np.maximum(previous, 0)[..., None], axis=0)
        steps = np.stack(np.nonzero((previous >= 0) & (compute_lengths(step) > MIN_PERSON_LEAP_M)))
        compared = take.markers[_select_compared_frames(take)]
        box_m = np.stack([limit.reduce(compared, axis=1, initial=np.nan) for limit in (np.fmin, np.fmax)])
        return SubjectSamples(take, previous, np.cumsum(~take.visible, axis=0), steps, box_m)

    def measure_steps(
        self, frames: Int[np.ndarray, " N"], labels: Int[np.ndarray, " N"], positions: Float[np.ndarray, "N 3"]
    ) -> Float[np.ndarray, "2 N"]:
        """Return how far positions are from the last earlier samples of labels, which move on as the markers seen since then.

        The distances in metres and the times in seconds are NaN where there is no earlier sample.
        """
        start = self.previous_frame[frames, labels]
        hidden = np.flatnonzero((start >= 0) & (start < frames - 1))
        first, last = start[hidden], frames[hidden]
        is_seen = (self.missing_count[last] == self.missing_count[first])[..., None]
        step = positions - self.take.markers[np.maximum(start, 0), labels]
        moved = np.where(is_seen, self.take.markers[last] - self.take.markers[first], 0.0)
        step[hidden] -= moved.sum(1) / np.maximum(is_seen.sum(1), 1)
        return np.where(start >= 0, [compute_lengths(step), (frames - start) / self.take.rate], np.nan)


def detect_subject_exchanges(both: tuple[SubjectSamples, SubjectSamples]) -> list[Fault]:
    """Detect the labels that two subjects have exchanged, and when.

    Returns:
        A label swap for each label and interval, ordered by first frame, with the indices of the markers of both, one after the
        other.
    """
    (one, two), (first, second) = both, (each.take for each in both)
    positions = np.concatenate([first.markers, second.markers], axis=1)
    take = Take(positions, first.labels + second.labels, first.rate)
    pairs = _compare_markers(take, find_shared_labels(one, two) + np.array([[0], [len(first.labels)]]))
    if not len(pairs.partners):
        return []
    compared = _select_compared_frames(take)
    coordinates_m = np.ascontiguousarray(take.markers[compared[:, None], pairs.columns.ravel()].T)
    is_near, compared_rate = find_near_frames(one, two), take.rate * len(compared) / take.frame_count
    if not does_label_leap(one, two) and not _fits_other(pairs, coordinates_m, is_near, compared_rate):
        return []
    columns = np.unique(pairs.columns)
    tracklets = np.full(take.visible.shape, -1)
    tracklets[:, columns] = link_points(take.markers[:, columns], take.rate).tracklet_indices
    evidence, label_s = _compare_tracklets(take, pairs, tracklets, coordinates_m)
    person, support = assign_persons(evidence, label_s)
    is_wrong = np.stack([person != 0, person != 1])  # of a tracklet under each subject's label
    faults: list[Fault] = []
    for k in range(pairs.columns.shape[1]):
        own = tracklets[:, pairs.columns[:, k]]
        visible = own >= 0
        is_exchanged = np.all([~visible[:, p] | is_wrong[p][own[:, p]] for p in range(2)], axis=0) & visible.any(1)
        supported = np.max([np.where(visible[:, p], support[own[:, p]], 0.0) for p in range(2)], axis=0)
        for first, last in find_runs(is_exchanged & (supported >= MIN_SUPPORT)):
            frames = slice(first, last + 1)
            is_one_sided = not visible[frames].any(0).all()
            if not is_one_sided or (last - first + 1) / take.rate >= MIN_ONE_SIDED_EXCHANGE_S:
                pair, confidence = tuple(pairs.columns[:, k].tolist()), float(1 - np.exp(-supported[frames].max()))
                faults.append(build_exchange_fault(take, pair, (first, last), confidence, take.labels))
    return sorted(faults, key=lambda fault: fault.first)


def find_shared_labels(one: SubjectSamples, two: SubjectSamples) -> Int[np.ndarray, "2 K"]:
    """Find the markers of two subjects that are visible in any frame and have the same label."""
    seen = [{each.take.bare_labels[m]: int(m) for m in np.flatnonzero(each.take.visible.any(0))} for each in (one, two)]
    return np.array([(m, seen[1][label]) for label, m in seen[0].items() if label in seen[1]], int).reshape(-1, 2).T


def is_exchange_possible(one: SubjectSamples, two: SubjectSamples) -> bool:
    """Return whether a label leaps to the other subject, or the subjects are near one another in any frame."""
    return does_label_leap(one, two) or bool(find_near_frames(one, two).any())


def does_label_leap(one: SubjectSamples, two: SubjectSamples) -> bool:
    """Return whether a sample is nearer to where the other subject's label was than to where its own was."""
    shared = find_shared_labels(one, two)
    for own, other, (markers, others) in ((one, two, shared), (two, one, shared[::-1])):
        other_label = np.full(len(own.take.labels), -1)
        other_label[markers] = others
        frames, labels = own.steps[:, other_label[own.steps[1]] >= 0]
        positions = own.take.markers[frames, labels]
        own_m = own.measure_steps(frames, labels, positions)[0]
        other_m, hidden_s = other.measure_steps(frames, other_label[labels], positions)
        near_m = np.minimum(own_m - MIN_PERSON_LEAP_M, POSITION_TOLERANCE_M + MARKER_SPEED_M_PER_S * hidden_s)
        if (other_m < near_m).any():
            return True
    return False


def find_near_frames(one: SubjectSamples, two: SubjectSamples) -> Bool[np.ndarray, " S"]:
    """Find the compared frames in which any markers of two subjects may be as near as those of one segment."""
    gap_m = np.maximum(one.box_m[0] - two.box_m[1], two.box_m[0] - one.box_m[1])
    return compute_lengths(np.maximum(gap_m, 0.0)) < MAX_NEAR_DISTANCE_M


def _select_compared_frames(take: Take) -> Int[np.ndarray, " S"]:
    return np.arange(0, take.frame_count, max(1, round(COMPARISON_INTERVAL_S * take.rate)))


def _compare_markers(take: Take, columns: Int[np.ndarray, "2 K"]) -> MarkerPairs:
    """Choose the pairs of labels with the steadiest distances.

    A label that is exchanged for most of a take has its steady distances, which are also shorter, to the other person's labels.
    """
    count = columns.shape[1]
    length_m, sd_m = estimate_distance_statistics(take.markers[:, columns.ravel()], MIN_OWN_DISTANCE_FRACTION)
    own, other = slice(0, count), slice(count, None)
    straight_sd_m, crossed_sd_m = (np.maximum(sd_m[own, a], sd_m[other, b]) for a, b in ((own, other), (other, own)))
    straight_m, crossed_m = (np.stack([length_m[own, a], length_m[other, b]]) for a, b in ((own, other), (other, own)))
    is_crossed = (crossed_sd_m < MAX_CROSSED_SD_RATIO * straight_sd_m) & (crossed_m.max(0) < straight_m.min(0))
    steady_sd_m, steady_m = np.where(is_crossed, crossed_sd_m, straight_sd_m), np.where(is_crossed, crossed_m, straight_m)
    np.fill_diagonal(steady_sd_m, np.inf)
    steadiest = np.argsort(steady_sd_m, axis=1, kind="stable")[:, :MAX_COMPARED_PARTNERS]
    chosen = [(k, int(p)) for k in range(count) for p in steadiest[k] if steady_sd_m[k, p] < MAX_COMPARED_SD_M]
    tree = scipy.sparse.csgraph.minimum_spanning_tree(np.where(np.isfinite(steady_sd_m), steady_sd_m, 0.0))
    chosen += list(zip(*(index.tolist() for index in tree.nonzero()), strict=True))
    partners = np.array(sorted({(min(pair), max(pair)) for pair in chosen}), int).reshape(-1, 2)
    k, p = partners.T
    tolerance_m = BROKEN_DISTANCE_SD * steady_sd_m[k, p] + MIN_TOLERANCE_M + RELATIVE_TOLERANCE * steady_m[:, k, p].max(0)
    return MarkerPairs(columns, partners, steady_m[:, k, p], tolerance_m)


def _measure_deviations(
    pairs: MarkerPairs, coordinates_m: Float[np.ndarray, "3 L S"], p: int, q: int
) -> Float[np.ndarray, "E S"]:
    """Return by how many tolerances the distances from the first labels on subject `p` to the second ones on `q` differ from
    those on the subject to which they are more similar. The labels of the first subject come before those of the second.
    """
    count, (one, two) = pairs.columns.shape[1], pairs.partners.T
    distance_m = compute_lengths(np.moveaxis(coordinates_m[:, p * count + one] - coordinates_m[:, q * count + two], 0, -1))
    return np.abs((distance_m - pairs.length_m[..., None]) / pairs.tolerance_m[:, None]).min(0)


def _fits_other(
    pairs: MarkerPairs, coordinates_m: Float[np.ndarray, "3 L S"], is_near: Bool[np.ndarray, " S"], rate: float
) -> bool:
    """Return whether the distance of two labels is broken on the subjects for some time, and is kept from one to the other."""
    own = np.fmin(*(_measure_deviations(pairs, coordinates_m, p, p) for p in range(2)))
    across = np.fmax(*(_measure_deviations(pairs, coordinates_m, p, 1 - p) for p in range(2)))
    min_frames = max(1, round(MIN_BROKEN_DURATION_S * rate))
    runs = chain.from_iterable(map(find_runs, is_near & (own > 1) & (across < 1)))
    return any(last - first + 1 >= min_frames for first, last in runs)


def _compare_tracklets(
    take: Take, pairs: MarkerPairs, tracklets: Int[np.ndarray, "T M"], coordinates_m: Float[np.ndarray, "3 L S"]
) -> tuple["scipy.sparse.csr_array", Float[np.ndarray, " N"]]:
    """Return the evidence about pairs of tracklets by their distances, no larger than frames that depend on each other allow, and
    for how many seconds longer each tracklet has labels of the first subject than of the second.
    """
    label_s = np.zeros(int(tracklets.max()) + 1)
    for p, sign in enumerate((1.0, -1.0)):
        shown = tracklets[:, pairs.columns[p]]
        label_s += sign * np.bincount(shown[shown >= 0], minlength=len(label_s)) / take.rate
    total = _compare_positions(take, pairs, tracklets)
    frame_s = take.frame_count / take.rate / coordinates_m.shape[2]
    shown = np.ascontiguousarray(tracklets[_select_compared_frames(take)[:, None], pairs.columns.ravel()].T)
    for p, q in product(range(2), repeat=2):
        deviation = _measure_deviations(pairs, coordinates_m, p, q)
        evidence = (0.5 - np.minimum(1.0, deviation**2)) * frame_s / EVIDENCE_UNIT_S
        one, two = (shown[side * pairs.columns.shape[1] + pairs.partners[:, end]] for end, side in enumerate((p, q)))
        total = total + sum_evidence(one.ravel(), two.ravel(), evidence.ravel(), len(label_s))
    total.data = np.clip(total.data, -MAX_PAIR_EVIDENCE, MAX_PAIR_EVIDENCE)
    return total, label_s


def _compare_positions(take: Take, pairs: MarkerPairs, tracklets: Int[np.ndarray, "T M"]) -> "scipy.sparse.csr_array":
    """Return whether each tracklet begins nearer to where its own label was before, or to where the other person's was."""
    frames, columns = np.nonzero(tracklets >= 0)
    numbers, first = np.unique(tracklets[frames, columns], return_index=True)
    t, own = frames[first], columns[first]
    other_of_column = np.arange(len(take.labels))
    other_of_column[pairs.columns] = pairs.columns[::-1]
    previous = build_trajectories(take.markers, take.rate).previous_frame
    places = [(previous[t, each], each) for each in (own, other_of_column[own])]
    own_m, other_m = (compute_lengths(take.markers[t, own] - take.markers[each]) for each in places)
    earliest = np.minimum(places[0][0], places[1][0])
    hidden_s = (t - earliest) / take.rate
    nearer = np.clip((other_m - own_m) / (POSITION_TOLERANCE_M + PERSON_SPEED_M_PER_S * hidden_s), -1.0, 1.0)
    is_compared = (earliest >= 0) & (hidden_s <= MAX_HIDDEN_S)
    evidence = np.where(is_compared, POSITION_EVIDENCE * nearer, np.nan)
    before, count = [tracklets[place] for place in places], int(tracklets.max()) + 1
    return sum_evidence(numbers, before[0], evidence, count) - sum_evidence(numbers, before[1], evidence, count)


@dataclass(frozen=True)
class SubjectExchanges:
    """The exchanges of labels between the subjects of a take."""

    original_take: Take  # the take as read
    take: Take  # the take with the labels exchanged back
    faults: tuple[Fault, ...] = ()  # the exchanges, as label swaps of markers of the take

    def add_notes(self, part: Take) -> Take:
        """Return one subject's part of the take with a note on each interval in which it exchanged labels with another one."""
        subject, labels = part.subject_name, dict[tuple[str, int, int], list[str]]()
        for fault in self.faults:
            subjects = [self.take.marker_subjects[m] for m in fault.markers]
            if subject in subjects:
                other = next(name for name in subjects if name != subject)
                labels.setdefault((other, fault.first, fault.last), []).append(self.take.bare_labels[fault.marker])
        notes = [
            f"{subject} and {other} had exchanged the labels {format_name_list(names)} in frames "
            f"{self.take.get_frame_number(first)} to {self.take.get_frame_number(last)}; they are exchanged back."
            for (other, first, last), names in labels.items()
        ]
        return replace(part, notes=(*part.notes, *notes))

    def build_changes(self, cleaned: Take) -> list[Change]:
        """Return the changes. `cleaned` is the cleaned take of all subjects."""
        methods = np.full(cleaned.visible.shape, "", object)
        return [each for each, _ in build_changes(self.original_take, self.take, cleaned, self.faults, None, methods)]


def correct_subject_labels(
    take: Take, parts: Sequence[Take], reviews: Sequence[Review], options: CleanOptions
) -> SubjectExchanges:
    """Find the labels that subjects exchanged, and exchange them back, after those that a reviewer exchanged.

    Args:
        reviews: The review of each part: exchanges that it declined or made are left as they are.
        options: `detect.repair_kinds`, `fill.keep` and `fill.frames` restrict what is changed.
    """
    names = [part.subject_name for part in parts if part.subject_name != UNASSIGNED_SUBJECT]
    is_editable = compute_editable_mask(take, options.fill)
    declined = [each for review in reviews for each in review.declined if each.entry.kind == "swap"]
    by_name = sorted(zip(parts, reviews, strict=False), key=lambda pair: pair[0].subject_name)  # as on the page of a review
    own = (each for _, review in by_name for each in review.own_corrections if each.is_exchange)
    made = [(each, tuple(map(take.labels.index, each.entry.markers))) for each in own]
    faults = [Fault("swap", m, each.first, each.last, np.nan, SWAP_REASON, other_markers=(other,)) for each, (m, other) in made]
    faults = [each for each in faults if is_editable[each.frame_slice][:, list(each.markers)].all()]
    corrected = take.exchange_labels_in_turn([(each.markers, each.first, each.last) for each in faults]) if faults else take
    if len(names) < 2 or (options.detect.repair_kinds and "swap" not in options.detect.repair_kinds):
        return SubjectExchanges(take, corrected, tuple(faults))
    pairs, done, made_count, subjects = list(combinations(names, 2)), 0, len(faults), np.array(take.marker_subjects, object)
    columns = {name: np.flatnonzero(subjects == name) for name in names}
    while done < len(pairs):
        markers = replace(corrected, unlabelled=None, labelled_file=None, computed_points=None)
        own = {name: SubjectSamples.measure(markers.extract_markers(columns[name], name)) for name in names}
        searched = [n for n in range(done, len(pairs)) if is_exchange_possible(*(own[name] for name in pairs[n]))]
        samples, done = [(own[pairs[n][0]], own[pairs[n][1]]) for n in searched], len(pairs)
        for n, detected in zip(searched, map_in_threads(detect_subject_exchanges, samples, is_shared=True), strict=True):
            both = np.concatenate([columns[name] for name in pairs[n]]).tolist()
            found = [
                fault
                for fault in (replace(f, marker=both[f.marker], other_markers=(both[f.other_markers[0]],)) for f in detected)
                if fault.confidence >= MIN_LABEL_CONFIDENCE
                and is_editable[fault.frame_slice][:, list(fault.markers)].all()
                and not any(
                    each.entry.markers == [take.labels[m] for m in fault.markers] and overlap_in_time(each, fault)
                    for each in declined
                )
                and not any({*each.markers} & {*fault.markers} and overlap_in_time(each, fault) for each in faults[:made_count])
            ]
            if found:  # the pairs that follow are compared with these labels corrected
                corrected = corrected.exchange_labels_in_turn([(fault.markers, fault.first, fault.last) for fault in found])
                faults += found
                done = n + 1
                break
    return SubjectExchanges(take, corrected, tuple(faults))


MIN_UNASSIGNED_MARKERS = 3  # the number of unassigned markers visible in one frame that is needed to fill them from each other


def split_known_subjects(take: Take, options: SubjectOptions) -> tuple[Take, ...]:
    """Split a take as `split_subjects`, with the marker set and the name that the options give.

    Raises:
        TakeError: Where the options give one subject for a take of several, or subjects of whom it shows none.
    """
    takes = split_subjects(take, load_requested_subject(options).marker_set, options.subject_prefix)
    _check_subject_files(take, takes, "--subject", options.subject)
    return takes


def _check_subject_files(take: Take, takes: Sequence[Take], flag: str, files: object) -> None:
    """Raise TakeError if an option has one file, or a subject, for a take of several subjects, or files of others only."""
    names = [each.subject_name for each in takes if each.subject_name != UNASSIGNED_SUBJECT]
    shown = join_names(names) or take.main_subject or "no named subject"
    if isinstance(files, tuple):
        by_prefix = cast("tuple[tuple[str, Path], ...]", files)
        if not any(choose_subject_file(each, by_prefix) for each in takes):
            raise TakeError(f"{take.name}: shows {shown}, but {flag} is for {' and '.join(name for name, _ in by_prefix)}.")
    elif files is not None and len(takes) > 1:
        raise TakeError(f"{take.name}: shows {shown}, but {flag} describes one person; name that person with --subject-prefix.")


def split_corrected_subjects(take: Take, options: CleanOptions) -> tuple[tuple[Take, ...], list[Review], SubjectExchanges]:
    """Split a take as `split_known_subjects`, with the labels that its subjects exchanged exchanged back.

    Returns the takes, the review of each, and the exchanges. Raises as `split_known_subjects`.
    """
    parts = split_known_subjects(take, options.subject)
    _check_subject_files(take, parts, "--person-memory", options.prior.person_memory)
    reviews = read_changes_files(options.review.review_files, parts, take.labels)
    exchanges = correct_subject_labels(take, parts, reviews, options)
    if exchanges.faults:
        parts = tuple(exchanges.add_notes(part) for part in split_known_subjects(exchanges.take, options.subject))
    return parts, reviews, exchanges


def choose_subject_file(take: Take, files: str | Path | tuple[tuple[str, Path], ...] | None) -> str | Path | None:
    """Return the file of one subject's take, from one for all or one for each prefix; None without one for it."""
    if not isinstance(files, tuple):
        return files
    return {prefix.casefold(): path for prefix, path in files}.get(take.main_subject.casefold())


def find_bodies(take: Take, marker_set: MarkerSet | None = None) -> tuple[str, ...]:
    """Return the names of the subjects of whom a take shows the body or a part of it, in the order of its labels.

    Args:
        take: The take. The name is "" for labels without a subject name.
        marker_set: The marker set that they must match; None: any of the shipped sets.
    """
    subject_of_marker, is_visible = np.array(take.marker_subjects, object), take.visible.any(0)
    labels_of_subject = {
        name: [take.labels[m] for m in np.flatnonzero((subject_of_marker == name) & is_visible)]
        for name in dict.fromkeys(take.marker_subjects)
    }

    def shows_body(labels: list[str]) -> bool:
        if marker_set is None:
            return choose_marker_set(labels).marker_set is not None
        return not marker_set.describe_missing_body(marker_set.match_labels(labels))

    return tuple(name for name, labels in labels_of_subject.items() if shows_body(labels))


def split_subjects(take: Take, marker_set: MarkerSet | None = None, subject_prefix: str | None = None) -> tuple[Take, ...]:
    """Return the takes to clean one after the other: the take itself, unless it shows several bodies or parts of bodies.

    Args:
        marker_set: As for `find_bodies`.
        subject_prefix: The only subject to clean; all other markers are left out.
    """
    if subject_prefix is not None:
        return (select_subject(take, subject_prefix),)
    names = find_bodies(take, marker_set)
    if len(names) < 2:
        return (take,)
    subject_of_marker = np.array(take.marker_subjects, object)
    takes = [take.extract_markers(np.flatnonzero(subject_of_marker == name), name or "unnamed") for name in names]
    unassigned = np.flatnonzero(~np.isin(subject_of_marker, names))
    if take.visible[:, unassigned].sum(1).max(initial=0) >= MIN_UNASSIGNED_MARKERS:
        return (*takes, take.extract_markers(unassigned, UNASSIGNED_SUBJECT))
    labels = format_name_list([take.labels[m] for m in unassigned])
    note = f"Unassigned markers, never {MIN_UNASSIGNED_MARKERS} of them visible at once: left unchanged: {labels}."
    return tuple(replace(each, notes=(*each.notes, note)) if len(unassigned) else each for each in takes)


def is_same_data(one: Take | None, other: Take | None) -> bool:
    """Return whether two takes of unlabelled trajectories have the same samples."""
    if one is None or other is None or one is other:
        return one is other
    return one.labels == other.labels and np.array_equal(one.markers, other.markers, equal_nan=True)
