"""The figures of one subject in a cleaned take, which its record keeps and the session page shows."""

from pydantic import Field, NonNegativeFloat, NonNegativeInt

from mocapfix.files.yaml_models import StrictModel


class SubjectFigures(StrictModel):
    """What a cleaning found and did on one subject of a take.

    subject                   name of the subject; "" if the file has only one
    marker_set                name of the marker set; None without a body
    sample_count              samples of all markers in all frames
    fault_counts              number of faults by kind
    worst_predicted_error_mm  greatest predicted standard deviation of a filled sample; None if none was filled
    worst_frame               frame of that sample, or with the most missing samples; frame number of the file
    residual_mm               mean distance of the markers from the body; None without a body
    picture_svg               small drawing of that frame
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
    notes: tuple[str, ...] = ()
