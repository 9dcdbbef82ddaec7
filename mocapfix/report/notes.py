"""Notes: sentences on what else a technician should know of a cleaned take."""

from collections.abc import Collection

import numpy as np

from mocapfix.detect.loop import DetectionState
from mocapfix.faults import EXTERNAL_FILL_KINDS, REPLACED_SAMPLE_KINDS
from mocapfix.repair import MarkerEpochs
from mocapfix.report.terms import use_joint_terms
from mocapfix.solve.body_fit import BodyFit
from mocapfix.subject import Subject
from mocapfix.take import Take, find_runs

MAX_RELIABLE_FILL_SD_M = 0.06  # metres per axis: a fill less sure than this is named
MIN_STRAY_DISTANCE_M, MIN_STRAY_DURATION_S = (
    0.1,
    0.05,
)  # metres and seconds: a marker so far from the body for so long is worth a look
MAX_IMPORTED_FILL_DISTANCE_M = 0.02  # metres: another program's fill so far from the body is worth a look
MISLABELLED_MARKER_DISTANCE_M = (
    0.06  # metres: a marker that lies farther from the body most of the time is hardly the marker it is labelled
)


def build_body_notes(looked: DetectionState, parts: MarkerEpochs, body: BodyFit, residual_m: np.ndarray) -> list[str]:
    """-> notes on where the body fits badly or is not known. error (T, M) metres: each believed marker's distance from it."""
    worn = parts.take.select(body.marker_columns, parts.split_mask(looked.inlier_take.visible))
    return [
        *describe_unobserved_joints(worn, body.extended_subject),
        *describe_unassigned_markers(
            looked.take, parts.column_marker[body.marker_columns[body.marker_columns >= 0]], looked.donor_markers
        ),
        *describe_stray_markers(looked.take, residual_m),
        *describe_imported_fills(looked, residual_m),
    ]


def describe_unobserved_joints(marker_set_take: Take, subject: Subject) -> list[str]:
    """-> a note on the joints whose markers the take never shows."""
    shown = set(subject.joints[marker_set_take.visible.any(0)].tolist())
    names = [subject.skeleton.names[j] for j in dict.fromkeys(subject.joints.tolist()) if j not in shown]
    return [f"No marker of {', '.join(names)} is in the take: there the pose is people's mean pose."] if names else []


def describe_unassigned_markers(take: Take, columns: np.ndarray, fragment_donors: Collection[int] = ()) -> list[str]:
    """-> a note on the markers that are not the solved person's, whose are at `columns` (K,), nor pieces of others (donors)."""
    others = [label for m, label in enumerate(take.labels) if m not in columns and m not in fragment_donors]
    whose = {take.labels[m].rpartition(":")[0] for m in columns} - {""}
    who = f"The body is {', '.join(sorted(whose))}'s. " if whose and others else ""
    return [f"{who}Not of its marker set, so filled only from how markers move together: {', '.join(others)}."] if others else []


def describe_stray_markers(take: Take, residual_m: np.ndarray) -> list[str]:
    """-> notes on markers that lie far from the body: all along, or over the frames where labels may have been swapped."""
    notes = []
    for m in np.flatnonzero((residual_m > MISLABELLED_MARKER_DISTANCE_M).any(0)):
        seen = ~np.isnan(residual_m[:, m])
        if (residual_m[:, m] > MISLABELLED_MARKER_DISTANCE_M).sum() > 0.5 * seen.sum():
            far = f"more than {MISLABELLED_MARKER_DISTANCE_M * 1e3:.0f} mm from the body for half the take"
            notes.append(f"{take.labels[m]} lies {far}: is it labelled right?")
            continue
        for first, last in find_runs(residual_m[:, m] > MIN_STRAY_DISTANCE_M):
            if (last - first + 1) / take.rate >= MIN_STRAY_DURATION_S:
                frames = f"frames {take.get_frame_number(first)} to {take.get_frame_number(last)}"
                off = f"{np.median(residual_m[first : last + 1, m]) * 1e3:.0f} mm from the body"
                notes.append(f"{take.labels[m]}, {frames}: lies {off} and was kept; look for swapped labels.")
    return notes


def describe_imported_fills(looked: DetectionState, residual_m: np.ndarray) -> list[str]:
    """-> a note on other programs' fills that lie off the body and were kept."""
    off = [
        (float(np.median(residual_m[f.frame_slice, f.marker])), f)
        for f in looked.sample_faults.select_kinds(*EXTERNAL_FILL_KINDS)
    ]
    far = [(distance, fault) for distance, fault in off if distance > MAX_IMPORTED_FILL_DISTANCE_M]
    if looked.replaced_kinds != REPLACED_SAMPLE_KINDS or not far:
        return []
    distance, worst = max(far, key=lambda pair: pair[0])
    first, last = (looked.take.get_frame_number(frame) for frame in (worst.first, worst.last))
    farthest = f"{looked.take.labels[worst.marker]}, frames {first} to {last}, {distance * 1e3:.0f} mm"
    return [
        f"{len(far)} of {len(off)} stretches that another program filled lie more than {MAX_IMPORTED_FILL_DISTANCE_M * 1e3:.0f} mm from the body "
        f"(the farthest: {farthest}) and were kept; --refill replaces such."
    ]


def describe_uncertain_fills(cleaned_take: Take) -> list[str]:
    """-> a note on filled samples that are hardly more than guesses, none where all are better."""
    poor = (
        np.zeros(cleaned_take.visible.shape, bool)
        if cleaned_take.sample_sd is None
        else cleaned_take.sample_sd > MAX_RELIABLE_FILL_SD_M
    )
    if not poor.any():
        return []
    labels = ", ".join(cleaned_take.labels[m] for m in np.flatnonzero(poor.any(0)))
    what, worse = (
        use_joint_terms("filled samples", cleaned_take),
        f"with a predicted error above {MAX_RELIABLE_FILL_SD_M * 1e3:.0f} mm",
    )
    return [f"{poor.sum()} {what} are hardly more than guesses, {worse}: {labels}."]
