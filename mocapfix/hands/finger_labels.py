"""Labels of finger markers: those that neighbouring fingers, or both hands, exchange.

Fingers move little in the axes of their palm, which the body carries. There the points near a hand are linked into tracklets
where one certainly continues another (`labels.tracklets`), in whichever columns they are; where a label changes its point unseen,
a tracklet ends. The labels of tracklets are those that they have most of the time. The average hand of a person of this size is
posed in frames of every tracklet; tracklets are assigned to its markers again, and two markers exchange their labels, over a
stretch at whose ends both are unseen, if the poses of the hand are then more probable. The hand is not calibrated: places that
adapt to the take would adapt to labels that are wrong in most of it.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.hands.calibrated_hand import (
    MARKER_SD_M,
    POSE_ITERATIONS,
    ROBUST_SCALES_M,
    CalibratedHand,
    PalmPath,
    linearise_hand_prior,
    minimise_hand_poses,
)
from mocapfix.hands.calibration import build_average_hand
from mocapfix.hands.finger_markers import FingerMarkers, find_finger_markers, list_finger_sets, select_carried
from mocapfix.hands.hand_model import HAND_JOINTS, load_hand
from mocapfix.hands.solve_hands import add_palm_markers, trace_palm
from mocapfix.labels import tracklets
from mocapfix.labels.label_swaps import build_exchange_fault, find_permutation_cycles
from mocapfix.model.faults import Fault
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import predict_markers
from mocapfix.solve.minimise import compute_costs
from mocapfix.stats.rigid_alignment import compute_rotations
from mocapfix.stats.sequences import find_runs, sample_evenly

# Measured on composed people of `bench hands` with seeds of 100 and more, with 20, 10 and 6 markers of a hand pair.
FINGER_REACH_M = 0.3  # from the wrist, of points that may be markers of its hand
COLUMN_GAIN = 3.0  # of links within a column, as in `labels.tracklets`: 4 of 626 tracklets change their marker, with 10 it is 6
OTHER_COLUMN_SD_M = 0.025  # a tracklet that is never under a label counts as if this much farther from its marker
MAX_FINGER_DISTANCE_M = 0.05  # of a tracklet from its marker
MAX_ASSIGNMENT_ROUNDS = 4
# Exchanges are tried that seem to lose less, with the poses unchanged and markers within this distance of the hand's: all right
# ones seem to gain, and nine of ten wrong ones lose more.
MIN_PRELIMINARY_GAIN, PRELIMINARY_SD_M = -4.0, 0.015
# Median over frames of the negative logarithm of a pose's probability density that an exchange saves: up to 6.3 was measured for
# wrong ones, 17 and more for right ones of a stretch; of a single tip beside a lost one it may be 4.
MIN_FINGER_GAIN = 9.0
MAX_TESTED_FRAMES = 16  # of a stretch
MAX_EXCHANGES = 12  # of a hand
FINGER_CONFIDENCE = 0.95  # of a correction
MAX_GHOST_SHARE = 0.1  # of the samples of a label: with more its marker is not where the finger set has it
MIN_FINGER_CONFIDENCE = 0.8  # of the label of a point that has none in the file
START_FRAMES = 40  # in which labels are searched that the file does not have
START_CODE = 1.5  # standard deviations of the hand's first modes: the poses from which they are searched, besides the mean
START_GATES_M = (0.12, 0.08, 0.06, 0.05)  # distances beyond which a point is not assigned, in each round
LOST_MARKER_COST = 10.0  # of a marker without a point, as of `MIN_FINGER_GAIN`
MAX_COUNT_DIFFERENCE = 0.2  # of the median number of points near a hand from that of a set's markers, as a share of these


@dataclass(frozen=True)
class HandPoints:
    """The points near a hand, in the world: C columns over T frames, and what the body says of the palm.

    Attributes:
        hand: The K markers of fingers that are looked for, and then the P on its back, whose columns are those of the take.
        points: The points with their tracklets.
        shares: Share of the samples of each tracklet that have each label.
    """

    hand: FingerMarkers
    palm: PalmPath
    palm_markers: Float[np.ndarray, "T P 3"]
    points: tracklets.UnlabelledPoints
    shares: Float[np.ndarray, "N K"]
    size_ratio: float  # of the person's body to the average one

    @cached_property
    def sampled(self) -> tracklets.SampledPoints:
        return tracklets.sample_points(self.points)

    @cached_property
    def spans(self) -> Int[np.ndarray, "2 N"]:
        """First and last frame of each tracklet."""
        frames, columns = np.nonzero(self.points.tracklet_indices >= 0)
        spans = np.tile([[len(self.points.positions)], [-1]], self.points.tracklet_count)
        np.minimum.at(spans[0], self.points.tracklet_indices[frames, columns], frames)
        np.maximum.at(spans[1], self.points.tracklet_indices[frames, columns], frames)
        return spans

    def fit_poses(
        self, hand: CalibratedHand, frames: Int[np.ndarray, " S"], fingers: Float[np.ndarray, "S K 3"]
    ) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, "S K 3"]]:
        """Return the cost of the best pose of each frame, and where it has the markers of fingers, in metres."""
        markers, palm = np.concatenate([fingers, self.palm_markers[frames]], axis=1), self.palm.select_frames(frames)
        is_used = ~np.isnan(markers[..., 0])
        terms = hand.build_terms(np.where(is_used[..., None], markers, 0.0), is_used, hand.track_palm(palm))
        poses, codes = minimise_hand_poses(hand, terms, hand.place_palm(palm), ROBUST_SCALES_M, POSE_ITERATIONS)
        terms, squared_scale = (*terms, linearise_hand_prior(hand, len(frames))), (ROBUST_SCALES_M[-1] / MARKER_SD_M) ** 2
        costs = compute_costs(hand.tree, terms, poses, squared_scale, codes=codes)
        return costs, predict_markers(hand.subject, poses)[:, : fingers.shape[1]]


class FittedHands(NamedTuple):
    """The points taken for a hand's markers in S frames, the costs of its best poses, and their markers; in metres."""

    fingers: Float[np.ndarray, "S K 3"]
    cost: Float[np.ndarray, " S"]
    predicted: Float[np.ndarray, "S K 3"]


def fit_changed(points: HandPoints, hand: CalibratedHand, markers: Int[np.ndarray, " N"], fitted: FittedHands) -> FittedHands:
    """Return the hand fitted to the markers of tracklets; frames whose points are those of `fitted` keep their poses."""
    fingers = points.sampled.arrange_markers(markers, fitted.fingers.shape[1])
    changed = np.flatnonzero((np.nan_to_num(fingers) != np.nan_to_num(fitted.fingers)).any((1, 2)))
    cost, predicted = fitted.cost.copy(), fitted.predicted.copy()
    if len(changed):
        cost[changed], predicted[changed] = points.fit_poses(hand, points.sampled.frames[changed], fingers[changed])
    return FittedHands(fingers, cost, predicted)


def collect_points(
    hand: FingerMarkers,
    body: tuple[Subject, Motion],
    labelled: Take,
    positions: Float[np.ndarray, "T C 3"],
    columns: Int[np.ndarray, " C"],
) -> HandPoints:
    """Return the points near a hand.

    Args:
        hand: The markers that are looked for.
        labelled: The take with the labels of the body.
        positions: Points in metres, NaN where missing.
        columns: Of the points among the labels of the take; -1 for those that have none.
    """
    palm, size_ratio = trace_palm(*body, hand.side), body[0].skeleton.size_ratio
    wrist = palm.position + palm.rotation @ (load_hand(hand.side).palm_position * size_ratio)
    local = np.einsum("tba,tcb->tca", palm.hand_rotation, positions - wrist[:, None])
    is_far = np.linalg.norm(local, axis=-1) > FINGER_REACH_M
    linked = tracklets.link_points(np.where(is_far[..., None], np.nan, local), labelled.rate, COLUMN_GAIN).tracklet_indices
    indices = cut_unseen_changes(linked, ~np.isnan(positions[..., 0]))
    points = tracklets.UnlabelledPoints(np.where(is_far[..., None], np.nan, positions), indices, labelled.rate)
    counts, (frames, rows) = np.zeros((points.tracklet_count, len(columns))), np.nonzero(indices >= 0)
    np.add.at(counts, (indices[frames, rows], rows), 1)
    shares = counts @ (columns[:, None] == hand.columns) / counts.sum(1, keepdims=True)
    with_palm = add_palm_markers(hand, body[0], labelled.labels)
    palm_markers = labelled.markers[:, with_palm.columns[len(hand.columns) :]]
    return HandPoints(with_palm, palm, palm_markers, points, shares, size_ratio)


def cut_unseen_changes(indices: Int[np.ndarray, "T C"], is_visible: Bool[np.ndarray, "T C"]) -> Int[np.ndarray, "T C"]:
    """Return tracklets that end where they change their column, unless both columns have samples on both sides of the change."""
    frames, columns = np.nonzero(indices >= 0)
    order = np.argsort(indices[frames, columns], kind="stable")
    frames, columns = frames[order], columns[order]
    before, after, old, new = frames[:-1], frames[1:], columns[:-1], columns[1:]
    is_same = indices[before, old] == indices[after, new]
    is_seen = (after == before + 1) & is_visible[after, old] & is_visible[before, new]
    cut = np.full(indices.shape, -1)
    cut[frames, columns] = np.cumsum(np.append(True, ~(is_same & ((old == new) | is_seen)))[: len(frames)]) - 1
    return cut


def label_tracklets(hand_points: HandPoints, min_gain: float) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return the marker of each tracklet, -1 for none, and its probability against the best exchange that is not made.

    Exchanges must save more than `min_gain`.
    """
    sampled, count = hand_points.sampled, hand_points.shares.shape[1]
    prior = (1 - hand_points.shares) * OTHER_COLUMN_SD_M**2
    every, most = np.ones(len(prior)), 0.99 * OTHER_COLUMN_SD_M
    markers = tracklets.assign_tracklets(sampled, prior, most * every)
    hand, nowhere = build_average_hand(hand_points.hand, hand_points.size_ratio), np.full((len(sampled.frames), count, 3), np.inf)
    fitted = FittedHands(nowhere, nowhere[:, 0, 0], nowhere)
    for _ in range(MAX_ASSIGNMENT_ROUNDS):
        fitted = fit_changed(hand_points, hand, markers, fitted)
        squared = tracklets.measure_tracklets(sampled, fitted.predicted, 2 * MAX_FINGER_DISTANCE_M).squared_m2
        before, markers = markers, tracklets.assign_tracklets(sampled, squared + prior, MAX_FINGER_DISTANCE_M * every)
        if (markers == before).all():
            break
    saved = np.full(len(markers), MIN_PRELIMINARY_GAIN)
    for _ in range(MAX_EXCHANGES):
        fitted = fit_changed(hand_points, hand, markers, fitted)
        exchanges = find_exchanges_of_fingers(hand_points, hand, markers, fitted)
        saved[:] = MIN_PRELIMINARY_GAIN
        for gain, exchanged, _ in exchanges:
            saved[exchanged] = np.maximum(saved[exchanged], gain)
        gain, exchanged, pair = max(exchanges, key=lambda each: each[0], default=(-np.inf, np.zeros(0, int), [0, 0]))
        if gain <= min_gain:
            break
        markers = markers.copy()
        markers[exchanged] = np.where(markers[exchanged] == pair[0], pair[1], pair[0])
    return markers, 1 / (1 + np.exp(saved))


def find_exchanges_of_fingers(
    hand_points: HandPoints, hand: CalibratedHand, markers: Int[np.ndarray, " N"], fitted: FittedHands
) -> list[tuple[float, Int[np.ndarray, " E"], list[int]]]:
    """Return what exchanges of two markers save, the tracklets that they concern, and the markers."""
    sampled, (first, last), count = hand_points.sampled, hand_points.spans, hand_points.shares.shape[1]
    fingers, cost, predicted = fitted
    tried = list[tuple[Int[np.ndarray, " F"], np.ndarray, Int[np.ndarray, " E"], list[int]]]()
    for pair in map(list, combinations(range(count), 2)):
        for exchanged in list_exchangeable(markers, hand_points.spans, pair):
            start, stop = first[exchanged].min(), last[exchanged].max()
            is_shown = (~np.isnan(fingers[:, pair, 0])).any(1)
            frames = np.flatnonzero((sampled.frames >= start) & (sampled.frames <= stop) & is_shown)
            frames = frames[sample_evenly(len(frames), MAX_TESTED_FRAMES)]
            others = fingers[frames]
            others[:, pair] = others[:, pair[::-1]]
            squared = [((each[:, pair] - predicted[frames][:, pair]) ** 2).sum(-1) for each in (fingers[frames], others)]
            saved = (np.nan_to_num(squared[0]) - np.nan_to_num(squared[1])).sum(1) / (2 * PRELIMINARY_SD_M**2)
            if len(frames) and np.median(saved) >= MIN_PRELIMINARY_GAIN:
                tried.append((frames, others, exchanged, pair))
    if not tried:
        return []
    frames = np.concatenate([each[0] for each in tried])
    saved = cost[frames] - hand_points.fit_poses(hand, sampled.frames[frames], np.concatenate([each[1] for each in tried]))[0]
    parts = np.split(saved, np.cumsum([len(each[0]) for each in tried])[:-1])
    return [(float(np.median(part)), each[2], each[3]) for part, each in zip(parts, tried, strict=True)]


def list_exchangeable(
    markers: Int[np.ndarray, " N"], spans: Int[np.ndarray, "2 N"], pair: list[int]
) -> list[Int[np.ndarray, " E"]]:
    """Return the sets of tracklets of two markers that may be exchanged alone.

    These are all in a stretch at whose ends neither marker is visible, and each during which the other marker is not.
    """
    own = np.flatnonzero(np.isin(markers, pair))
    own = own[np.argsort(spans[0, own], kind="stable")]
    is_new = spans[0, own][1:] > np.maximum.accumulate(spans[1, own])[:-1]
    single: list[Int[np.ndarray, " E"]] = []
    for tracklet in own:
        meets = (spans[0, own] <= spans[1, tracklet]) & (spans[1, own] >= spans[0, tracklet])
        if (markers[own[meets]] == markers[tracklet]).all():
            single.append(np.array([tracklet]))
    whole = np.split(own, np.flatnonzero(is_new) + 1) if len(own) else []
    return [*(each for each in whole if len(each) > 1), *single]


def find_finger_faults(take: Take, subject: Subject, motion: Motion) -> list[Fault]:
    """Return the exchanges of the labels of finger markers in the order of their first frames; undone, each has its own.

    Then the ghosts: points near a hand that no finger of it can be while the others are where they are.
    """
    hands = find_finger_markers(subject.marker_set, take.labels)
    carried = select_carried(hands, subject.joints)
    if not carried:
        return []
    columns = np.concatenate([hand.columns for hand in hands])
    positions = np.where(take.measured[:, columns, None], take.markers[:, columns], np.nan)
    places = np.arange(len(columns))
    target = np.tile(places, (take.frame_count, 1))
    for hand in carried:
        points, own = collect_points(hand, (subject, motion), take, positions, columns), places[np.isin(columns, hand.columns)]
        found = tracklets.assign_to_tracklets(points.points, label_tracklets(points, MIN_FINGER_GAIN)[0], -2)
        is_lost = (found == -1) & np.isin(places, own) & (target == places)
        target = np.where(found >= 0, own[np.maximum(found, 0)], np.where(is_lost, -1, target))
    is_visible, runs = ~np.isnan(positions[..., 0]), dict[tuple[int, ...], list[int]]()
    for frame in np.flatnonzero(((target != places) & is_visible).any(1)).tolist():
        for cycle in find_permutation_cycles(_order_sources(target[frame], is_visible[frame])):
            runs.setdefault(cycle, []).append(frame)
    faults: list[Fault] = []
    for cycle, frames in runs.items():
        is_between = is_visible[:, cycle].any(1) & ~np.isin(np.arange(take.frame_count), frames)
        breaks = [n for n in range(1, len(frames)) if is_between[frames[n - 1] : frames[n]].any()]
        for part in np.split(np.array(frames), breaks):
            markers = tuple(int(columns[place]) for place in cycle)
            interval = int(part[0]), int(part[-1])
            faults.append(build_exchange_fault(take, markers, interval, FINGER_CONFIDENCE, take.bare_labels))
    ghosts = list[Fault]()
    is_ghost = (target == -1) & ((target == -1).sum(0) <= MAX_GHOST_SHARE * is_visible.sum(0))
    for marker, (first, last) in ((columns[place], run) for place in places for run in find_runs(is_ghost[:, place])):
        time = f"{(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
        reason = f"The point is for {time} where no finger of the hand can be."
        ghosts.append(Fault("ghost", int(marker), first, last, np.nan, reason, FINGER_CONFIDENCE))
    return [*sorted(faults, key=lambda fault: fault.first), *ghosts]


def _order_sources(target: Int[np.ndarray, " F"], is_visible: Bool[np.ndarray, " F"]) -> Int[np.ndarray, " F"]:
    """Return for each label the label that has its sample.

    Args:
        target: The label of each sample; -1 for one that may have any that is left, like one that is missing.
    """
    own, moved = np.arange(len(target)), np.flatnonzero(is_visible & (target >= 0))
    if len(np.unique(target[moved])) < len(moved):
        return own
    source = np.full(len(target), -1)
    source[target[moved]] = moved
    for label in np.setdiff1d(own, moved):  # where its own label is taken, that at the other end of the chain of samples is free
        end = label
        while source[end] >= 0:
            end = source[end]
        source[end] = label
    return source


def list_lacking_sets(marker_set_name: str, labels: tuple[str, ...]) -> list[list[FingerMarkers]]:
    """Return for each side the finger sets of a marker set that have all finger labels of a take, and more."""
    shown = {hand.side: len(hand.columns) for hand in find_finger_markers(marker_set_name, labels)}
    by_side = zip(*list_finger_sets(marker_set_name), strict=True)
    found = ([replace(hand, columns=hand.markers.find_columns(labels)) for hand in hands] for hands in by_side)
    return [
        [hand for hand in hands if (hand.columns >= 0).sum() == shown.get(hand.side, 0) < len(hand.columns)] for hands in found
    ]


def may_show_fingers(take: Take, marker_set: MarkerSet) -> bool:
    """Return whether in most frames as many unlabelled points are near a labelled hand as a finger set has and the hand lacks."""
    if take.unlabelled is None or marker_set.point_sd:
        return False
    joints, columns = load_cmu31_body().skeleton, marker_set.find_columns(take.labels)
    for sets in filter(None, list_lacking_sets(marker_set.name, take.labels)):
        own = columns[(marker_set.joints == joints.find_joint(f"{sets[0].side}Hand")) & (columns >= 0)]
        fewest = min((hand.columns < 0).sum() for hand in sets)
        for column in own[:1]:
            distance = np.linalg.norm(take.unlabelled.markers - take.markers[:, column, None], axis=-1)
            if np.median((distance < FINGER_REACH_M).sum(1)) >= (1 - MAX_COUNT_DIFFERENCE) * fewest:
                return True
    return False


def search_labels(hand_points: HandPoints) -> HandPoints:
    """Return points with the shares of frames in which the best pose of the hand has each tracklet as a marker.

    Tracklets that have labels keep these.
    """
    sampled, count, tracklet_count = hand_points.sampled, hand_points.shares.shape[1], hand_points.points.tracklet_count
    is_labelled = hand_points.shares.max(1, keepdims=True) > 0
    is_wrong = np.append(is_labelled & (hand_points.shares < 0.5), np.zeros((1, count), bool), axis=0)
    hand, number = build_average_hand(hand_points.hand, hand_points.size_ratio), (sampled.tracklets >= 0).sum(1)
    full = np.flatnonzero(number >= np.quantile(number, 0.5))
    part = sampled.select_frames(full[sample_evenly(len(full), START_FRAMES)])
    root, rest = hand.place_palm(hand_points.palm.select_frames(part.frames))
    modes = START_CODE * np.eye(hand.model.prior.code_size)[:2]
    least, best = np.full(len(part.frames), np.inf), np.full(part.tracklets.shape, -1)
    for code in (0 * modes[0], *modes, *-modes):
        local, vectors = rest.copy(), hand.model.prior.decode(code[None])
        local[:, HAND_JOINTS] = local[:, HAND_JOINTS] @ compute_rotations(vectors[:, HAND_JOINTS])
        predicted, cost, found = predict_markers(hand.subject, (root, local))[:, :count], least, best
        for gate_m in START_GATES_M:
            squared = np.nan_to_num(((part.positions[:, :, None] - predicted[:, None]) ** 2).sum(-1), nan=1e3)
            squared += 1e3 * is_wrong[part.tracklets]
            found = np.array([tracklets.assign_within_gate(each, gate_m)[0] for each in squared])
            fingers = np.full(predicted.shape, np.nan)
            rows, places = np.nonzero(found >= 0)
            fingers[rows, found[rows, places]] = part.positions[rows, places]
            cost, predicted = hand_points.fit_poses(hand, part.frames, fingers)
        cost = cost + LOST_MARKER_COST * (count - (found >= 0).sum(1))
        best[cost < least] = found[cost < least]
        least = np.minimum(cost, least)
    votes = np.zeros((tracklet_count, count + 1))
    np.add.at(votes, (part.tracklets[part.tracklets >= 0], best[part.tracklets >= 0]), 1)
    found_shares = votes[:, :count] / np.maximum(votes.sum(1, keepdims=True), 1)
    return replace(hand_points, shares=np.where(is_labelled, hand_points.shares, found_shares))


def label_unlabelled_fingers(
    take: Take, subject: Subject, motion: Motion
) -> tuple[tracklets.PointLabels, tuple[str, ...]] | None:
    """Return the labels of unlabelled points near the hands of a body, and their names; None if they are no finger set.

    Of a hand with some finger labels these are the others of a set. Where an exchange of two labels is about as probable, neither
    point gets one.
    """
    assert take.unlabelled is not None
    shape, names, by_side = take.unlabelled.visible.shape, list[str](), list_lacking_sets(subject.marker_set, take.labels)
    markers, confidence = np.full(shape, -1), np.zeros(shape)
    for hands in filter(None, by_side):
        labelled = hands[0].columns[hands[0].columns >= 0]
        positions = np.concatenate([take.unlabelled.markers, take.markers[:, labelled]], axis=1)
        columns = np.append(np.full(shape[1], -2), labelled)
        found = [collect_points(hand, (subject, motion), take, positions, columns) for hand in hands]
        near = float(np.median((found[0].points.tracklet_indices >= 0).sum(1)))
        points = min(found, key=lambda each: abs(each.shares.shape[1] - near))
        if abs(points.shares.shape[1] - near) > MAX_COUNT_DIFFERENCE * points.shares.shape[1]:
            continue
        of_tracklets, probability = label_tracklets(search_labels(points), 0.0)
        lacking = np.append(points.hand.columns[: points.shares.shape[1]] < 0, False)
        of_tracklets = np.where((probability >= MIN_FINGER_CONFIDENCE) & lacking[of_tracklets], of_tracklets, -1)
        own = tracklets.assign_to_tracklets(points.points, of_tracklets, -1)[:, : shape[1]]
        is_new = (own >= 0) & (markers < 0)
        markers[(own >= 0) & ~is_new] = -1  # both hands might have it
        markers[is_new] = (np.cumsum(lacking) - 1)[own[is_new]] + len(names)
        confidence[is_new] = tracklets.assign_to_tracklets(points.points, probability, 0.0)[:, : shape[1]][is_new]
        names += np.array(points.hand.markers.labels)[lacking[:-1].nonzero()].tolist()
    return (tracklets.PointLabels(markers, confidence), tuple(names)) if (markers >= 0).any() else None
