"""Labels that two subjects have exchanged: for a while one person's label has the other person's marker.

One label may be exchanged, those of a limb, or those of the whole person. Where labels leap from one person to the other, the
physical trajectories do not: the points of both people are linked into tracklets by their motion alone, whatever their labels
(`labelling.linking`). The question is then to which person each tracklet belongs. Two tracklets belong to the same person if
they keep the distance of their markers on that person, and to two persons if they do not. Its labels tell to whom a tracklet
mostly belongs, with a weight that hardly matters beside the distances.

Tracklets are grouped by these relations, the strongest first, and each group belongs to the person whose labels it has for the
longer time. So an exchange is found by what the labels leap to and by the distances alone. A tracklet that belongs to the other
person than its label names shows an exchange, provided that the label of the other person does not have another of their points.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import minimum_spanning_tree

from mocapfix.detect.marker_distances import BROKEN_DISTANCE_SD, estimate_distance_statistics
from mocapfix.detect.tracklet_persons import TrackletRelations, assign_persons, compute_support
from mocapfix.faults import Fault
from mocapfix.labelling.linking import link_points
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

# Fraction of the frames in which a distance is assumed to be correct: an exchange may last for the larger part of a take.
MIN_OWN_DISTANCE_FRACTION = 0.3
# Number of markers with which each is compared, those with the steadiest distances.
MAX_COMPARED_PARTNERS = 6
# A distance with a larger standard deviation is compared only where no other connects two segments.
MAX_COMPARED_SD_M = 0.04
# Deviation of a distance that is not broken in any case: a constant, and a fraction of the distance. Distances between two people
# differ by more, and those on one person change by more in motion that is rare in a take.
MIN_TOLERANCE_M = 0.02
RELATIVE_TOLERANCE = 0.1
# Distances between the labels of two subjects are compared in place of those of one subject if they are shorter, and if the ratio
# of their standard deviations is less than this.
MAX_CROSSED_SD_RATIO = 0.5
# Interval of the frames in which the distances are compared.
COMPARISON_INTERVAL_S = 0.025
# A sample at least this much nearer to where the other person's label was than to where its own was may be exchanged.
MIN_PERSON_LEAP_M = 0.05
# A sample whose distances are broken in more than this share of the comparisons, for some time, may be exchanged.
MIN_BROKEN_SHARE = 0.7
MIN_BROKEN_DURATION_S = 0.1
# A marker that was hidden is about where it was, within a constant and a distance that grows with the time.
POSITION_TOLERANCE_M = 0.1
PERSON_SPEED_M_PER_S = 2.0
MAX_HIDDEN_S = 2.0
# Evidence of one position that is nearer by this much, in the unit of the evidence of distances.
POSITION_EVIDENCE = 2.0
# An exchange with a label that has no sample is reported if it is at least this long.
MIN_ONE_SIDED_EXCHANGE_S = 0.1
# Evidence, in tenths of a second of broken distances, that a tracklet needs to be assigned to the other person.
MIN_SUPPORT = 1.0
EVIDENCE_UNIT_S = 0.1


@dataclass(frozen=True)
class MarkerPairs:
    """K labels that two subjects have in common, and the distances between their markers.

    Attributes:
        columns: Index (2, K) of each subject's marker in the take.
        partners: Pairs (E, 2) of labels whose distances are compared.
        length_m: Distances (2, E) on each subject.
        tolerance_m: Deviations (E,) from which they are broken.
    """

    columns: Int[np.ndarray, "2 K"]
    partners: Int[np.ndarray, "E 2"]
    length_m: Float[np.ndarray, "2 E"]
    tolerance_m: Float[np.ndarray, " E"]


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
                faults.append(_build_exchange_fault(take, pairs.columns[:, k], first, last, float(supported[frames].max())))
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
    tree = minimum_spanning_tree(np.where(np.isfinite(steady_sd_m), steady_sd_m, 0.0))  # connects all segments
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
        broken, known = np.zeros((2, len(take.markers[::step]), pairs.columns.shape[1]))
        for e, (k, m) in enumerate(pairs.partners):
            one, two = (take.markers[::step, pairs.columns[p, label]] for label in (k, m))
            error_m = np.abs(np.linalg.norm(one - two, axis=-1) - pairs.length_m[p, e])
            for label in (k, m):
                broken[:, label] += error_m > pairs.tolerance_m[e]
                known[:, label] += ~np.isnan(error_m)
        is_broken = (known > 0) & (broken > MIN_BROKEN_SHARE * known)
        if any(last - first + 1 >= min_length for k in range(is_broken.shape[1]) for first, last in find_runs(is_broken[:, k])):
            return True
    return False


def _measure_steps(before: np.ndarray, after: np.ndarray) -> Float[np.ndarray, "S K"]:
    """Return the distance of each sample of `after` from the last earlier sample of `before`, NaN where there is none."""
    latest = np.maximum.accumulate(np.where(np.isnan(before[..., 0]), -1, np.arange(len(before))[:, None]), axis=0)[:-1]
    start = np.take_along_axis(before, np.maximum(latest, 0)[..., None], axis=0)
    return np.where(latest >= 0, np.linalg.norm(after[1:] - start, axis=-1), np.nan)


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
    for e, (k, m) in enumerate(pairs.partners):
        for p in range(2):
            for q in range(2):
                one, two = pairs.columns[p, k], pairs.columns[q, m]
                distance_m = np.linalg.norm(take.markers[frames, one] - take.markers[frames, two], axis=-1)
                deviation = (distance_m - pairs.length_m[:, e, None]) / pairs.tolerance_m[e]
                contradiction = np.minimum(1.0, (deviation**2).min(0))
                evidence = (0.5 - contradiction) * frame_s / EVIDENCE_UNIT_S
                relations.append(TrackletRelations.sum_runs(tracklets[frames, one], tracklets[frames, two], evidence))
    return TrackletRelations.collect([*relations, _compare_positions(take, pairs, tracklets)]), label_s


def _compare_positions(take: Take, pairs: MarkerPairs, tracklets: Int[np.ndarray, "T M"]) -> TrackletRelations:
    """Return whether each tracklet begins nearer to where its own label was before, or to where the other person's was."""
    related: list[tuple[int, int]] = []
    evidence: list[float] = []
    seen = np.flatnonzero(tracklets.max(0) >= 0)
    starts, index = np.unique(tracklets[:, seen], return_index=True)
    label = {int(m): (p, k) for p in range(2) for k, m in enumerate(pairs.columns[p])}
    for n, place in zip(starts.tolist(), index.tolist(), strict=True):
        t, column = place // len(seen), int(seen[place % len(seen)])
        own_person, k = label[column]
        before = [np.flatnonzero(tracklets[:t, m] >= 0)[-1:] for m in (column, pairs.columns[1 - own_person, k])]
        if n < 0 or not all(len(frames) for frames in before):
            continue
        own_t, other_t = (int(frames[0]) for frames in before)
        own, other = (own_t, column), (other_t, int(pairs.columns[1 - own_person, k]))
        own_m, other_m = (float(np.linalg.norm(take.markers[t, column] - take.markers[each])) for each in (own, other))
        hidden_s = (t - min(own_t, other_t)) / take.rate
        nearer = np.clip((other_m - own_m) / (POSITION_TOLERANCE_M + PERSON_SPEED_M_PER_S * hidden_s), -1.0, 1.0)
        for each, sign in ((own, 1.0), (other, -1.0)):
            if hidden_s <= MAX_HIDDEN_S and tracklets[each] != n:
                related.append((min(n, int(tracklets[each])), max(n, int(tracklets[each]))))
                evidence.append(sign * POSITION_EVIDENCE * float(nearer))
    return TrackletRelations(np.array(related, int).reshape(-1, 2), np.array(evidence))


def _build_exchange_fault(take: Take, columns: np.ndarray, first: int, last: int, support: float) -> Fault:
    one, other = (int(m) for m in columns)
    distance_m = np.linalg.norm(take.markers[first : last + 1, one] - take.markers[first : last + 1, other], axis=-1)
    separation_m = float(np.nanmedian(distance_m)) if np.isfinite(distance_m).any() else float("nan")
    duration = f"{(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    distance = f"{separation_m * 1e3:.0f} mm" if np.isfinite(separation_m) else "away"
    reason = (
        f"{take.labels[one]} and {take.labels[other]} have exchanged their labels for {duration}: "
        f"their samples lie {distance} from their markers."
    )
    return Fault("swap", one, first, last, separation_m, reason, float(1 - np.exp(-support)), (other,))
