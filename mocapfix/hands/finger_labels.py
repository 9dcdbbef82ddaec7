"""Labels of finger markers: those that neighbouring fingers, or both hands, exchange.

Fingers move little in the axes of their palm, which the body carries. There the points near a hand are linked into tracklets
where one certainly continues another (`labels.tracklets`), in whichever columns they are; where a label changes its point unseen,
a tracklet ends. The labels of tracklets are those that they have most of the time. The average hand of a person of this size is
posed in frames of every tracklet; tracklets are assigned to its markers again, and two markers exchange their labels, over a
stretch at whose ends both are unseen, if the poses of the hand are then more probable. The hand is not calibrated: places that
adapt to the take would adapt to labels that are wrong in most of it.
"""

from dataclasses import dataclass
from functools import cached_property

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
from mocapfix.hands.finger_markers import FingerMarkers, find_finger_markers
from mocapfix.hands.hand_model import load_hand
from mocapfix.hands.solve_hands import add_palm_markers, trace_palm
from mocapfix.labels import tracklets
from mocapfix.labels.label_swaps import build_exchange_fault, find_permutation_cycles
from mocapfix.model.faults import Fault
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import Poses, compute_tree_poses
from mocapfix.solve.minimise import compute_costs
from mocapfix.stats.sequences import sample_evenly

# Measured on composed people of `bench hands` with seeds of 100 and more, with 20, 10 and 6 markers of a hand pair.
FINGER_REACH_M = 0.3  # from the wrist, of points that may be markers of its hand
COLUMN_GAIN = 3.0  # of links within a column, as in `labels.tracklets`: 4 of 626 tracklets change their marker, with 10 it is 6
OTHER_COLUMN_SD_M = 0.025  # a tracklet that is never under a label counts as if this much farther from its marker
MAX_FINGER_DISTANCE_M = 0.05  # of a tracklet from its marker
MAX_ASSIGNMENT_ROUNDS = 4
# Exchanges are tried that seem to lose less, with the poses unchanged and markers within this distance of the hand's: all right
# ones seem to gain, and nine of ten wrong ones lose more.
MIN_PRELIMINARY_GAIN, PRELIMINARY_SD_M = -4.0, 0.015
# Median over frames of the negative logarithm of a pose's probability density that an exchange saves: -1.2 and less were measured
# for wrong ones, 17 and more for right ones of a stretch; of a single tip beside a lost one it may be less.
MIN_FINGER_GAIN = 3.0
MAX_TESTED_FRAMES = 16  # of a stretch
MAX_EXCHANGES = 12  # of a hand
FINGER_CONFIDENCE = 0.95  # of a correction


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
        return compute_costs(hand.tree, terms, poses, squared_scale, codes=codes), predict_fingers(hand, poses, fingers.shape[1])


def predict_fingers(hand: CalibratedHand, poses: Poses, count: int) -> Float[np.ndarray, "S K 3"]:
    """Return where poses have the first markers of a hand, in metres."""
    position, rotation = compute_tree_poses(hand.tree, *poses)
    joints, offsets = (each[:count] for each in hand.attachment)
    return position[:, joints] + (rotation[:, joints] @ offsets[..., None])[..., 0]


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


def label_tracklets(hand_points: HandPoints) -> Int[np.ndarray, " N"]:
    """Return the marker of each tracklet, -1 for none."""
    sampled, count = hand_points.sampled, hand_points.shares.shape[1]
    prior = (1 - hand_points.shares) * OTHER_COLUMN_SD_M**2
    every, most = np.ones(len(prior)), 0.99 * OTHER_COLUMN_SD_M
    markers = tracklets.assign_tracklets(sampled, prior, most * every)
    hand = build_average_hand(hand_points.hand, hand_points.size_ratio)
    for _ in range(MAX_ASSIGNMENT_ROUNDS):
        predicted = hand_points.fit_poses(hand, sampled.frames, sampled.arrange_markers(markers, count))[1]
        squared = tracklets.measure_tracklets(sampled, predicted, 2 * MAX_FINGER_DISTANCE_M).squared_m2
        before, markers = markers, tracklets.assign_tracklets(sampled, squared + prior, MAX_FINGER_DISTANCE_M * every)
        if (markers == before).all():
            break
    for _ in range(MAX_EXCHANGES):
        exchanges = find_exchanges_of_fingers(hand_points, hand, markers)
        gain, exchanged, pair = max(exchanges, key=lambda each: each[0], default=(-np.inf, np.zeros(0, int), (0, 0)))
        if gain <= MIN_FINGER_GAIN:
            break
        markers = markers.copy()
        markers[exchanged] = np.where(markers[exchanged] == pair[0], pair[1], pair[0])
    return markers


def find_exchanges_of_fingers(
    hand_points: HandPoints, hand: CalibratedHand, markers: Int[np.ndarray, " N"]
) -> list[tuple[float, Int[np.ndarray, " E"], tuple[int, int]]]:
    """Return what exchanges of two markers save, the tracklets that they concern, and the markers."""
    sampled, (first, last), count = hand_points.sampled, hand_points.spans, hand_points.shares.shape[1]
    fingers = sampled.arrange_markers(markers, count)
    cost, predicted = hand_points.fit_poses(hand, sampled.frames, fingers)
    tried: list[tuple[Int[np.ndarray, " F"], np.ndarray, Int[np.ndarray, " E"], tuple[int, int]]] = []
    for one, other in np.argwhere(np.triu(np.ones((count, count), bool), 1)).tolist():
        pair = [one, other]
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
                tried.append((frames, others, exchanged, (one, other)))
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
    """Return the exchanges of the labels of finger markers in the order of their first frames; undone, each has its own."""
    hands = find_finger_markers(subject.marker_set, take.labels)
    if not all(subject.solved_joints[subject.skeleton.find_joint(f"{each.side}Hand")] for each in hands) or not hands:
        return []
    columns = np.concatenate([hand.columns for hand in hands])
    positions = np.where(take.measured[:, columns, None], take.markers[:, columns], np.nan)
    places = np.arange(len(columns))
    target = np.tile(places, (take.frame_count, 1))
    for hand in hands:
        points, own = collect_points(hand, (subject, motion), take, positions, columns), places[np.isin(columns, hand.columns)]
        found = tracklets.assign_to_tracklets(points.points, label_tracklets(points), -2)
        is_lost = (found == -1) & np.isin(places, own)
        target = np.where(found >= 0, own[found], np.where(is_lost, -1, target))
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
    return sorted(faults, key=lambda fault: fault.first)


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
