"""The figures of one subject in a cleaned take, which its record keeps and the session page shows."""

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt

from mocapfix.files.yaml_models import StrictModel

if TYPE_CHECKING:
    from mocapfix.result import CleaningResult

AXIS_COUNT = 3
"""axes of a position, whose errors are alike: the predicted distance error is the root of their sum of squares"""


class SubjectFigures(StrictModel):
    """What a cleaning found and did on one subject of a take.

    subject                   name of the subject; "" if the file has only one
    marker_set                name of the marker set; None without a body
    sample_count              samples of all markers in all frames
    fault_counts              number of faults by kind
    worst_predicted_error_mm  greatest predicted distance error of a filled or replaced sample; None without any
    worst_frame               frame of that sample, else the one with the most empty or corrected ones; the file's frame number
    residual_mm               mean distance of the markers from the body; None without a body
    picture_svg               small drawing of that frame for the session page
    laboratory                what suggests that the take is that of a laboratory; "" if nothing does
    notes                     sentences of the report on what else needs attention
    """

    subject: str = ""
    marker_set: str | None = None
    frame_count: NonNegativeInt = 0
    rate_hz: NonNegativeFloat = 0.0
    duration_s: NonNegativeFloat = 0.0
    sample_count: NonNegativeInt = 0
    missing_before: NonNegativeInt = 0
    filled: NonNegativeInt = 0
    left_empty: NonNegativeInt = 0
    replaced: NonNegativeInt = 0
    relabelled: NonNegativeInt = 0
    fault_counts: dict[str, NonNegativeInt] = Field(default_factory=dict)
    worst_predicted_error_mm: NonNegativeFloat | None = None
    worst_frame: int | None = None
    residual_mm: NonNegativeFloat | None = None
    picture_svg: str = ""
    laboratory: str = ""
    notes: tuple[str, ...] = ()


def measure_result(result: "CleaningResult") -> list[SubjectFigures]:
    """Return the figures of each subject of a cleaned take or animation."""
    return [measure_subject(each) for each in result.subject_results or (result,)]


def measure_subject(result: "CleaningResult") -> SubjectFigures:
    """Return the figures of a take of at most one subject, with the picture of its worst moment."""
    # Drawing needs the solver's kernels; what reads records does not.
    from mocapfix.batch.worst_picture import draw_worst_moment, find_worst_moment

    report, take = result.subject_report, result.input_take
    fill, solve = report["fill"], report["solve"]
    frame = find_worst_moment(result) if take.visible.size else None
    return SubjectFigures(
        subject=take.subject_name,
        marker_set=report["take"]["marker_set"],
        frame_count=take.frame_count,
        rate_hz=take.rate,
        duration_s=round(take.frame_count / take.rate, 3),
        sample_count=take.visible.size,
        missing_before=fill["missing_before"],
        filled=fill["filled"],
        left_empty=fill["left_empty"],
        replaced=fill["replaced"],
        relabelled=fill["relabelled"],
        fault_counts=dict(Counter(entry["kind"] for entry in report["faults"])),
        worst_predicted_error_mm=_compute_worst_error_mm(result),
        worst_frame=None if frame is None else take.get_frame_number(frame),
        residual_mm=solve["marker_residual_mm"]["mean"] if solve else None,
        picture_svg="" if frame is None else draw_worst_moment(result, frame),
        laboratory=report["take"].get("laboratory", ""),
        notes=tuple(report["notes"]),
    )


def _compute_worst_error_mm(result: "CleaningResult") -> float | None:
    sample_sd = result.take.sample_sd
    known = np.zeros(0) if sample_sd is None else sample_sd[np.isfinite(sample_sd)]
    return round(float(AXIS_COUNT**0.5 * known.max()) * 1e3, 1) if known.size else None
