"""Notes: sentences on what else a technician should know of a cleaned take."""

from collections.abc import Collection

import numpy as np

from mocapfix.faults import OTHERS_FILLS, REPLACED
from mocapfix.looks import Looked
from mocapfix.mend import Parts
from mocapfix.solved import Solved
from mocapfix.subject import Subject
from mocapfix.take import Take, runs
from mocapfix.words import worded

GUESS = 0.06  # metres per axis: a fill less sure than this is named
ASTRAY, STAYS = 0.1, 0.05  # metres and seconds: a marker so far from the body for so long is worth a look
OFF = 0.02  # metres: another program's fill so far from the body is worth a look
FAR = 0.06  # metres: a marker that lies farther from the body most of the time is hardly the marker it is labelled


def of_body(looked: Looked, parts: Parts, body: Solved, error: np.ndarray) -> list[str]:
    """-> notes on where the body fits badly or is not known. error (T, M) metres: each believed marker's distance from it."""
    worn = parts.take.worn(body.columns, parts.split(looked.believed.seen))
    return [
        *unmarked(worn, body.worn),
        *other_markers(looked.take, parts.marker[body.columns[body.columns >= 0]], looked.donors),
        *strays(looked.take, error),
        *others_fills(looked, error),
    ]


def unmarked(worn: Take, subject: Subject) -> list[str]:
    """-> a note on the joints whose markers the take never shows."""
    shown = set(subject.joints[worn.seen.any(0)].tolist())
    names = [subject.skeleton.names[j] for j in dict.fromkeys(subject.joints.tolist()) if j not in shown]
    return [f"No marker of {', '.join(names)} is in the take: there the pose is people's mean pose."] if names else []


def other_markers(take: Take, columns: np.ndarray, donors: Collection[int] = ()) -> list[str]:
    """-> a note on the markers that are not the solved person's, whose are at `columns` (K,), nor pieces of others (donors)."""
    others = [label for m, label in enumerate(take.labels) if m not in columns and m not in donors]
    whose = {take.labels[m].rpartition(":")[0] for m in columns} - {""}
    who = f"The body is {', '.join(sorted(whose))}'s. " if whose and others else ""
    return [f"{who}Not of its marker set, so filled only from how markers move together: {', '.join(others)}."] if others else []


def strays(take: Take, error: np.ndarray) -> list[str]:
    """-> notes on markers that lie far from the body: all along, or over the frames where labels may have been swapped."""
    notes = []
    for m in np.flatnonzero((error > FAR).any(0)):
        seen = ~np.isnan(error[:, m])
        if (error[:, m] > FAR).sum() > 0.5 * seen.sum():
            far = f"more than {FAR * 1e3:.0f} mm from the body for half the take"
            notes.append(f"{take.labels[m]} lies {far}: is it labelled right?")
            continue
        for first, last in runs(error[:, m] > ASTRAY):
            if (last - first + 1) / take.rate >= STAYS:
                frames = f"frames {take.frame_number(first)} to {take.frame_number(last)}"
                off = f"{np.median(error[first : last + 1, m]) * 1e3:.0f} mm from the body"
                notes.append(f"{take.labels[m]}, {frames}: lies {off} and was kept; look for swapped labels.")
    return notes


def others_fills(looked: Looked, error: np.ndarray) -> list[str]:
    """-> a note on other programs' fills that lie off the body and were kept."""
    off = [(float(np.median(error[f.frames, f.marker])), f) for f in looked.samples.of(*OTHERS_FILLS)]
    far = [(distance, fault) for distance, fault in off if distance > OFF]
    if looked.replaced != REPLACED or not far:
        return []
    distance, worst = max(far, key=lambda pair: pair[0])
    first, last = (looked.take.frame_number(frame) for frame in (worst.first, worst.last))
    farthest = f"{looked.take.labels[worst.marker]}, frames {first} to {last}, {distance * 1e3:.0f} mm"
    return [
        f"{len(far)} of {len(off)} stretches that another program filled lie more than {OFF * 1e3:.0f} mm from the body "
        f"(the farthest: {farthest}) and were kept; --refill replaces such."
    ]


def guesses(after: Take) -> list[str]:
    """-> a note on filled samples that are hardly more than guesses, none where all are better."""
    poor = np.zeros(after.seen.shape, bool) if after.deviation is None else after.deviation > GUESS
    if not poor.any():
        return []
    labels = ", ".join(after.labels[m] for m in np.flatnonzero(poor.any(0)))
    what, worse = worded("filled samples", after), f"with a predicted error above {GUESS * 1e3:.0f} mm"
    return [f"{poor.sum()} {what} are hardly more than guesses, {worse}: {labels}."]
