"""Limbs lost in sight: frames in which the solved body leaves a part of the body although its markers show where it is.

A part of the body counts as lost in a frame if at least MIN_CONSISTENT_MARKERS of its markers are seen and mutually consistent,
their mean distance from the body exceeds MIN_LOST_DISTANCE_M, and most of them lie off the body. What was measured counts,
whatever detection made of it: a limb all of whose samples were taken for spikes is lost as well.

Two markers are consistent if their distance is possible on this subject. Markers on one segment keep their distance from one
another, up to the motion of the skin. Markers on two segments are connected by a chain of bones: their distance lies between
those of the folded and the stretched chain. Samples that detection took for faults count only if they keep their distances from
another marker on the same segment that lies off the body as well, and if more of the segment's markers lie off the body so than
sound ones lie on it: two spikes may keep their distance by chance. Of the markers of a part the one with the most contradictions
is left out, until none is left; of two that contradict each other alone, the one that lies off the body.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.model.skeleton import BODY_SECTIONS, Skeleton, list_path
from mocapfix.model.subject import Subject
from mocapfix.stats.gaussian_process import MEDIAN_DEVIATIONS_PER_SD

MIN_CONSISTENT_MARKERS = 3  # the number of seen, mutually consistent markers that show where a part of the body is
MIN_LOST_DISTANCE_M = 0.06  # compared with the mean distance of a part's consistent markers from the body
MIN_DISTANCE_TOLERANCE_M = 0.025  # by which the distance of two markers on one segment may differ from its median over the take
DISTANCE_TOLERANCE_SD = 4.0  # the same in robust standard deviations of that distance, for pairs whose skin moves more
CHAIN_TOLERANCE_M = 0.04
"""by which the distance of two markers on two segments may lie outside the range of their chain of bones: the calibration error
of the bones, and the motion of the skin"""
MIN_SHARED_DISTANCE_M = 0.03
"""compared with the distance from the body of the marker that supports a sample which detection took for a fault: a spike may
keep its distance from a sound neighbour by chance"""
MIN_OFF_SHARE = 0.6
"""share of a part's consistent markers that lie off the body by more than that: one marker with a fault that was not found does
not make a limb lost whose other markers lie on the body"""
MIN_PROXIMAL_DISTANCE_M = 0.03
"""a limb counts as lost beyond the part of it that is lost anyway if the mean distance of its other markers exceeds this: so a
lost foot is not called a lost leg"""

BODY_PARTS = {name: BODY_SECTIONS[name] for name in ("head", "trunk", "pelvis")} | {
    f"{side} {part}": BODY_SECTIONS[f"{side} {limb}"][first:]
    for limb, parts in (("arm", ("arm", "forearm", "hand")), ("leg", ("leg", "lower leg", "foot")))
    for first, part in enumerate(parts)
    for side in ("left", "right")
}
"""the joints of each part: of the sections of the body, and of the outer parts of limbs"""
LIMB_CHAINS = (
    ("left hand", "left forearm", "left arm"),
    ("right hand", "right forearm", "right arm"),
    ("left foot", "left lower leg", "left leg"),
    ("right foot", "right lower leg", "right leg"),
)
"""parts of which each is contained in the next: a frame counts for one of them only"""


@dataclass(frozen=True)
class LostPart:
    """A part of the body that the solve lost in sight.

    Attributes:
        frames: The frames (T,) in which it is lost, without those in which a part that contains it or is contained counts.
        distance_m: Mean distance (T,) in metres of its consistent markers from the body, NaN in the other frames.
    """

    name: str  # a key of BODY_PARTS
    frames: Bool[np.ndarray, " T"]
    distance_m: Float[np.ndarray, " T"]
    markers: Bool[np.ndarray, "T K"]  # the samples (T, K) of its consistent markers in the lost frames

    @property
    def frame_count(self) -> int:
        """The number of lost frames."""
        return int(self.frames.sum())

    def restrict(self) -> "LostPart":
        """Return the part without distances and markers in other frames than its own."""
        return LostPart(
            self.name, self.frames, np.where(self.frames, self.distance_m, np.nan), self.markers & self.frames[:, None]
        )


def find_lost_parts(
    markers: Float[np.ndarray, "T K 3"],
    inlier_mask: Bool[np.ndarray, "T K"],
    subject: Subject,
    body_markers: Float[np.ndarray, "T K 3"],
    min_distance_m: float = MIN_LOST_DISTANCE_M,
    min_off_share: float = MIN_OFF_SHARE,
) -> tuple[LostPart, ...]:
    """Return the parts of the body that are lost in at least one frame, in the order of BODY_PARTS.

    Args:
        markers: The measured positions of the subject's markers in metres, NaN where missing.
        inlier_mask: The samples that are not taken for faults.
        body_markers: Where the solved body carries the markers, in metres.
        min_distance_m: The mean distance above which a part counts as lost.
        min_off_share: The share of its consistent markers that lie off the body.
    """
    distance_m = np.linalg.norm(markers - body_markers, axis=-1)
    parts: dict[str, LostPart] = {}
    for name, joint_names in BODY_PARTS.items():
        columns = np.flatnonzero(np.isin(subject.joints, _find_joints(subject.skeleton, joint_names)))
        if len(columns) >= MIN_CONSISTENT_MARKERS:
            samples, limit_m = (markers, inlier_mask, subject, distance_m), min_distance_m
            parts[name] = _find_lost_frames(name, columns, *samples, min_distance_m=limit_m, min_off_share=min_off_share)
    for chain in LIMB_CHAINS:
        _assign_frames([parts[name] for name in chain if name in parts], subject, distance_m)
    return tuple(part.restrict() for part in parts.values() if part.frames.any())


def _assign_frames(chain: list[LostPart], subject: Subject, distance_m: np.ndarray) -> None:
    """Leave each frame to one of the parts: to the smallest, or to a larger one whose other markers are far away as well."""
    for n, outer in enumerate(chain[1:], start=1):
        inner_joints = _find_joints(subject.skeleton, BODY_PARTS[chain[n - 1].name])
        is_proximal = outer.markers & ~np.isin(subject.joints, inner_joints)
        total_m = np.where(is_proximal, distance_m, 0).sum(1)
        is_outer = outer.frames & (total_m > MIN_PROXIMAL_DISTANCE_M * np.maximum(is_proximal.sum(1), 1))
        outer.frames[np.logical_or.reduce([inner.frames for inner in chain[:n]]) & ~is_outer] = False
        for inner in chain[:n]:
            inner.frames[is_outer] = False


def _find_joints(skeleton: Skeleton, names: Iterable[str]) -> list[int]:
    return [skeleton.find_joint(name) for name in names if name in skeleton.names]


def _find_lost_frames(
    name: str,
    columns: np.ndarray,
    markers: np.ndarray,
    inlier_mask: np.ndarray,
    subject: Subject,
    distance_m: np.ndarray,
    *,
    min_distance_m: float,
    min_off_share: float,
) -> LostPart:
    """Find the frames in which the markers (k,) of one part are consistent and far from the body."""
    frames = np.zeros(len(markers), bool)
    mean_m, consistent = np.full(len(markers), np.nan), np.zeros(inlier_mask.shape, bool)
    # The mean over consistent markers exceeds the limit only where at least one of them does.
    candidates = np.flatnonzero(np.nanmax(np.nan_to_num(distance_m[:, columns]), axis=1) > min_distance_m)
    if not len(candidates):
        return LostPart(name, frames, mean_m, consistent)
    is_consistent = select_consistent_markers(markers, inlier_mask, subject, columns, candidates, distance_m)
    count = is_consistent.sum(1)
    total_m = np.where(is_consistent, distance_m[np.ix_(candidates, columns)], 0).sum(1)
    mean_m[candidates] = total_m / np.maximum(count, 1)
    off_count = (is_consistent & (distance_m[np.ix_(candidates, columns)] > MIN_SHARED_DISTANCE_M)).sum(1)
    is_off = (mean_m[candidates] > min_distance_m) & (off_count >= min_off_share * count)
    frames[candidates] = (count >= MIN_CONSISTENT_MARKERS) & is_off
    consistent[np.ix_(candidates, columns)] = is_consistent
    return LostPart(name, frames, mean_m, consistent)


def select_consistent_markers(
    markers: Float[np.ndarray, "T K 3"],
    inlier_mask: Bool[np.ndarray, "T K"],
    subject: Subject,
    columns: np.ndarray,
    frames: np.ndarray,
    body_distance_m: Float[np.ndarray, "T K"],
) -> Bool[np.ndarray, "N k"]:
    """Return which of k markers are seen and mutually consistent in each of N frames.

    Args:
        markers: Measured positions in metres, NaN where missing.
        inlier_mask: The samples that are not taken for faults.
        body_distance_m: Distances of the markers from the solved body in metres, NaN where missing.
    """
    low_m, high_m = compute_distance_ranges(markers, inlier_mask, subject, columns)
    position = markers[np.ix_(frames, columns)]
    is_same_segment = subject.joints[columns][:, None] == subject.joints[columns]
    np.fill_diagonal(is_same_segment, False)
    distance_m = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1)
    is_possible = (distance_m >= low_m) & (distance_m <= high_m)
    is_selected = ~np.isnan(position[..., 0])
    is_off_body = body_distance_m[np.ix_(frames, columns)] > MIN_SHARED_DISTANCE_M
    is_sound = inlier_mask[np.ix_(frames, columns)]
    supporter_count = (is_possible & is_same_segment & is_off_body[:, None]).sum(2)
    on_body_count = (is_same_segment & (is_sound & is_selected & ~is_off_body)[:, None]).sum(2)
    is_selected &= is_sound | ((supporter_count > 0) & (supporter_count + 1 > on_body_count))
    contradicts = ~is_possible
    for _ in range(len(columns)):
        pairs = contradicts & is_selected[:, :, None] & is_selected[:, None]
        contradiction_count = pairs.sum(2)
        is_contradicted = contradiction_count.max(1) > 0
        if not is_contradicted.any():
            break
        # Of equally contradicted markers one off the body, of those the one with the largest excess over the possible distances.
        excess_m = np.where(pairs, np.maximum(distance_m - high_m, low_m - distance_m), 0).sum(2)
        worst = np.argmax(2 * contradiction_count + is_off_body + excess_m / (1 + excess_m), axis=1)
        is_selected[is_contradicted, worst[is_contradicted]] = False
    return is_selected


def compute_distance_ranges(
    markers: Float[np.ndarray, "T K 3"], inlier_mask: Bool[np.ndarray, "T K"], subject: Subject, columns: np.ndarray
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k k"]]:
    """Return the smallest and the largest possible distance in metres of each pair of k markers of a subject."""
    count = len(columns)
    low_m, high_m = np.zeros((count, count)), np.full((count, count), np.inf)
    inliers = np.where(inlier_mask[:, columns, None], markers[:, columns], np.nan)
    for a in range(count):
        for b in range(a):
            if subject.joints[columns[a]] == subject.joints[columns[b]]:
                limits = _compute_rigid_range(inliers[:, a] - inliers[:, b])
            else:
                lengths_m = _list_chain_lengths(subject, int(columns[a]), int(columns[b]))
                longest_m, shortest_m = sum(lengths_m), max(0.0, 2 * max(lengths_m) - sum(lengths_m))
                limits = shortest_m - CHAIN_TOLERANCE_M, longest_m + CHAIN_TOLERANCE_M
            low_m[a, b], high_m[a, b] = limits
            low_m[b, a], high_m[b, a] = limits
    return low_m, high_m


def _compute_rigid_range(difference: np.ndarray) -> tuple[float, float]:
    """Return the range of the distance of two markers on one segment, from their differences (T, 3) over the take."""
    distance_m = np.linalg.norm(difference, axis=-1)
    distance_m = distance_m[~np.isnan(distance_m)]
    if not len(distance_m):
        return 0.0, float("inf")
    median_m = float(np.median(distance_m))
    sd_m = MEDIAN_DEVIATIONS_PER_SD * float(np.median(np.abs(distance_m - median_m)))
    tolerance_m = max(MIN_DISTANCE_TOLERANCE_M, DISTANCE_TOLERANCE_SD * sd_m)
    return median_m - tolerance_m, median_m + tolerance_m


def _list_chain_lengths(subject: Subject, one: int, other: int) -> list[float]:
    """Return the lengths in metres from a marker along the joints to another marker."""
    parents, offsets = subject.skeleton.parents, subject.skeleton.offsets
    paths = [list_path(int(subject.joints[k]), -1, parents)[::-1] for k in (one, other)]
    common = next(joint for joint in paths[0] if joint in paths[1])
    lengths_m: list[float] = []
    ends: list[np.ndarray] = []  # in the axes of the segment that both paths reach: a joint, or the marker itself
    for k, path in zip((one, other), paths, strict=True):
        point = subject.marker_offsets[k]
        for joint in path[: path.index(common)]:
            lengths_m.append(float(np.linalg.norm(point)))
            point = offsets[joint]
        ends.append(point)
    return [*lengths_m, float(np.linalg.norm(ends[0] - ends[1]))]
