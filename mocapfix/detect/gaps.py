"""Gaps: stretches of missing samples of a marker, and of all markers of a body part.

A gap of one or two frames is a flicker: the cameras or the labelling lost the marker for a moment. The reason of each flicker
gives the number of flickers of its marker, since a single one is of little interest.

The markers of a body part that is lost have gaps as well. The fault of the body part reports in addition that no marker on the
same bone is visible.
"""

import numpy as np

from mocapfix.detect.noise import RoundMemory
from mocapfix.model.faults import Fault, FaultKind
from mocapfix.model.marker_set import LIMB_JOINT_NAMES, MarkerSet
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.stats.rigid_alignment import compute_lengths
from mocapfix.stats.sequences import compute_known_medians, find_runs

MAX_FLICKER_DURATION_S = 0.02  # longest flicker. A gap of one frame is always one.
MIN_LOST_SEGMENT_DURATION_S = 0.1  # shorter losses of a body part are interpolated from the paths of its markers
MIN_MARKERS_PER_BODY_PART = 2  # a body part with a single marker is described by that marker's gap


def detect_gaps(take: Take, memory: RoundMemory | None = None) -> list[Fault]:
    """Detect gaps, flickers, leading and trailing gaps, and markers that are absent throughout.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the distance in metres between the samples before
        and after the gap, NaN at the ends of the take.
    """
    found = (memory or RoundMemory()).recall("gaps", take.visible, lambda m: _build_gap_faults(take, m))
    return [fault for faults in found for fault in faults]


def _build_gap_faults(take: Take, marker: int) -> list[Fault]:
    gaps = find_runs(~take.visible[:, marker])
    kinds: list[FaultKind] = [_classify_gap(take, marker, first, last) for first, last in gaps]
    label, flicker_count = take.bare_labels[marker], kinds.count("flicker")
    faults: list[Fault] = []
    for kind, (first, last), travel_m in zip(kinds, gaps, _measure_travel(take, [marker], gaps), strict=True):
        reason = f"{label} {_describe_gap(kind, last - first + 1, take.rate, travel_m, flicker_count)}"
        faults.append(Fault(kind, marker, first, last, travel_m, reason))
    return faults


def _classify_gap(take: Take, marker: int, first: int, last: int) -> FaultKind:
    is_seen_before, is_seen_after = take.part.is_seen[:, marker].tolist() if take.part else (False, False)
    match first == 0 and not is_seen_before, last == take.frame_count - 1 and not is_seen_after:
        case True, True:
            return "absent"
        case True, False:
            return "leading gap"
        case False, True:
            return "trailing gap"
        case _:
            return "flicker" if last - first + 1 <= max(1, MAX_FLICKER_DURATION_S * take.rate) else "gap"


def _describe_gap(kind: FaultKind, frame_count: int, rate: float, travel_m: float, flicker_count: int) -> str:
    duration_s = frame_count / rate
    match kind:
        case "absent":
            return "is missing in the whole take."
        case "leading gap":
            return f"is missing for the first {duration_s:.2f} s of the take."
        case "trailing gap":
            return f"is missing for the last {duration_s:.2f} s of the take."
        case "flicker":
            which = f"one of its {flicker_count} flickers" if flicker_count > 1 else "its only flicker"
            frames = f"{frame_count} frame{'s' * (frame_count > 1)}"
            return f"is missing for {frames} ({which}) and moves by {travel_m * 1e3:.0f} mm across the gap."
        case _:
            return f"is missing for {duration_s:.2f} s and moves by {travel_m * 1e3:.0f} mm across the gap."


def detect_lost_segments(take: Take, marker_set: MarkerSet) -> list[Fault]:
    """Detect the stretches in which all markers of a body part are missing, among the parts that have markers in the take.

    Returns:
        The faults, ordered by first frame. Parts that are lost together with a larger part are not reported separately.
        The severity is the median travel in metres of the part's markers, NaN at the ends of the take.
    """
    faults: list[Fault] = []
    for name, markers in list_body_parts(take, marker_set):
        for first, last in find_runs(~np.any(take.visible[:, markers], axis=1)):
            is_known = any(each.first <= first and last <= each.last and set(markers) <= set(each.markers) for each in faults)
            if last - first + 1 >= MIN_LOST_SEGMENT_DURATION_S * take.rate and not is_known:
                faults.append(_build_lost_segment_fault(take, name, markers, first, last))
    return sorted(faults, key=lambda fault: (fault.first, -len(fault.other_markers)))


def list_body_parts(take: Take, marker_set: MarkerSet) -> list[tuple[str, list[int]]]:
    """List the body, its limbs and its segments, larger ones first, with the indices of their markers in the take."""
    columns = marker_set.find_columns(take.labels)
    marker_joints = np.array(load_cmu31_body().skeleton.names)[marker_set.joints]
    joints_by_part: dict[str, set[str]] = {"the body": set(marker_joints.tolist())}
    joints_by_part |= {f"the {limb}": set(joints) for limb, joints in LIMB_JOINT_NAMES.items()}
    joints_by_part |= {name: {name} for name in dict.fromkeys(marker_joints.tolist())}
    columns_of_part = {part: columns[np.isin(marker_joints, list(joints))] for part, joints in joints_by_part.items()}
    parts = [(part, [int(c) for c in columns if c >= 0]) for part, columns in columns_of_part.items()]
    return [(part, markers) for part, markers in parts if len(markers) >= MIN_MARKERS_PER_BODY_PART]


def _build_lost_segment_fault(take: Take, name: str, markers: list[int], first: int, last: int) -> Fault:
    is_whole_take = last - first + 1 == take.frame_count
    time = "in the whole take" if is_whole_take else f"for {(last - first + 1) / take.rate:.2f} s"
    if name == "the body":
        reason = f"All markers of the body are missing {time}: its pose is estimated from the frames before and after."
    else:
        labels = ", ".join(take.bare_labels[m] for m in markers)
        estimate = "its pose is estimated from its neighbours and the pose prior"
        reason = f"All markers of {name} are missing {time} ({labels}): {estimate}."
    (travel_m,) = _measure_travel(take, markers, [(first, last)])
    return Fault("segment lost", markers[0], first, last, travel_m, reason, 1.0, tuple(markers[1:]))


def _measure_travel(take: Take, markers: list[int], gaps: list[tuple[int, int]]) -> list[float]:
    """Measure the median distance in metres between the samples before and after each gap, NaN if no marker has both."""
    first, last = np.array(gaps, int).reshape(-1, 2).T
    before, after = np.maximum(first - 1, 0), np.minimum(last + 1, take.frame_count - 1)  # at an end of the take: in the gap
    travel = take.markers[after[:, None], markers] - take.markers[before[:, None], markers]
    return compute_known_medians(compute_lengths(travel).T).tolist()
