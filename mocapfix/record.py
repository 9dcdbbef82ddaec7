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
from mocapfix.faults import Faults
from mocapfix.left import Left
from mocapfix.motion import STATUS, Motion
from mocapfix.subject import Subject
from mocapfix.take import Take


def of_take(take: Take, marker_set: str | None) -> dict:
    """-> the record's `take`."""
    return {
        "file": take.path.name if take.path else take.name,
        **({"person": take.person} if take.person else {}),
        "frames": take.frames,
        "first_frame": take.first_frame,
        "rate_hz": take.rate,
        "markers": len(take.labels),
        "marker_set": marker_set,
        "labels": list(take.labels),
        **({"animation": True} if isinstance(take.layout, Animation) else {}),
    }


def of_faults(take: Take, faults: Faults) -> list[dict]:
    """-> the record's `faults`."""
    return [
        {
            "kind": fault.kind,
            "marker": take.label(fault.marker),
            "first": take.frame_number(fault.first),
            "last": take.frame_number(fault.last),
            "severity_m": _rounded(fault.severity, 5) if fault.unit == "m" else None,
            **({"severity_deg": _rounded(np.degrees(fault.severity), 2)} if fault.unit == "rad" else {}),
            "confidence": round(fault.confidence, 3),
            "reason": fault.reason,
        }
        for fault in faults.items
    ]


def _rounded(value: float, digits: int) -> float | None:
    return None if np.isnan(value) else round(float(value), digits)


def of_inspection(take: Take, marker_set: str | None, shown: Take, faults: Faults, notes: list[str]) -> dict:
    """-> what is known of a take that is only looked at: the record's `take`, `faults` (of `shown`) and `notes`."""
    return {"take": of_take(take, marker_set), "faults": of_faults(shown, faults), "notes": notes}


def of_subject(subject: Subject) -> dict:
    """-> the record's `subject`."""
    lengths = np.linalg.norm(subject.skeleton.offsets, axis=1)
    return {
        "marker_set": subject.marker_set,
        "frames": subject.frames,
        "bones_m": {name: round(float(x), 4) for name, x in zip(subject.skeleton.names, lengths, strict=True) if x > 0},
        "spread_m": {label: round(float(x), 4) for label, x in zip(subject.labels, subject.spread, strict=True)},
    }


def of_solve(take: Take, subject: Subject, motion: Motion, error: np.ndarray, prior: str, scale: float, start: str) -> dict:
    """-> the record's `solve`. error (T, M) metres: seen and believed markers from the body, NaN elsewhere.

    prior  the trained prior that could be asked, "none" for none; scale, times its standard deviations
    start  the way to each frame's first pose
    """
    there = np.flatnonzero(~np.isnan(error).all(0))
    twice = {label for label, count in Counter(take.labels).items() if count > 1}
    names = [f"{label} #{m + 1}" if label in twice else label for m, label in enumerate(take.labels)]
    return {
        "marker_residual_mm": {
            **_spread(error),
            "by_marker": {names[m]: _spread(error[:, m]) for m in there},
        },
        "joint_deviation_mm": {
            name: _spread(deviation) for name, deviation in zip(subject.skeleton.names, motion.joint_deviation.T, strict=True)
        },
        "start": start,
        "prior": None if prior == "none" else {"name": prior, "scale": scale},
        "iterations_mean": round(float(motion.iterations.mean()), 2),
        "status": {STATUS[code]: count for code, count in sorted(Counter(motion.status.tolist()).items())},
    }


def _spread(error: np.ndarray) -> dict:
    known = error[~np.isnan(error)] * 1e3
    if len(known) == 0:
        return {"mean": None, "p95": None}
    return {"mean": round(float(known.mean()), 3), "p95": round(float(np.percentile(known, 95)), 3)}


def of_fill(before: Take, labelled: Take, after: Take, left: tuple[Left, ...], donors: Collection[int] = ()) -> dict:
    """-> the record's `fill`.

    before, labelled, after  the take as it was read, with its labels right, and mended
    donors  markers whose labels only name pieces of others, and which do not count
    """
    counts = np.ones(len(before.labels), bool)
    counts[list(donors)] = False
    estimated = np.zeros(before.seen.shape, bool) if after.deviation is None else ~np.isnan(after.deviation)
    there = labelled.seen
    return {
        "missing_before": int((~before.seen & counts).sum()),
        "filled": int((estimated & ~there & counts).sum()),
        "mended": int((estimated & there & counts).sum()),
        "relabelled": int((after.seen & ~estimated & (after.sources != before.sources) & counts).sum()),
        "left_empty": int((~after.seen & counts).sum()),
        "left": [
            {
                "marker": before.labels[each.marker],
                "first": before.frame_number(each.first),
                "last": before.frame_number(each.last),
                "reason": each.reason,
            }
            for each in left
            if counts[each.marker]
        ],
    }
