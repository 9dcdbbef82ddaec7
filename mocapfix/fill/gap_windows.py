"""A gap, the stretches that imitate it, and estimates of it: the values that all estimators of lost samples take and return.

The errors of an estimator in a gap are unknown. `choose_hidden_stretches` finds visible parts of the take that imitate the gap
and are treated as missing. They are as long, hide the same markers, and have visible samples beside them; where the take has none
that long, shorter ones, which are worth less. Stretches at whose edges the marker moves as fast as at those of the gap tell most:
`choose_similar_stretches` hides these, and others only where there are too few.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from mocapfix.model.body_fit import BodyFit
from mocapfix.stats.marker_distances import RigidGroup
from mocapfix.stats.rigid_alignment import compute_lengths, transform_to_body_axes
from mocapfix.stats.sequences import group_gaps, sample_evenly

MIN_FILL_SD_M = 0.0003  # smallest standard deviation per axis with which an estimate is weighed
MIN_REPORTED_SD_M = 0.0001  # smallest standard deviation per axis of a fill: files round samples to a tenth of a millimetre
MIN_VISIBLE_SHARE = 0.05  # share of the frames in which a marker must be visible to be lost at the beginning or the end
MIN_KEPT_FRAME_SHARE = 0.7  # share of these frames that a group of markers must keep when a marker is added to it
CLUSTER_SATURATION_S = 0.4  # time scale in which the error of an interpolation in moving axes stops growing


class FillMethod(IntEnum):
    """How a sample was filled."""

    SPLINE = 0
    CLUSTER = 1
    BODY = 2
    GAUSSIAN_PROCESS = 3
    RIGID_GROUP = 4
    LINE = 5

    @property
    def description(self) -> str:
        """The source of the sample, as a phrase for reports."""
        return _FILL_METHOD_DESCRIPTIONS[self]


_FILL_METHOD_DESCRIPTIONS = {
    FillMethod.SPLINE: "a spline through its own trajectory",
    FillMethod.CLUSTER: "the markers that move with it",
    FillMethod.BODY: "the solved body",
    FillMethod.GAUSSIAN_PROCESS: "all markers, in frames with a similar body state",
    FillMethod.RIGID_GROUP: "the rigid group to which it belongs",
    FillMethod.LINE: "a line between the ends of its own trajectory",
}


class MarkerEstimate(NamedTuple):
    """Estimates of the samples of a take: positions in metres, standard deviations per axis, NaN for none, and FillMethods."""

    position: Float[np.ndarray, "T M 3"]
    sd: Float[np.ndarray, "T M"]
    method: Int8[np.ndarray, "T M"]


class GapWindow(NamedTuple):
    """A gap, the visible samples beside it, and the hidden stretches that imitate it.

    Offsets count frames from the first frame of the gap, or of a stretch.

    Attributes:
        first: First frame of the gap.
        length: Its number of frames n.
        before: Offsets of the visible samples before it, ascending; they reach up to it without interruption or are empty.
        after: The same after it.
        points: Offsets of the S points in the gap at which errors are measured.
        starts: First frames of the K hidden stretches.
        hidden_length: Of each stretch, in frames.
        hidden_after: Offsets of the samples after a stretch; those before it are `before`.
        hidden_points: Offsets of the S points in a stretch.
    """

    first: int
    length: int
    before: Int[np.ndarray, " B"]
    after: Int[np.ndarray, " A"]
    points: Int[np.ndarray, " S"]
    starts: Int[np.ndarray, " K"]
    hidden_length: int
    hidden_after: Int[np.ndarray, " A"]
    hidden_points: Int[np.ndarray, " S"]

    @property
    def gap_frames(self) -> Int[np.ndarray, " n"]:
        """The frames of the gap."""
        return self.first + np.arange(self.length)

    @property
    def context_frames(self) -> Int[np.ndarray, " C"]:
        """The frames of the samples beside the gap."""
        return self.first + np.concatenate([self.before, self.after])

    @property
    def hidden_frames(self) -> Int[np.ndarray, "K S"]:
        """The frames at which errors are measured."""
        return self.starts[:, None] + self.hidden_points

    @property
    def hidden_context_frames(self) -> Int[np.ndarray, "K C"]:
        """The frames of the samples beside the stretches."""
        return self.starts[:, None] + np.concatenate([self.before, self.hidden_after])

    def count_independent_stretches(self) -> float:
        """Return the number of stretches of this length in the frames that are hidden at least once."""
        if not len(self.starts):
            return 0.0
        steps = np.minimum(np.diff(self.starts), self.hidden_length)
        return min(float(len(self.starts)), (float(steps.sum()) + self.hidden_length) / self.hidden_length)

    def compute_distance_to_edges(self) -> Float[np.ndarray, " S"]:
        """Return the distance of each point, in frames, from the nearest edge of the gap that has a visible sample."""
        to_first, to_last = self.points + 1.0, self.length - self.points * 1.0
        if not len(self.after):
            return to_first
        return np.minimum(to_first, to_last) if len(self.before) else to_last

    def list_frames(
        self, others: Int[np.ndarray, " N"], frame_count: int
    ) -> tuple[Int[np.ndarray, " F"], Int[np.ndarray, " Cn"], Int[np.ndarray, "K CS"]]:
        """Return the frames, ascending, of the gap, of the points of the stretches, beside either, and others.

        And which of them are beside the gap and in it, and beside each stretch and its points.
        """
        row, own = np.zeros(frame_count, int), np.concatenate([self.context_frames, self.gap_frames])
        hidden = np.concatenate([self.hidden_context_frames, self.hidden_frames], axis=1)
        for listed in (others, own, hidden):
            row[listed] = 1
        frames = np.flatnonzero(row)
        row[frames] = np.arange(len(frames))
        return frames, row[own], row[hidden]

    def keep_known_context(self, is_known: Bool[np.ndarray, " C"]) -> "GapWindow":
        """Return the window with those of the samples beside its gap that are known: axes can be unknown there."""
        is_before, is_after = is_known[: len(self.before)], is_known[len(self.before) :]
        return self._replace(before=self.before[is_before], after=self.after[is_after], hidden_after=self.hidden_after[is_after])


class MovingAxes(NamedTuple):
    """Axes that move with some markers in some frames, in metres; the origin is NaN where they are unknown."""

    rotation_world_axes: Float[np.ndarray, "T 3 3"]
    origin: Float[np.ndarray, "T 3"]

    def transform_from_world(self, path: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
        """Return a path in these axes."""
        return transform_to_body_axes(path[:, None], self.origin, self.rotation_world_axes)[:, 0]

    def transform_to_world(self, local: Float[np.ndarray, "n 3"], frames: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return positions in some frames in the world."""
        return np.einsum("tab,tb->ta", self.rotation_world_axes[frames], local) + self.origin[frames]


class GapEstimate(NamedTuple):
    """One estimate of a marker in one gap of n frames.

    Attributes:
        method: How it was made.
        position: Metres, in the world; NaN in the frames that are not estimated.
        error: Metres, in the world, at the points of the hidden stretches; NaN where unknown.
        expected_sd: Metres per axis: of the error at the points of the gap, expected without looking at hidden stretches.
        axes: The axes in which it was made: estimates in the same axes have similar errors. None: in none of its own.
        evidence: Share of its error in the gap that hidden stretches show, 0 to 1.
    """

    method: FillMethod
    position: Float[np.ndarray, "n 3"]
    error: Float[np.ndarray, "K S 3"]
    expected_sd: Float[np.ndarray, " S"]
    axes: str | None = None
    evidence: float = 1.0


@dataclass(frozen=True)
class MarkersInTake:
    """What is known of the markers of a take while its gaps are filled, the shortest first.

    Attributes:
        visible_markers: Metres, NaN if not visible or an outlier.
        markers: The same with the gaps that are filled precisely, which serve as visible for longer ones.
        estimate: All estimates until now.
        distance_change_m: How much the distance of two markers varies; infinite where unknown.
        rate: Frame rate in Hz.
        body: The solved body; None without one.
        rigid_groups: Groups of markers that are rigid and not on the body.
        hands: The solved hands, as bodies that carry the finger markers.
        is_visible: The samples of `visible_markers`.
        is_known: The samples of `markers`.
        is_common: The markers that are visible in more than MIN_VISIBLE_SHARE of the frames.
    """

    visible_markers: Float[np.ndarray, "T M 3"]
    markers: Float[np.ndarray, "T M 3"]
    estimate: MarkerEstimate
    distance_change_m: Float[np.ndarray, "M M"]
    rate: float
    body: BodyFit | None = None
    rigid_groups: Sequence[RigidGroup] = ()
    hands: Sequence[BodyFit] = ()
    is_visible: Bool[np.ndarray, "T M"] = field(init=False)
    is_known: Bool[np.ndarray, "T M"] = field(init=False)
    is_common: Bool[np.ndarray, " M"] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "is_visible", ~np.isnan(self.visible_markers[..., 0]))
        object.__setattr__(self, "is_known", ~np.isnan(self.markers[..., 0]))
        object.__setattr__(self, "is_common", self.is_visible.sum(0) > MIN_VISIBLE_SHARE * len(self.markers))


class Gap(NamedTuple):
    """A marker that is lost throughout a gap, and what is known around it.

    Attributes:
        marker: The lost marker.
        window: The gap and its hidden stretches.
        lost_markers: All markers with this gap.
        neighbours: Markers that are known throughout, those with the most constant distance to the marker first.
        frames: Frames in which it is compared with them, ascending: of the gap, of the stretches, and others.
        rows: Which of these are beside the gap, and in it.
        hidden_rows: The same of each stretch: beside it, and its points.
        activity: How many times as fast the neighbours are in the gap as while the marker is visible, at least one.
        speed_m_s: Variation of the marker's velocity that is expected in the gap.
        variation_growth: How many times as much as while it is visible the marker varies in the gap, relative to others.
    """

    marker: int
    window: GapWindow
    lost_markers: Int[np.ndarray, " L"]
    neighbours: Int[np.ndarray, " N"]
    frames: Int[np.ndarray, " F"]
    rows: Int[np.ndarray, " Cn"]
    hidden_rows: Int[np.ndarray, "K CS"]
    activity: float
    speed_m_s: float
    variation_growth: float


Estimator = Callable[[Gap], list[GapEstimate]]  # returns estimates of the marker of a gap, none where it has no estimate

MAX_HIDDEN_STRETCHES = 12  # stretches that are hidden for one gap
MIN_STRETCH_STARTS = 2  # first frames that must be possible for stretches of a length
MIN_STARTS_PER_LENGTH = 0.05  # the same, relative to the length
SHORTER_STRETCH_RATIO = 0.7  # ratio by which stretches are shortened at a time while too few first frames are possible
MAX_EXAMINED_STARTS = 4000  # first frames that are examined
MAX_GAP_POINTS = 7  # points along a gap at which errors are measured
MAX_EDGE_SAMPLES = 4  # samples at each edge of a gap that are used
EDGE_CONTEXT_S = 0.06  # time on either side of a gap whose samples determine position and velocity at its edge


def choose_hidden_stretches(
    is_usable: Bool[np.ndarray, " T"], first: int, last: int, rate: float, max_count: int = MAX_HIDDEN_STRETCHES
) -> GapWindow:
    """Return the window of a gap first..last, with stretches that are spread evenly over the take.

    Args:
        is_usable: Frames in which all markers are visible that the gap hides.
    """
    length, reach = last - first + 1, max(1, round(EDGE_CONTEXT_S * rate))
    before = -1 - find_adjacent_samples(is_usable[max(0, first - reach) : first][::-1])[::-1]
    steps = find_adjacent_samples(is_usable[last + 1 : last + 1 + reach])
    lead, tail = (-int(before[0]) if len(before) else 0), (int(steps[-1]) + 1 if len(steps) else 0)
    hidden_length, starts = find_stretches(is_usable, length, lead, tail)
    starts = starts[sample_evenly(len(starts), max_count)] if len(starts) else starts
    count = min(length, MAX_GAP_POINTS)
    return GapWindow(
        first, length, before, length + steps, space_points(length, count),
        starts, hidden_length, hidden_length + steps, space_points(hidden_length, count),
    )  # fmt: skip


def find_adjacent_samples(is_usable: Bool[np.ndarray, " N"]) -> Int[np.ndarray, " A"]:
    """Return indices of usable samples, the first and some others, if the first is usable; otherwise none."""
    usable = np.flatnonzero(is_usable)
    return usable[sample_evenly(len(usable), MAX_EDGE_SAMPLES)] if len(usable) and usable[0] == 0 else usable[:0]


def space_points(length: int, count: int) -> Int[np.ndarray, " S"]:
    """Return the offsets of evenly spaced points from the first to the last frame of a gap."""
    return np.round(np.linspace(0, length - 1, count)).astype(int)


def find_stretches(is_usable: Bool[np.ndarray, " T"], length: int, lead: int, tail: int) -> tuple[int, Int[np.ndarray, " K"]]:
    """Return the length of the stretches, the gap's own if the take has enough of them, and their first frames.

    The frames `lead` before and `tail` after a stretch must be usable too.
    """
    missing_before = np.concatenate([[0], np.cumsum(~is_usable)])
    while True:
        span = lead + length + tail
        step = 1 + max(0, len(is_usable) - span) // MAX_EXAMINED_STARTS
        starts = np.arange(0, len(is_usable) - span + 1, step)
        starts = starts[missing_before[starts + span] == missing_before[starts]] + lead
        if length == 1 or len(starts) * step >= max(MIN_STRETCH_STARTS, MIN_STARTS_PER_LENGTH * length):
            return length, starts
        length = max(1, int(length * SHORTER_STRETCH_RATIO))


def iterate_gaps(
    is_missing: Bool[np.ndarray, "T M"], is_visible: Bool[np.ndarray, "T M"], has_ends: Bool[np.ndarray, " M"]
) -> Iterator[tuple[int, int, Int[np.ndarray, " L"]]]:
    """Yield the first and last frame of each gap and the markers it has, the shortest first.

    Markers that are visible together come together. Only markers with `has_ends` have gaps at the beginning and the end.
    """
    gaps = group_gaps(is_missing & (is_visible.any(0) | has_ends))
    for (first, last), lost in sorted(gaps.items(), key=lambda gap: (gap[0][1] - gap[0][0], gap[0])):
        remaining = lost if first > 0 and last < len(is_missing) - 1 else lost[has_ends[lost]]
        while len(remaining):
            by_frequency = remaining[np.argsort(-is_visible[:, remaining].sum(0), kind="stable")]
            others, _ = select_visible_together(is_visible, int(by_frequency[0]), by_frequency[1:], 0, len(remaining))
            together = np.sort([by_frequency[0], *others])
            yield first, last, together
            remaining = np.setdiff1d(remaining, together)


def select_visible_together(
    is_visible: Bool[np.ndarray, "T M"], marker: int, others: Int[np.ndarray, " N"], min_frames: int, max_count: int
) -> tuple[list[int], Bool[np.ndarray, " T"]]:
    """Return those of other markers, in the order given, that leave enough of the frames that show a marker, and these frames."""
    shared, together = is_visible[:, marker], list[int]()
    for other in others.tolist():
        both = shared & is_visible[:, other]
        if np.count_nonzero(both) >= max(min_frames, MIN_KEPT_FRAME_SHARE * np.count_nonzero(shared)):
            shared = both
            together.append(other)
        if len(together) == max_count:
            break
    return together, shared


RESTING_SPEED_M_S = 0.02  # speed that is added to all, below which markers count as equally at rest
MAX_EDGE_SPEED_SHARE = 0.5
"""Exponent of the speed at the edges in the expected speed within a short gap; the marker's usual speed has the rest."""
REST_TIME_S = 5.0  # time in which this share decays
SIMILAR_SPEED_RATIO = 2.0
"""Ratio of the speeds of a gap and a stretch at which the stretch has the weight of one standard deviation, 0.61."""
MAX_COMPARED_STRETCHES = 240  # stretches that are compared with a gap
MAX_COMPARED_GAP_S = 0.7  # duration of a gap above which the motion beside it tells too little of that within
MIN_SIMILARITY = 0.6  # of a stretch to the gap; less similar ones are hidden only where the take has too few others
MIN_SIMILAR_STRETCHES = 12  # stretches from which on less similar ones are not hidden


class EdgeMotion(NamedTuple):
    """The motion of a marker beside a gap."""

    speed_m_s: Float[np.ndarray, " L"] | None
    """Mean of the speeds before, across and after the gap, and RESTING_SPEED_M_S; None without two edges."""
    similarity: Float[np.ndarray, "K L"]  # of each hidden stretch to the gap, 0 to 1

    def estimate_speed_in_gap(self, n: int, usual_speed_m_s: float, gap_s: float) -> float:
        """Return the speed of the nth in m/s that is expected within a gap: the longer it is, the less the edges show of it."""
        if self.speed_m_s is None:
            return usual_speed_m_s
        edge_share = MAX_EDGE_SPEED_SHARE * np.exp(-gap_s / REST_TIME_S)
        return float(usual_speed_m_s ** (1 - edge_share) * self.speed_m_s[n] ** edge_share)


def compare_edge_motion(paths: Float[np.ndarray, "T L 3"], window: GapWindow, rate: float) -> EdgeMotion:
    """Return the motion of markers (metres, NaN if not visible) beside a gap and the similarity of the hidden stretches."""
    w = window
    if not len(w.before) or not len(w.after):
        return EdgeMotion(None, np.ones((len(w.starts), paths.shape[1])))
    offsets = np.array([[w.before[0], w.before[-1], after[0], after[-1]] for after in (w.after, w.hidden_after)])
    places = paths[np.concatenate([w.first + offsets[:1], w.starts[:, None] + offsets[1]])]
    seconds = np.maximum(offsets[:, 1:] - offsets[:, :-1], 1) / rate
    speeds = compute_lengths(places[:, 1:] - places[:, :-1]) / seconds[[0, *([1] * len(w.starts))], :, None]
    speed = speeds.mean(1) + RESTING_SPEED_M_S
    difference = np.log(speed[1:] / speed[0]) / np.log(SIMILAR_SPEED_RATIO)
    return EdgeMotion(speed[0], np.exp(-0.5 * np.nan_to_num(difference, nan=np.inf) ** 2))


def choose_similar_stretches(
    paths: Float[np.ndarray, "T L 3"], is_usable: Bool[np.ndarray, " T"], first: int, last: int, rate: float
) -> GapWindow:
    """Return the window of a gap first..last of L markers, with stretches beside which these move as beside the gap.

    Args:
        paths: Metres, NaN if not visible.
        is_usable: Frames in which all of them are visible.
    """
    if last - first >= MAX_COMPARED_GAP_S * rate:
        return choose_hidden_stretches(is_usable, first, last, rate)
    window = choose_hidden_stretches(is_usable, first, last, rate, MAX_COMPARED_STRETCHES)
    if len(window.starts) <= MIN_SIMILAR_STRETCHES:
        return window
    similarity = compare_edge_motion(paths, window, rate).similarity.mean(1)
    used = np.argsort(-similarity, kind="stable")[: max(MIN_SIMILAR_STRETCHES, np.count_nonzero(similarity > MIN_SIMILARITY))]
    return window._replace(starts=window.starts[np.sort(used)[sample_evenly(len(used), MAX_HIDDEN_STRETCHES)]])


def compute_variation_growth(is_shown: Bool[np.ndarray, " T"], gap_s: float, rate: float) -> float:
    """Return the factor, at least one, by which a marker varies more in a gap than while it is visible, relative to others.

    A marker that is visible for a shorter time than the gap shows less of its motion. Each visible frame shows the time until the
    next one, up to CLUSTER_SATURATION_S.
    """
    shown_s = 1 / rate + float(np.minimum(np.diff(np.flatnonzero(is_shown)) / rate, CLUSTER_SATURATION_S).sum())
    shown, hidden = (duration_s / (CLUSTER_SATURATION_S + duration_s) for duration_s in (shown_s, gap_s))
    return max(hidden / shown, 1.0)
