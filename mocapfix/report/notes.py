"""Notes of a report: sentences on unobserved joints, unassigned markers, large residuals and uncertain fills."""

from collections.abc import Collection

import numpy as np
from jaxtyping import Float, Int

from mocapfix.faults import EXTERNAL_FILL_KINDS, REPLACED_SAMPLE_KINDS
from mocapfix.repair import MarkerEpochs
from mocapfix.report.terms import MARKER_TERMS, PointTerms
from mocapfix.state import BodyFit, DetectionState
from mocapfix.stats.sequences import find_runs
from mocapfix.subject import Subject
from mocapfix.take import Take

MAX_RELIABLE_FILL_SD_M = 0.06  # per axis; fills with a larger predicted standard deviation are listed
MIN_STRAY_DISTANCE_M = 0.1  # from the body; a marker this far for MIN_STRAY_DURATION_S is reported with its frames
MIN_STRAY_DURATION_S = 0.05
MAX_IMPORTED_FILL_DISTANCE_M = 0.02  # from the body; compared with the median over the fill of another program
MISLABELLED_MARKER_DISTANCE_M = 0.06  # from the body; a marker farther away in most of its frames probably has a wrong label
MISLABELLED_MARKER_SHARE = 0.5  # share of a marker's frames that counts as most


def build_body_notes(
    detection: DetectionState, epochs: MarkerEpochs, body: BodyFit, residual_m: Float[np.ndarray, "T M"]
) -> list[str]:
    """Return the notes on where the body fits poorly or is unknown.

    residual_m  distance of each inlier marker from the body in metres, NaN for other samples
    """
    columns = body.marker_columns
    marker_set_take = epochs.take.select(columns, epochs.split_mask(detection.inlier_take.visible))
    return [
        *describe_unobserved_joints(marker_set_take, body.extended_subject),
        *describe_unassigned_markers(detection.take, epochs.column_marker[columns[columns >= 0]], detection.donor_markers),
        *describe_stray_markers(detection.take, residual_m),
        *describe_imported_fills(detection, residual_m),
    ]


def describe_unobserved_joints(marker_set_take: Take, subject: Subject) -> list[str]:
    """Return a note on the joints whose markers are never visible; `marker_set_take` has the markers of the subject."""
    observed = set(subject.joints[marker_set_take.visible.any(0)].tolist())
    names = [subject.skeleton.names[j] for j in dict.fromkeys(subject.joints.tolist()) if j not in observed]
    return [f"No visible marker on {', '.join(names)}: the mean pose is used there."] if names else []


def describe_unassigned_markers(take: Take, columns: Int[np.ndarray, " K"], fragment_donors: Collection[int] = ()) -> list[str]:
    """Return a note on the markers that are not in the marker set.

    columns          markers of the solved subject
    fragment_donors  markers whose samples are fragments of other markers; they are not listed
    """
    unassigned = [label for m, label in enumerate(take.labels) if m not in columns and m not in fragment_donors]
    if not unassigned:
        return []
    prefixes = {take.labels[m].rpartition(":")[0] for m in columns} - {""}
    solved = f"The solved subject is {', '.join(sorted(prefixes))}. " if prefixes else ""
    return [f"{solved}Not in its marker set, filled without the skeleton: {', '.join(unassigned)}."]


def describe_stray_markers(take: Take, residual_m: Float[np.ndarray, "T M"]) -> list[str]:
    """Return notes on markers far from the body: in most frames, or in intervals in which labels may be swapped."""
    notes: list[str] = []
    for m in np.flatnonzero((residual_m > MISLABELLED_MARKER_DISTANCE_M).any(0)):
        compared = ~np.isnan(residual_m[:, m])
        if (residual_m[:, m] > MISLABELLED_MARKER_DISTANCE_M).sum() > MISLABELLED_MARKER_SHARE * compared.sum():
            distance = _format_mm(MISLABELLED_MARKER_DISTANCE_M)
            notes.append(f"{take.labels[m]} is more than {distance} from the body in most of its frames; check its label.")
            continue
        for first, last in find_runs(residual_m[:, m] > MIN_STRAY_DISTANCE_M):
            if (last - first + 1) / take.rate >= MIN_STRAY_DURATION_S:
                frames = f"frames {take.get_frame_number(first)} to {take.get_frame_number(last)}"
                distance = _format_mm(float(np.median(residual_m[first : last + 1, m])))
                notes.append(f"{take.labels[m]}, {frames}: {distance} from the body, left unchanged; check for swapped labels.")
    return notes


def describe_imported_fills(detection: DetectionState, residual_m: Float[np.ndarray, "T M"]) -> list[str]:
    """Return a note on fills of other programs that are far from the body and were left unchanged."""
    fills = detection.sample_faults.select_kinds(*EXTERNAL_FILL_KINDS)
    distances = [(float(np.median(residual_m[fill.frame_slice, fill.marker])), fill) for fill in fills]
    far = [(distance, fault) for distance, fault in distances if distance > MAX_IMPORTED_FILL_DISTANCE_M]
    if detection.replaced_kinds != REPLACED_SAMPLE_KINDS or not far:
        return []
    distance, worst = max(far, key=lambda pair: pair[0])
    first, last = (detection.take.get_frame_number(frame) for frame in (worst.first, worst.last))
    farthest = f"{detection.take.labels[worst.marker]}, frames {first} to {last}, {_format_mm(distance)}"
    return [
        f"{len(far)} of {len(fills)} fills by another program are more than {_format_mm(MAX_IMPORTED_FILL_DISTANCE_M)} "
        f"from the body (the farthest: {farthest}) and are left unchanged; --refill replaces them."
    ]


def describe_uncertain_fills(cleaned_take: Take, terms: PointTerms = MARKER_TERMS) -> list[str]:
    """Return a note on fills with a large predicted standard deviation; no note without any."""
    if cleaned_take.sample_sd is None:
        return []
    uncertain = cleaned_take.sample_sd > MAX_RELIABLE_FILL_SD_M
    if not uncertain.any():
        return []
    labels = ", ".join(cleaned_take.labels[m] for m in np.flatnonzero(uncertain.any(0)))
    limit = f"a predicted standard deviation above {_format_mm(MAX_RELIABLE_FILL_SD_M)}"
    return [f"{uncertain.sum()} filled {terms.samples} are unreliable, with {limit}: {labels}."]


def _format_mm(distance_m: float) -> str:
    return f"{distance_m * 1e3:.0f} mm"
