"""The record of a cleaning: what the report file says, as plain data with stable keys.

take     file, person (whose it is, where it is one person's of several), frames, first_frame, rate_hz, markers, marker_set
         (null where none fits), labels; animation (true: its markers are joints)
faults   a list: kind, marker, first, last (the file's own frame numbers, inclusive), severity_m (null for a gap that has
         no second edge), confidence, reason; of an animation's joint that turns wrongly also severity_deg
changes  a list, as the changes file holds it (see mocapfix.changes): what was done, interval by interval
subject  null, or marker_set, frames (calibrated from), bones_m (joint: length to its parent), spread_m (marker: strays)
solve    null, or marker_residual_mm (mean, p95, by_marker), joint_deviation_mm (joint: mean, p95 of its predicted standard
         deviation per axis), start (the way to each frame's first pose), prior (null, or name, scale: what could be asked of
         lost limbs), iterations_mean, status (sentence: frames)
fill     missing_before, filled (estimated where nothing was under the right label), mended (faulty samples estimated),
         relabelled (measured samples that were another label's), left_empty, left (a list: marker, first, last, reason)
seconds  per stage, and total
notes    sentences on anything else a technician should know
"""

from collections import Counter
from collections.abc import Collection

import numpy as np

from mocapfix.animation import Animation
from mocapfix.changes import UnfilledRun
from mocapfix.faults import Faults
from mocapfix.motion import STATUS_TEXTS, Motion
from mocapfix.subject import Subject
from mocapfix.take import Take


def build_take_section(take: Take, marker_set: str | None) -> dict:
    """-> the record's `take`."""
    return {
        "file": take.path.name if take.path else take.name,
        **({"person": take.subject_name} if take.subject_name else {}),
        "frames": take.frame_count,
        "first_frame": take.first_frame,
        "rate_hz": take.rate,
        "markers": len(take.labels),
        "marker_set": marker_set,
        "labels": list(take.labels),
        **({"animation": True} if isinstance(take.layout, Animation) else {}),
    }


def build_fault_entries(take: Take, faults: Faults) -> list[dict]:
    """-> the record's `faults`."""
    return [
        {
            "kind": fault.kind,
            "marker": take.get_label(fault.marker),
            "first": take.get_frame_number(fault.first),
            "last": take.get_frame_number(fault.last),
            "severity_m": _round_or_none(fault.severity, 5) if fault.severity_unit == "m" else None,
            **({"severity_deg": _round_or_none(np.degrees(fault.severity), 2)} if fault.severity_unit == "rad" else {}),
            "confidence": round(fault.confidence, 3),
            "reason": fault.reason,
        }
        for fault in faults.items
    ]


def _round_or_none(value: float, digits: int) -> float | None:
    return None if np.isnan(value) else round(float(value), digits)


def build_inspection_report(take: Take, marker_set: str | None, fault_take: Take, faults: Faults, notes: list[str]) -> dict:
    """-> what is known of a take that is only looked at: the record's `take`, `faults` (of `shown`) and `notes`."""
    return {"take": build_take_section(take, marker_set), "faults": build_fault_entries(fault_take, faults), "notes": notes}


def build_subject_section(subject: Subject) -> dict:
    """-> the record's `subject`."""
    lengths = np.linalg.norm(subject.skeleton.offsets, axis=1)
    return {
        "marker_set": subject.marker_set,
        "frames": subject.frame_count,
        "bones_m": {name: round(float(x), 4) for name, x in zip(subject.skeleton.names, lengths, strict=True) if x > 0},
        "spread_m": {label: round(float(x), 4) for label, x in zip(subject.labels, subject.marker_spread, strict=True)},
    }


def build_solve_section(
    take: Take, subject: Subject, motion: Motion, residual_m: np.ndarray, prior_name: str, prior_scale: float, start_name: str
) -> dict:
    """-> the record's `solve`. error (T, M) metres: seen and believed markers from the body, NaN elsewhere.

    prior  the trained prior that could be asked, "none" for none; scale, times its standard deviations
    start  the way to each frame's first pose
    """
    there = np.flatnonzero(~np.isnan(residual_m).all(0))
    twice = {label for label, count in Counter(take.labels).items() if count > 1}
    names = [f"{label} #{m + 1}" if label in twice else label for m, label in enumerate(take.labels)]
    return {
        "marker_residual_mm": {
            **_summarise_errors(residual_m),
            "by_marker": {names[m]: _summarise_errors(residual_m[:, m]) for m in there},
        },
        "joint_deviation_mm": {
            name: _summarise_errors(deviation) for name, deviation in zip(subject.skeleton.names, motion.joint_sd.T, strict=True)
        },
        "start": start_name,
        "prior": None if prior_name == "none" else {"name": prior_name, "scale": prior_scale},
        "iterations_mean": round(float(motion.iterations.mean()), 2),
        "status": {STATUS_TEXTS[code]: count for code, count in sorted(Counter(motion.status.tolist()).items())},
    }


def _summarise_errors(error_m: np.ndarray) -> dict:
    known = error_m[~np.isnan(error_m)] * 1e3
    if len(known) == 0:
        return {"mean": None, "p95": None}
    return {"mean": round(float(known.mean()), 3), "p95": round(float(np.percentile(known, 95)), 3)}


def build_fill_section(
    input_take: Take,
    relabelled_take: Take,
    cleaned_take: Take,
    unfilled_runs: tuple[UnfilledRun, ...],
    fragment_donors: Collection[int] = (),
) -> dict:
    """-> the record's `fill`.

    before, labelled, after  the take as it was read, with its labels right, and mended
    donors  markers whose labels only name pieces of others, and which do not count
    """
    counts = np.ones(len(input_take.labels), bool)
    counts[list(fragment_donors)] = False
    estimated = np.zeros(input_take.visible.shape, bool) if cleaned_take.sample_sd is None else ~np.isnan(cleaned_take.sample_sd)
    there = relabelled_take.visible
    return {
        "missing_before": int((~input_take.visible & counts).sum()),
        "filled": int((estimated & ~there & counts).sum()),
        "mended": int((estimated & there & counts).sum()),
        "relabelled": int(
            (cleaned_take.visible & ~estimated & (cleaned_take.source_points != input_take.source_points) & counts).sum()
        ),
        "left_empty": int((~cleaned_take.visible & counts).sum()),
        "left": [
            {
                "marker": input_take.labels[each.marker],
                "first": input_take.get_frame_number(each.first),
                "last": input_take.get_frame_number(each.last),
                "reason": each.reason,
            }
            for each in unfilled_runs
            if counts[each.marker]
        ],
    }
