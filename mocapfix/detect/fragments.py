"""Fragments: trajectories that go on under another label (`*12`, `C_123`, `RBAC-1`).

A piece of such a trajectory continues the marker that is missing while it is seen and whose fingerprint it bears: the distances
to the markers of its segment, the side of them it lies on, and a course that leads on to it and from it. Each is measured in its
own standard deviations; their squares add up to a cost, and costs to odds (Bayes' rule), among the markers it could be and the
marker it is none of. The surest go first: what they fill is then no longer missing, and tells of the next.
"""

import numpy as np

from mocapfix.detect.continuity import MAX_DUPLICATE_DISTANCE_M, compute_join_cost
from mocapfix.detect.fragment_classification import (
    MarkerMatch,
    classify_continuation,
    classify_duplicate,
    classify_short,
    classify_unassigned,
    merge_unassigned,
)
from mocapfix.detect.rigid_signature import RigidSignatures
from mocapfix.detect.trajectory_segments import TrajectorySegment, do_segments_overlap, find_loose_segments
from mocapfix.faults import Fragment
from mocapfix.take import Take

UNASSIGNED_COST = 20.0  # the cost at which a piece may as well be none of the markers
MAX_SIGNATURE_DEVIATION_SD = 4.5  # standard deviations from which on distances or side alone speak against a marker
NAMESAKE_SCALE = 0.5  # times the deviations from the marker whose name a piece bears
UNKNOWN_SIGNATURE_COST = 3.0  # the cost of distances that nobody can tell
UNKNOWN_JOIN_COST = 1.0  # that of a course that nobody can tell
MIN_JOIN_PROBABILITY = 0.9  # odds from which on a piece is joined
MIN_SEGMENT_DURATION_S = 0.015  # seconds: a shorter piece tells nothing
MAX_JOIN_GAP_S, MAX_UNSUPPORTED_JOIN_GAP_S = (
    0.3,
    0.05,
)  # seconds over which a course tells anything, and over which it tells enough alone


def detect_fragments(take: Take) -> list[Fragment]:
    """-> what the pieces of the take's unlabelled trajectories, and of markers named twice, are; by donor and first frame.

    A piece is joined where the odds are high that it is one marker and no other: a marker is given one piece at a time, and
    several one after the other. Every piece that is not joined is accounted for as well.
    """
    loose, markers = find_loose_segments(take), take.markers.copy()
    donors = {piece.donor for piece in loose if piece.donor < len(take.labels)}
    markers[:, list(donors)] = np.nan  # a piece must not speak for itself
    receivers = np.setdiff1d(np.flatnonzero(take.visible.any(0)), list(donors))
    told = [_classify_directly(piece, take, receivers) for piece in loose]
    while open_ := [i for i, fragment in enumerate(told) if fragment is None]:
        prints = RigidSignatures(markers)
        weighed = {i: rank_matches(loose[i], markers, take.rate, prints, receivers) for i in open_}
        joined = _join_segments(weighed, loose, markers)
        for i in joined or open_:
            decided = classify_continuation if joined else classify_unassigned
            told[i] = decided(loose[i], weighed[i], compute_match_probability(weighed[i]), take)
    return merge_unassigned([fragment for fragment in told if fragment])


def _classify_directly(segment: TrajectorySegment, take: Take, receivers: np.ndarray) -> Fragment | None:
    """-> what a piece is, where that can be told from itself and the markers seen."""
    if (len(segment.frames) - 1) / take.rate < MIN_SEGMENT_DURATION_S:
        return classify_short(segment, take)
    seen = receivers[take.visible[np.ix_(segment.frames, receivers)].all(0)]
    apart = np.median(np.linalg.norm(take.markers[np.ix_(segment.frames, seen)] - segment.points[:, None], axis=-1), axis=0)
    if apart.min(initial=np.inf) > MAX_DUPLICATE_DISTANCE_M:
        return None
    return classify_duplicate(segment, int(seen[apart.argmin()]), float(apart.min()), take)


def rank_matches(
    segment: TrajectorySegment, markers: np.ndarray, rate: float, signatures: RigidSignatures, receivers: np.ndarray
) -> list[MarkerMatch]:
    """-> how the piece would do as each of the `receivers` that is missing meanwhile, the likeliest first; one that bears a
    marker's name is no other's.

    markers (T, M, 3) metres, NaN where missing; receivers (R,) indices of those that may be given a piece
    """
    if segment.namesake >= 0:
        receivers = np.array([segment.namesake])
    missing = np.isnan(markers[np.ix_(segment.frames, receivers)][..., 0]).any(0)
    each = [_evaluate_match(segment, m, markers[:, m], rate, signatures) for m in receivers[missing].tolist()]
    return sorted(each, key=lambda match: (match.cost, match.distance_error_m))


def _evaluate_match(
    segment: TrajectorySegment, marker: int, path: np.ndarray, rate: float, signatures: RigidSignatures
) -> MarkerMatch:
    scale = NAMESAKE_SCALE if segment.namesake == marker else 1.0
    like = signatures.match_samples(segment.frames, segment.points, marker)
    along = scale**2 * compute_join_cost(segment, path, rate, MAX_JOIN_GAP_S if like else MAX_UNSUPPORTED_JOIN_GAP_S)
    if like is None:
        return MarkerMatch(marker, np.inf if np.isnan(along) else UNKNOWN_SIGNATURE_COST + along, np.nan, ())
    distance, side = scale * like.distance_sd, scale * like.side_sd
    cost = distance**2 + side**2 + (UNKNOWN_JOIN_COST if np.isnan(along) else along)
    return MarkerMatch(
        marker, np.inf if max(distance, side) > MAX_SIGNATURE_DEVIATION_SD else cost, like.distance_error_m, like.partners
    )


def compute_match_probability(candidates: list[MarkerMatch]) -> float:
    """-> 0..1: that the piece is the first of the markers, rather than another or none."""
    costs = np.array([match.cost for match in candidates] + [UNASSIGNED_COST])
    return float(1 / np.exp((costs[0] - costs) / 2).sum()) if candidates and np.isfinite(costs[0]) else 0.0


def _join_segments(candidates: dict[int, list[MarkerMatch]], segments: list[TrajectorySegment], markers: np.ndarray) -> list[int]:
    """-> the pieces that are surely a marker's, one at a time, the cheapest first; joined to markers (T, M, 3) in place."""
    sure = [i for i, each in candidates.items() if compute_match_probability(each) >= MIN_JOIN_PROBABILITY]
    joined: list[int] = []
    for i in sorted(sure, key=lambda i: candidates[i][0].cost):
        piece, marker = segments[i], candidates[i][0].marker
        if not any(candidates[j][0].marker == marker and do_segments_overlap(segments[j], piece) for j in joined):
            joined.append(i)
            free = np.isnan(markers[piece.frames, marker, 0])
            markers[piece.frames[free], marker] = piece.points[free]
    return joined
