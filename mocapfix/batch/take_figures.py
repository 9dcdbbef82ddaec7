"""The figures of one subject in a cleaned take, which its record keeps and the session page shows.

A small picture of the worst moment of a take: the body and the markers in one frame, the lost ones marked.

It is drawn by the style sheet of the session page. The coordinates are whole centimetres and the markers of one state are one
path, so that a picture takes about one kilobyte and a page can have thousands.
"""

from collections import Counter
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.batch.records import SubjectFigures
from mocapfix.model.take import Take
from mocapfix.report.sample_states import SampleOutcome, find_estimated_samples
from mocapfix.report.stick_figures import MAX_DRAWN_MARKERS, fit_figure_view, select_shown_body, trace_bones, trace_markers
from mocapfix.result import CleaningResult
from mocapfix.solve.kinematics import predict_markers


def measure_result(result: CleaningResult) -> list[SubjectFigures]:
    """Return the figures of each subject of a cleaned take or animation."""
    return [measure_subject(each) for each in result.subject_results or (result,)]


def measure_subject(result: CleaningResult) -> SubjectFigures:
    """Return the figures of a take of at most one subject, with the picture of its worst moment."""
    report, take = result.subject_report, result.input_take
    fill, solve = report["fill"], report["solve"]
    frame, worst = result.comparison.worst_moment if take.visible.size else (None, None)
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
        worst_predicted_error_mm=worst.predicted_mm if worst else None,
        worst_frame=None if frame is None else take.get_frame_number(frame),
        residual_mm=solve["marker_residual_mm"]["mean"] if solve else None,
        picture_svg="" if frame is None else draw_worst_moment(result, frame),
        laboratory=report["take"].get("laboratory", ""),
        notes=tuple(report["notes"]),
    )


MAX_TITLE_MARKERS = 4  # labels of lost markers in the title of a picture
MAX_TITLE_LABEL_LENGTH = 24  # letters of a label in the title of a picture
CROSS_RADIUS_CM = 3  # half the width of the cross at a marker that stays empty


def draw_worst_moment(result: CleaningResult, frame: int) -> str:
    """Return the SVG of a frame after cleaning; "" if it has neither a marker nor a body.

    Estimated, faulty and empty samples are marked. An empty one is drawn where the body carries its marker.
    """
    comparison, after = result.comparison, result.take
    outcome = comparison.sample_states[frame]
    body = select_shown_body(comparison, frame)
    shown = np.isfinite(after.markers[frame]).all(axis=1)
    if not shown.any() and not len(body):
        return ""
    view = fit_figure_view(comparison, frame, body)
    left, top, width, height = view.box_cm
    position = after.markers[frame].copy()
    if len(body):
        position[~shown] = _predict_positions(result, frame)[~shown]
    estimated, suspect, empty = find_estimated_samples(outcome), outcome == SampleOutcome.SUSPECT, ~shown
    dots = trace_markers(view, after.markers[frame], outcome, digits=0)
    paths = {"bones": trace_bones(view, comparison, frame, digits=0), **{f"dot {label}": path for label, path in dots.items()}}
    content = "".join(f'<path class="{name}" d="{path}"/>' for name, path in paths.items() if path)
    content += _draw_crosses(view.project_known(position[empty]))
    title = describe_moment(after, frame, (("estimated", estimated), ("faulty", suspect), ("empty", empty)))
    box = f"{int(left)} {int(top)} {int(width) + 1} {int(height) + 1}"
    return f'<svg class="moment" viewBox="{box}" role="img"><title>{escape(title)}</title>{content}</svg>'


def describe_moment(take: Take, frame: int, groups: Sequence[tuple[str, Bool[np.ndarray, " M"]]]) -> str:
    """Return a text such as "Frame 120: 2 estimated (LFHD, RFHD)." from the states of the markers in a frame and their masks."""
    parts: list[str] = []
    for state, mask in groups:
        labels = [take.labels[m][-MAX_TITLE_LABEL_LENGTH:] for m in np.flatnonzero(mask)]
        more = ", …" if len(labels) > MAX_TITLE_MARKERS else ""
        parts += [f"{len(labels)} {state} ({', '.join(labels[:MAX_TITLE_MARKERS])}{more})"] if labels else []
    return f"Frame {take.get_frame_number(frame)}: {', '.join(parts) or 'nothing was corrected'}."


def _predict_positions(result: CleaningResult, frame: int) -> Float[np.ndarray, "M 3"]:
    """Return where the body carries the markers in a frame, in metres, NaN for markers that it lacks."""
    position = np.full((len(result.take.labels), 3), np.nan)
    if result.subject is None or result.motion is None or not result.subject.labels:
        return position
    motion = result.motion.select_frames(np.array([frame]))
    predicted = predict_markers(result.subject, (motion.root_position, motion.local_rotations))[0]
    index = {label: k for k, label in enumerate(result.subject.labels)}
    for m, label in enumerate(result.take.bare_labels):
        if (k := index.get(label, index.get(result.take.labels[m]))) is not None:
            position[m] = predicted[k]
    return position


def _draw_crosses(points_cm: Float[np.ndarray, "N 3"]) -> str:
    r = CROSS_RADIUS_CM
    shown = points_cm[:MAX_DRAWN_MARKERS]
    path = "".join(f"M{x - r:.0f} {y - r:.0f}l{2 * r} {2 * r}m0-{2 * r}l-{2 * r} {2 * r}" for x, y, _ in shown)
    return f'<path class="lost" d="{path}"/>' if path else ""
