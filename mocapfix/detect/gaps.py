"""Gaps: the stretches in which a marker is not seen.

A gap of a frame or two is a flicker: a moment's doubt of the cameras or of whoever labelled, of which nobody wants to hear
one by one. Each says how many there are of its marker, so that one can speak for all.
"""

import numpy as np

from mocapfix.faults import Fault, FaultKind
from mocapfix.marker_sets import LIMB_JOINT_NAMES, MarkerSet
from mocapfix.skeleton import load_cmu31_body
from mocapfix.stats.runs import find_runs
from mocapfix.take import Take

# MERGED: mocapfix.detect.gaps
MAX_FLICKER_DURATION_S = 0.02  # seconds: how long a flicker lasts at most, but for one frame, which is always one


def detect_gaps(take: Take) -> list[Fault]:
    """-> every gap, flicker, leading and trailing gap, and every marker that is absent throughout, by marker and first frame."""
    missing = ~take.visible
    return [fault for m in range(len(take.labels)) for fault in _build_gap_faults(take, m, find_runs(missing[:, m]))]


def _build_gap_faults(take: Take, marker: int, gaps: list[tuple[int, int]]) -> list[Fault]:
    """-> the faults that the gaps of one marker are."""
    kinds: list[FaultKind] = [_classify_gap(take, first, last) for first, last in gaps]
    label, flickers = take.bare_labels[marker], kinds.count("flicker")
    faults = []
    for kind, (first, last) in zip(kinds, gaps, strict=True):
        moved = _measure_marker_travel(take, marker, first, last)
        reason = f"{label} {_describe_gap(kind, last - first + 1, take.rate, moved, flickers)}"
        faults.append(Fault(kind, marker, first, last, moved, reason))
    return faults


def _classify_gap(take: Take, first: int, last: int) -> FaultKind:
    match first == 0, last == take.frame_count - 1:
        case True, True:
            return "absent"
        case True, False:
            return "leading gap"
        case False, True:
            return "trailing gap"
        case _:
            return "flicker" if last - first + 1 <= max(1, MAX_FLICKER_DURATION_S * take.rate) else "gap"


def _measure_marker_travel(take: Take, marker: int, first: int, last: int) -> float:
    """-> metres from the sample before a gap to the one after it, NaN where the take begins or ends in it."""
    if first == 0 or last == take.frame_count - 1:
        return float("nan")
    return float(np.linalg.norm(take.markers[last + 1, marker] - take.markers[first - 1, marker]))


def _describe_gap(kind: FaultKind, frames: int, rate: float, travel_m: float, flicker_count: int) -> str:
    seconds = frames / rate
    match kind:
        case "absent":
            return "is never seen in this take."
        case "leading gap":
            return f"is not seen for the take's first {seconds:.2f} s."
        case "trailing gap":
            return f"is not seen for the take's last {seconds:.2f} s."
        case "flicker":
            often = f"one of its {flicker_count} flickers" if flicker_count > 1 else "its only flicker"
            return f"is not seen for {frames} frame{'s' * (frames > 1)} and moves {travel_m * 1e3:.0f} mm meanwhile, {often}."
        case _:
            return f"is not seen for {seconds:.2f} s and moves {travel_m * 1e3:.0f} mm meanwhile."


# MERGED: mocapfix.detect.segments
# Segments lost: the stretches in which nothing of a segment, a limb or the whole body is seen.
#
# Their markers' gaps are all there besides; this says what the gaps do not, that no neighbour on the same bone can help.
MIN_LOST_SEGMENT_DURATION_S = 0.1  # seconds: what is lost for less, its markers' own paths carry over
MIN_MARKERS_PER_BODY_PART = 2  # markers of a segment; of a single one its gap says it all


def detect_lost_segments(take: Take, marker_set: MarkerSet) -> list[Fault]:
    """-> where all markers of a part of the body are missing that the take has at all, by first frame.

    What is lost with a greater part is not named besides.
    """
    faults: list[Fault] = []
    for name, markers in list_body_parts(take, marker_set):
        for first, last in find_runs(~np.any(take.visible[:, markers], axis=1)):
            inside = any(whole.first <= first and last <= whole.last and set(markers) <= set(whole.markers) for whole in faults)
            if last - first + 1 >= MIN_LOST_SEGMENT_DURATION_S * take.rate and not inside:
                faults.append(_build_lost_segment_fault(take, name, markers, first, last))
    return sorted(faults, key=lambda fault: (fault.first, -len(fault.other_markers)))


def list_body_parts(take: Take, marker_set: MarkerSet) -> list[tuple[str, list[int]]]:
    """-> the body, its limbs and its segments, greater ones first: what each is called, and its markers in the take."""
    columns, names = marker_set.find_columns(take.labels), np.array(load_cmu31_body().skeleton.names)[marker_set.joints]
    bones = {"the body": set(names)} | {f"the {limb}": set(joints) for limb, joints in LIMB_JOINT_NAMES.items()}
    bones |= {name: {name} for name in dict.fromkeys(names.tolist())}
    found = [(part, [int(c) for c in columns[np.isin(names, list(on))] if c >= 0]) for part, on in bones.items()]
    return [(part, markers) for part, markers in found if len(markers) >= MIN_MARKERS_PER_BODY_PART]


def _build_lost_segment_fault(take: Take, name: str, markers: list[int], first: int, last: int) -> Fault:
    seconds, whole = (last - first + 1) / take.rate, last - first + 1 == take.frame_count
    time = "in the whole take" if whole else f"for {seconds:.2f} s"
    labels = ", ".join(take.bare_labels[m] for m in markers)
    known = "only its neighbours and people's usual poses tell where it is"
    reason = f"Nothing of {name} is seen {time} ({labels}): {known}."
    if name == "the body":
        reason = f"Nothing of the body is seen {time}: where it is can only be guessed from before and after."
    return Fault(
        "segment lost", markers[0], first, last, _measure_part_travel(take, markers, first, last), reason, 1.0, tuple(markers[1:])
    )


def _measure_part_travel(take: Take, markers: list[int], first: int, last: int) -> float:
    """-> metres: how far the part's markers that are seen on both sides move meanwhile, the median; NaN where none is."""
    if first == 0 or last == take.frame_count - 1:
        return float("nan")
    way = np.linalg.norm(take.markers[last + 1, markers] - take.markers[first - 1, markers], axis=-1)
    return float(np.nanmedian(way)) if np.isfinite(way).any() else float("nan")
