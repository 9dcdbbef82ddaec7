"""Labels that two subjects have exchanged: for a while one person's label has the other person's marker.

One label may be exchanged, those of a limb, or those of the whole person. Where labels leap from one person to the other, the
physical trajectories do not: the points of both people are linked into tracklets by their motion alone. Two tracklets belong to
the same person if they keep the distance of their markers on that person, and to two persons if they do not. Labels count with
a weight that hardly matters beside the distances.

Tracklets are grouped by these relations, the strongest first, and each group belongs to the person whose labels it has for the
longer time. A tracklet that belongs to the other person than its label names shows an exchange, provided that the label of the
other person does not have another of their points. It is undone before each subject is cleaned as a take of its own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise, product

import numpy as np
import scipy
from jaxtyping import Float, Int

from mocapfix.errors import format_name_list
from mocapfix.io.changes_file import Review
from mocapfix.labels.label_swaps import build_exchange_fault
from mocapfix.labels.tracklets import link_points
from mocapfix.model.changes import Change, build_changes, compute_editable_mask
from mocapfix.model.faults import MIN_LABEL_CONFIDENCE, Fault
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.solve.parallel import map_in_threads
from mocapfix.stats.marker_distances import BROKEN_DISTANCE_SD, estimate_distance_statistics
from mocapfix.stats.rigid_alignment import compute_lengths
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import UNASSIGNED_SUBJECT

MAX_PAIR_EVIDENCE = 20.0  # largest evidence of one pair of tracklets: the frames of a long one are not independent
# Weight of a second with a person's label, in the unit of the evidence.
LABEL_WEIGHT_PER_S = 0.02
MAX_ASSIGNMENT_PASSES = 20
MIN_AGREEMENT_GAIN = 1e-9  # smallest agreement with the evidence that an exchange of sides must gain: less is rounding


@dataclass(frozen=True)
class TrackletRelations:
    """Evidence about R pairs of tracklets."""

    pairs: Int[np.ndarray, "R 2"]  # indices (R, 2) of tracklets, the smaller first
    evidence: Float[np.ndarray, " R"]  # positive for the same person, negative for two persons

    @staticmethod
    def collect(parts: "Sequence[TrackletRelations]") -> "TrackletRelations":
        """Return the relations with the evidence of all parts on the same pair added up."""
        if not parts:
            return TrackletRelations(np.zeros((0, 2), int), np.zeros(0))
        pairs, index = np.unique(np.concatenate([part.pairs for part in parts]), axis=0, return_inverse=True)
        return TrackletRelations(pairs, np.bincount(index.ravel(), np.concatenate([part.evidence for part in parts]), len(pairs)))

    @staticmethod
    def sum_runs(
        one: Int[np.ndarray, " F"], two: Int[np.ndarray, " F"], evidence: Float[np.ndarray, " F"]
    ) -> "TrackletRelations":
        """Return the relations of F frames with tracklets `one` and `two` (-1 for none), one for each run of the same pair."""
        is_known = (one >= 0) & (two >= 0) & (one != two) & ~np.isnan(evidence)
        low, high, known = np.minimum(one, two)[is_known], np.maximum(one, two)[is_known], evidence[is_known]
        starts = np.flatnonzero(np.r_[True, (np.diff(low) != 0) | (np.diff(high) != 0)][: len(low)])
        pairs = np.column_stack([low[starts], high[starts]])
        return TrackletRelations(pairs, np.add.reduceat(known, starts) if len(starts) else known)

    @property
    def limited_evidence(self) -> Float[np.ndarray, " R"]:
        """The evidence, no larger than frames that depend on each other allow."""
        return np.clip(self.evidence, -MAX_PAIR_EVIDENCE, MAX_PAIR_EVIDENCE)


def assign_persons(relations: TrackletRelations, label_s: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Assign each tracklet to person 0 or 1.

    Tracklets are joined by the strongest evidence first, which makes trees of them. Parts of a tree, and then single tracklets,
    are exchanged between the persons as long as this agrees better with all evidence. Each tree is assigned by its labels.

    Args:
        relations: The evidence about pairs of tracklets.
        label_s: How many seconds longer each tracklet has labels of person 0 than of person 1.
    """
    evidence, count = relations.limited_evidence, len(label_s)
    weights = scipy.sparse.csr_array((MAX_PAIR_EVIDENCE + 1 - np.abs(evidence), tuple(relations.pairs.T)), (count, count))
    signs = {(a, b): 1 if each > 0 else -1 for (a, b), each in zip(relations.pairs.tolist(), evidence.tolist(), strict=True)}
    tree = scipy.sparse.csgraph.minimum_spanning_tree(weights)
    side, is_reached = np.ones(count), np.zeros(count, bool)
    for root in range(count):
        if is_reached[root]:
            continue
        order, parents = scipy.sparse.csgraph.depth_first_order(tree, root, directed=False)
        is_reached[order] = True
        for n in order[1:].tolist():
            side[n] = side[parents[n]] * signs[min(n, parents[n]), max(n, parents[n])]
        if len(order) > 1:
            _exchange_subtrees(side, order, parents, relations)
        if side[order] @ label_s[order] < 0:
            side[order] *= -1
    return np.where(_agree(side.astype(int), relations, label_s) > 0, 0, 1)


def _exchange_subtrees(
    side: Float[np.ndarray, " N"], order: Int[np.ndarray, " n"], parents: Int[np.ndarray, " N"], relations: TrackletRelations
) -> None:
    """Turn the sides of parts of a tree in place, as long as this agrees better with the evidence.

    Args:
        side: 1 or -1 for each tracklet.
        order: The tracklets of the tree in depth-first order, so that each subtree is an interval of it.
        parents: The parent of each tracklet in the tree.
    """
    position = np.full(len(side), -1)
    position[order] = np.arange(len(order))
    stop = np.arange(1, len(order) + 1)  # of each subtree
    for i in range(len(order) - 1, 0, -1):
        stop[position[parents[order[i]]]] = max(stop[position[parents[order[i]]]], stop[i])
    is_in_tree = position[relations.pairs[:, 0]] >= 0
    (a, b), evidence = relations.pairs[is_in_tree].T, relations.limited_evidence[is_in_tree]
    first, second = position[a], position[b]
    ancestor = _find_common_ancestors(
        np.r_[0, position[parents[order[1:]]]], np.minimum(first, second), np.maximum(first, second)
    )
    for _ in range(MAX_ASSIGNMENT_PASSES):
        agreement = evidence * side[a] * side[b]
        ends, apexes = (
            np.bincount(at, weights, len(order))
            for at, weights in ((np.r_[first, second], np.r_[agreement, agreement]), (ancestor, agreement))
        )
        total = np.r_[0.0, np.cumsum(ends - 2 * apexes)]
        across = (total[stop] - total[:-1])[1:]  # of the pairs with exactly one end in each subtree
        worst = int(across.argmin())
        if across[worst] > -MIN_AGREEMENT_GAIN:
            return
        side[order[worst + 1 : stop[worst + 1]]] *= -1


def _find_common_ancestors(
    parent: Int[np.ndarray, " n"], first: Int[np.ndarray, " P"], last: Int[np.ndarray, " P"]
) -> Int[np.ndarray, " P"]:
    """Return the lowest common ancestors of the nodes `first` < `last` of a tree whose nodes are numbered in depth-first order.

    It is the first of the parents of all nodes behind `first` up to `last`; tables have the minima over 1, 2, 4, ... nodes.
    """
    tables = [parent]
    while 2 ** len(tables) < len(parent):
        half = 2 ** (len(tables) - 1)
        tables.append(np.minimum(tables[-1], np.r_[tables[-1][half:], np.full(half, len(parent))]))
    level = np.floor(np.log2(np.maximum(last - first, 1))).astype(int)
    table = np.stack(tables)
    return np.minimum(table[level, first + 1], table[level, last + 1 - 2**level])


def _agree(side: Int[np.ndarray, " N"], relations: TrackletRelations, label_s: np.ndarray) -> Int[np.ndarray, " N"]:
    """Return the sides (1 or -1) after single tracklets changed theirs where this agrees better with the others."""
    side = side.copy()
    neighbours = _list_neighbours(len(side), relations)
    for _ in range(MAX_ASSIGNMENT_PASSES):
        is_changed = False
        for n, (others, evidence) in enumerate(neighbours):
            pull = float((evidence * side[others]).sum()) + LABEL_WEIGHT_PER_S * label_s[n]
            if pull * side[n] < 0:
                side[n] *= -1
                is_changed = True
        if not is_changed:
            break
    return side


def compute_support(
    relations: TrackletRelations, label_s: Float[np.ndarray, " N"], person: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Compute the evidence for each tracklet's person, given those of the others, over that for the other person."""
    side = np.where(person == 0, 1, -1)
    pull = [float((evidence * side[others]).sum()) for others, evidence in _list_neighbours(len(side), relations)]
    return side * (np.array(pull) + LABEL_WEIGHT_PER_S * label_s)


def _list_neighbours(count: int, relations: TrackletRelations) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the other tracklets and the evidence about them for each tracklet."""
    both = np.concatenate([relations.pairs, relations.pairs[:, ::-1]])
    evidence = np.concatenate([relations.limited_evidence] * 2)
    order = np.argsort(both[:, 0], kind="stable")
    starts = np.searchsorted(both[order, 0], np.arange(count + 1))
    return [(both[order[a:b], 1], evidence[order[a:b]]) for a, b in pairwise(starts)]


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
# A sample whose distances are broken in more than this share of the comparisons, for some time, may be exchanged.
MIN_BROKEN_SHARE = 0.7
MIN_BROKEN_DURATION_S = 0.1
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


def detect_subject_exchanges(take: Take, first_subject: str, second_subject: str) -> list[Fault]:
    """Detect the labels that two subjects of a take have exchanged, and when.

    Returns:
        A label swap for each label and interval, ordered by first frame.
    """
    pairs = find_marker_pairs(take, first_subject, second_subject)
    if not len(pairs.partners) or not _is_exchange_possible(take, pairs):
        return []
    columns = np.unique(pairs.columns)
    tracklets = np.full(take.visible.shape, -1)
    tracklets[:, columns] = link_points(take.markers[:, columns], take.rate).tracklet_indices
    relations, label_s = _compare_tracklets(take, pairs, tracklets)
    person = assign_persons(relations, label_s)
    support = compute_support(relations, label_s, person)
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


def find_marker_pairs(take: Take, first_subject: str, second_subject: str) -> MarkerPairs:
    """Find the labels that two subjects of a take have in common, and the distances that tell whose a sample is."""
    columns: list[tuple[int, int]] = []
    own = {(subject, label): m for m, (subject, label) in enumerate(zip(take.marker_subjects, take.bare_labels, strict=True))}
    for (subject, label), m in own.items():
        other = own.get((second_subject, label))
        if subject == first_subject and other is not None and take.visible[:, m].any() and take.visible[:, other].any():
            columns.append((m, other))
    index = np.array(columns, int).reshape(-1, 2).T
    return _compare_markers(take, index)


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


def _is_exchange_possible(take: Take, pairs: MarkerPairs) -> bool:
    """Return whether a label leaps to where the other subject's was, or its distances are broken for some time."""
    own, other = (take.markers[:, pairs.columns[p]] for p in range(2))
    for one, two in ((own, other), (other, own)):
        own_step, other_step = _measure_steps(one, one), _measure_steps(two, one)
        if (other_step < own_step - MIN_PERSON_LEAP_M).any():
            return True
    step = max(1, round(COMPARISON_INTERVAL_S * take.rate))
    min_length = max(1, round(MIN_BROKEN_DURATION_S * take.rate / step))
    for p in range(2):
        one, two = (take.markers[::step, pairs.columns[p, labels]] for labels in pairs.partners.T)
        error_m = np.abs(compute_lengths(one - two) - pairs.length_m[p])
        is_partner = (pairs.partners[:, :, None] == np.arange(pairs.columns.shape[1])).any(1).astype(float)
        broken, known = (each.astype(float) @ is_partner for each in (error_m > pairs.tolerance_m, ~np.isnan(error_m)))
        is_broken = (known > 0) & (broken > MIN_BROKEN_SHARE * known)
        if any(last - first + 1 >= min_length for k in range(is_broken.shape[1]) for first, last in find_runs(is_broken[:, k])):
            return True
    return False


def _measure_steps(before: np.ndarray, after: np.ndarray) -> Float[np.ndarray, "S K"]:
    """Return the distance of each sample of `after` from the last earlier sample of `before`, NaN where there is none."""
    latest = np.maximum.accumulate(np.where(np.isnan(before[..., 0]), -1, np.arange(len(before))[:, None]), axis=0)[:-1]
    start = np.take_along_axis(before, np.maximum(latest, 0)[..., None], axis=0)
    return np.where(latest >= 0, compute_lengths(after[1:] - start), np.nan)


def _compare_tracklets(
    take: Take, pairs: MarkerPairs, tracklets: Int[np.ndarray, "T M"]
) -> tuple[TrackletRelations, Float[np.ndarray, " N"]]:
    """Compare the distances between tracklets with those on the subjects.

    Returns:
        The evidence for pairs of tracklets to belong to the same person, and for how many seconds longer each tracklet has
        labels of the first subject than of the second.
    """
    count, frames = int(tracklets.max()) + 1, np.arange(0, take.frame_count, max(1, round(COMPARISON_INTERVAL_S * take.rate)))
    label_s = np.zeros(count)
    for p, sign in enumerate((1.0, -1.0)):
        shown = tracklets[:, pairs.columns[p]]
        label_s += sign * np.bincount(shown[shown >= 0], minlength=count) / take.rate
    relations: list[TrackletRelations] = []
    frame_s = len(frames) and take.frame_count / take.rate / len(frames)
    coordinates = np.ascontiguousarray(take.markers[frames[:, None], pairs.columns.ravel()].T)
    shown, count = np.ascontiguousarray(tracklets[frames[:, None], pairs.columns.ravel()].T), pairs.columns.shape[1]
    for p, q in product(range(2), repeat=2):
        one, two = p * count + pairs.partners[:, 0], q * count + pairs.partners[:, 1]
        distance_m = compute_lengths(np.moveaxis(coordinates[:, one] - coordinates[:, two], 0, -1))
        deviation = (distance_m - pairs.length_m[..., None]) / pairs.tolerance_m[:, None]
        evidence = (0.5 - np.minimum(1.0, (deviation**2).min(0))) * frame_s / EVIDENCE_UNIT_S
        relations.append(TrackletRelations.sum_runs(shown[one].ravel(), shown[two].ravel(), evidence.ravel()))
    return TrackletRelations.collect([*relations, _compare_positions(take, pairs, tracklets)]), label_s


def _compare_positions(take: Take, pairs: MarkerPairs, tracklets: Int[np.ndarray, "T M"]) -> TrackletRelations:
    """Return whether each tracklet begins nearer to where its own label was before, or to where the other person's was."""
    related: list[tuple[int, int]] = []
    evidence: list[float] = []
    seen = np.flatnonzero(tracklets.max(0) >= 0)
    shown = tracklets[:, seen]
    first = np.full(shown.max(initial=-1) + 2, -1)  # the place of the first sample of each tracklet, and of no tracklet
    first[shown.ravel()[::-1]] = np.arange(shown.size)[::-1]
    latest = dict(
        zip(seen.tolist(), np.maximum.accumulate(np.where(shown >= 0, np.arange(len(shown))[:, None], -1)).T, strict=True)
    )
    label = {int(m): (p, k) for p in range(2) for k, m in enumerate(pairs.columns[p])}
    for n, place in enumerate(first[:-1].tolist()):
        t, column = place // len(seen), int(seen[place % len(seen)])
        own_person, k = label[column]
        own_t, other_t = (int(latest[int(m)][t - 1]) if t else -1 for m in (column, pairs.columns[1 - own_person, k]))
        if min(own_t, other_t) < 0:
            continue
        own, other = (own_t, column), (other_t, int(pairs.columns[1 - own_person, k]))
        own_m, other_m = (float(np.linalg.norm(take.markers[t, column] - take.markers[each])) for each in (own, other))
        hidden_s = (t - min(own_t, other_t)) / take.rate
        nearer = np.clip((other_m - own_m) / (POSITION_TOLERANCE_M + PERSON_SPEED_M_PER_S * hidden_s), -1.0, 1.0)
        for each, sign in ((own, 1.0), (other, -1.0)):
            if hidden_s <= MAX_HIDDEN_S and tracklets[each] != n:
                related.append((min(n, int(tracklets[each])), max(n, int(tracklets[each]))))
                evidence.append(sign * POSITION_EVIDENCE * float(nearer))
    return TrackletRelations(np.array(related, int).reshape(-1, 2), np.array(evidence))


@dataclass(frozen=True)
class SubjectExchanges:
    """The exchanges of labels between the subjects of a take."""

    original_take: Take  # the take as read
    take: Take  # the take with the labels exchanged back
    faults: tuple[Fault, ...] = ()  # the exchanges, as label swaps of markers of the take

    def add_notes(self, part: Take) -> Take:
        """Return one subject's part of the take with notes on the labels that it exchanged."""
        return replace(part, notes=(*part.notes, *_describe_exchanges(self, part.subject_name)))

    def build_changes(self, cleaned: Take) -> dict[str, list[Change]]:
        """Return the changes by subject, that of the first marker of each. `cleaned` is the cleaned take of all subjects."""
        changes: dict[str, list[Change]] = {}
        methods = np.full(cleaned.visible.shape, "", object)
        for change, fault in build_changes(self.original_take, self.take, cleaned, self.faults, None, methods):
            changes.setdefault(self.take.marker_subjects[fault.marker], []).append(change)
        return changes


def correct_subject_labels(
    take: Take, parts: Sequence[Take], reviews: Sequence[Review], options: CleanOptions
) -> SubjectExchanges:
    """Find the labels that subjects exchanged, and exchange them back.

    Args:
        reviews: The review of each part: exchanges that it declined are left as they are.
        options: `detect.repair_kinds`, `fill.keep` and `fill.frames` restrict what is changed.
    """
    names = [part.subject_name for part in parts if part.subject_name != UNASSIGNED_SUBJECT]
    if len(names) < 2 or (options.detect.repair_kinds and "swap" not in options.detect.repair_kinds):
        return SubjectExchanges(take, take)
    is_editable = compute_editable_mask(take, options.fill)
    is_declined = _build_declined_filter(take, reviews)
    faults: list[Fault] = []
    corrected = take
    pairs, done, subjects = list(combinations(names, 2)), 0, np.array(take.marker_subjects, object)
    columns = {name: np.flatnonzero(subjects == name) for name in names}
    while done < len(pairs):
        markers = replace(corrected, unlabelled=None, labelled_file=None, computed_points=None)
        own = {name: markers.extract_markers(columns[name], name) for name in names}
        for detected in map_in_threads(_detect_in_pair, [(own[a], own[b]) for a, b in pairs[done:]], is_shared=True):
            both = np.concatenate([columns[name] for name in pairs[done]]).tolist()
            done += 1
            found = [
                fault
                for fault in (replace(f, marker=both[f.marker], other_markers=(both[f.other_markers[0]],)) for f in detected)
                if fault.confidence >= MIN_LABEL_CONFIDENCE
                and is_editable[fault.frame_slice][:, list(fault.markers)].all()
                and not is_declined(fault)
            ]
            if found:  # the pairs that follow are compared with these labels corrected
                corrected = corrected.exchange_labels_in_turn([(fault.markers, fault.first, fault.last) for fault in found])
                faults += found
                break
    return SubjectExchanges(take, corrected, tuple(faults)) if faults else SubjectExchanges(take, take)


def _detect_in_pair(pair: tuple[Take, Take]) -> list[Fault]:
    """Detect the labels that the subjects of two takes have exchanged. Faults have the indices of the markers of both."""
    one, two = pair
    positions = np.concatenate([one.markers, two.markers], axis=1)
    take = Take(positions, one.labels + two.labels, one.rate, one.first_frame, one.path, subject_prefixes=one.subject_prefixes)
    return detect_subject_exchanges(take, one.subject_name, two.subject_name)


def _build_declined_filter(take: Take, reviews: Sequence[Review]) -> Callable[[Fault], bool]:
    declined = [each for review in reviews for each in review.declined if each.entry.kind == "swap"]

    def is_declined(fault: Fault) -> bool:
        labels = [take.labels[m] for m in fault.markers]
        return any(each.entry.markers == labels and each.first <= fault.last and fault.first <= each.last for each in declined)

    return is_declined


def _describe_exchanges(exchanges: SubjectExchanges, subject: str) -> list[str]:
    """Return a sentence for each interval in which a subject exchanged labels with another one."""
    take = exchanges.take
    labels: dict[tuple[str, int, int], list[str]] = {}
    for fault in exchanges.faults:
        subjects = [take.marker_subjects[m] for m in fault.markers]
        if subject in subjects:
            other = next(name for name in subjects if name != subject)
            labels.setdefault((other, fault.first, fault.last), []).append(take.bare_labels[fault.marker])
    return [
        f"{subject} and {other} had exchanged the labels {format_name_list(names)} in frames {take.get_frame_number(first)} to "
        f"{take.get_frame_number(last)}; they are exchanged back."
        for (other, first, last), names in labels.items()
    ]
