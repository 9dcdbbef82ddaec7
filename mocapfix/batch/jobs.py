"""What the children of a batch's workers do: clean a take, and write its record.

The record has a small picture of the worst moment of a take: the body and the markers in one frame, the lost ones marked. It is
drawn by the style sheet of the session page. The coordinates are whole centimetres and the markers of one state are one path, so
that a picture takes about one kilobyte and a page can have thousands.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.batch import records
from mocapfix.batch.child_process import JobLimits, JobOutcome, measure_peak_memory_mb, run_in_child
from mocapfix.errors import MocapfixError, SceneError, WriteError, join_names
from mocapfix.io.changes_file import CHANGES_SUFFIX, read_changes_model
from mocapfix.io.shipped import get_version
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.report.sample_states import SampleOutcome, find_estimated_samples
from mocapfix.report.stick_figures import MAX_DRAWN_MARKERS, fit_figure_view, select_shown_body, trace_bones, trace_markers
from mocapfix.result import CleaningResult
from mocapfix.solve.kinematics import predict_markers

CLEAN_FUNCTION = "mocapfix.batch.jobs:clean_recorded_take"
LOADING_DURATION_S, LOADING_RATE_HZ = 1.0, 30.0  # of the composed take that is cleaned once in each child
MAX_LOST_ATTEMPTS = 10  # attempts after which no record was written, because the worker or its computer was lost


@dataclass(frozen=True)
class CleanRequest:
    """A take to be cleaned."""

    take: str  # id of the take
    path: Path  # input file
    output_folder: Path  # folder of the batch
    options: CleanOptions  # with the subject of the take, if it is known
    # for the record: the subject files among the options, by subject, relative to the batch's folder
    subject_files: tuple[tuple[str, str], ...] = ()


def find_current_record(request: CleanRequest, *, repeat_failed: bool = False) -> records.TakeRecord | None:
    """Return the record of a take if it need not be cleaned: input, options and version agree, and all outputs exist."""
    record = records.read_record(records.get_record_path(request.output_folder, request.take))
    if record is None or record.version != get_version() or record.options_sha256 != records.hash_options(request.options):
        return None
    if record.status == "failed":
        return None if repeat_failed or record.input_sha256 != try_to_hash(request.path) else record
    if not all((request.output_folder / path).is_file() for path in record.outputs.values()):
        return None
    return record if record.input_sha256 == try_to_hash(request.path) else None


def try_to_hash(path: Path) -> str:
    """Return the hash of a file, "" if it cannot be read."""
    try:
        return records.hash_file(path)
    except OSError:
        return ""


def run_with_retries(function: str, request: object, limits: JobLimits) -> JobOutcome:
    """Run a function ("module:name") on a request in a child process; one that crashes is repeated `limits.retries` times."""
    outcome = run_in_child(function, {"request": request}, limits)
    for _ in range(limits.retries):
        if outcome.status == "crash":
            outcome = run_in_child(function, {"request": request}, limits)
    return outcome


def clean_take(request: CleanRequest, limits: JobLimits, function: str = CLEAN_FUNCTION) -> records.TakeRecord:
    """Clean a take in a child process within limits, and return its record. Run by a worker.

    The record of a take that failed is written here, that of one that is done by the child.
    """
    started = format_now()
    outcome = run_with_retries(function, request, limits)
    if isinstance(outcome.value, records.TakeRecord):
        return outcome.value
    try:
        return write_failure(request, outcome, started)
    except MocapfixError as error:  # there is no place for a record: the folder was removed, or the disk is full
        return build_failed_record(request, replace(outcome, status="error", error=str(error)), started, 1)


def clean_recorded_take(request: CleanRequest) -> records.TakeRecord:
    """Clean a take, write its outputs and its record, and return the record. Run in a child.

    A record that another process wrote after this job was given out is returned as it is. Raises MocapfixError.
    """
    from mocapfix.model.stage_timer import omit_stage_times

    started, start = format_now(), time.monotonic()
    with records.hold_take(request.output_folder, request.take) as attempts:
        found = find_current_record(request)
        if found and found.status == "done":
            return found
        input_sha256 = try_to_hash(request.path)  # before reading: a file that changes later is cleaned again
        key = build_attempt_key(request)
        if attempts.count(key) >= MAX_LOST_ATTEMPTS:
            raise MocapfixError(
                f"{request.path}: was begun {MAX_LOST_ATTEMPTS} times, and the worker or its computer was lost each time."
            )
        count = attempts.begin(key)
        folder = records.get_take_folder(request.output_folder, request.take)
        with omit_stage_times():
            result, notes = clean_with_decisions(request, input_sha256)
            outputs = result.write(folder, overwrite=True, options=request.options.output)
        for each in result.subject_results or (result,):
            for problem in each.describe_missing_outputs(folder, request.options.output):
                raise WriteError(problem)
        first, *others = measure_result(result)
        record = build_record(
            request,
            input_sha256=input_sha256,
            status="done",
            attempts=count,
            seconds=round(time.monotonic() - start, 3),
            peak_memory_mb=round(measure_peak_memory_mb(), 1),
            outputs={suffix: path.relative_to(request.output_folder).as_posix() for suffix, path in outputs.items()},
            subjects=(first.model_copy(update={"notes": (*notes, *first.notes)}), *others),
            started=started,
        )
        records.write_record(request.output_folder, record)
        attempts.clear()
    return record


def clean_with_decisions(request: CleanRequest, input_sha256: str) -> tuple[Any, list[str]]:
    """Clean a take with the decisions of the cleaning before; return the result, and sentences on decisions that are not used.

    These were made for another input, or do not fit the subjects, markers or frames that the options select now. Their files
    get another name, so that the new ones do not replace them. Raises MocapfixError; the files keep their names then.
    """
    from mocapfix import pipeline

    record, folder = records.read_record(records.get_record_path(request.output_folder, request.take)), request.output_folder
    paths = records.get_take_folder(folder, request.take).glob(f"*.{CHANGES_SUFFIX}")
    models = {path: read_changes_model(path) for path in sorted(paths)}
    files = [path for path, file in models.items() if file.corrections or any(x.reviewed or x.note for x in file.changes)]
    is_same_input = record is not None and bool(record.outputs) and record.input_sha256 == input_sha256
    reasons = {} if is_same_input else dict.fromkeys(files, "It is not known that they were made for this input.")
    while True:
        used = (*request.options.review.review_files, *(path for path in files if path not in reasons))
        try:
            result = pipeline.clean(request.path, request.options.change(review_files=used) if used else request.options)
            break
        except SceneError as error:
            text, known = str(error), len(reasons)
            reasons |= {path: text.removeprefix(f"{path}: ") for path in files if text.startswith(f"{path}: ")}
            if len(reasons) == known:
                raise
    return result, [_set_aside(path, reason) for path, reason in reasons.items()]


def _set_aside(path: Path, reason: str) -> str:
    """Give a changes file a name of those that are free, and return the sentences on it."""
    target, before = path.with_suffix(f".earlier{path.suffix}"), list[str]()
    while target.exists():
        before.append(target.name)
        target = path.with_suffix(f".earlier-{len(before) + 1}{path.suffix}")
    text = f"The decisions of an earlier cleaning, now in {path.replace(target).name}, are not used. {reason}"
    return f"{text} Those set aside before stay in {join_names(before)}." if before else text


def write_failure(request: CleanRequest, outcome: JobOutcome, started: str) -> records.TakeRecord:
    """Write and return the record of a take that failed. One that another process has done is not replaced. Raises WriteError."""
    with records.hold_take(request.output_folder, request.take) as attempts:
        found = find_current_record(request)
        if found and found.status == "done":
            return found
        record = build_failed_record(request, outcome, started, max(1, attempts.count(build_attempt_key(request))))
        records.write_record(request.output_folder, record)
        attempts.clear()
    return record


def build_failed_record(request: CleanRequest, outcome: JobOutcome, started: str, attempts: int) -> records.TakeRecord:
    before = records.read_record(records.get_record_path(request.output_folder, request.take))
    input_sha256 = try_to_hash(request.path)
    return build_record(
        request,
        input_sha256=input_sha256,
        outputs=before.outputs if before and before.input_sha256 == input_sha256 else {},
        status="failed",
        reason=outcome.status if outcome.status in get_args(records.FailureReason) else "error",
        error=outcome.error if request.path.name in outcome.error else f"{request.path}: {outcome.error}",
        attempts=attempts,
        seconds=round(outcome.seconds, 3),
        peak_memory_mb=round(outcome.peak_memory_mb, 1),
        started=started,
    )


def build_record(request: CleanRequest, **fields: Any) -> records.TakeRecord:
    """Return a record with the fields that follow from the request, and others."""
    return records.TakeRecord(
        take=request.take,
        input=str(request.path),
        options_sha256=records.hash_options(request.options),
        version=get_version(),
        subject_files=dict(request.subject_files),
        finished=format_now(),
        **fields,
    )


def build_attempt_key(request: CleanRequest) -> str:
    """Return what identifies attempts with the same input, options and version."""
    return f"{try_to_hash(request.path)[:16]} {records.hash_options(request.options)[:16]} {get_version()}"


def format_now() -> str:
    """Return the time in ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def load_everything() -> None:
    """Compile the kernels unless this was done on this machine, and load what cleaning needs by cleaning a short composed take.

    Run in a child before its first job, whose limit of time is for the job alone.
    """
    from mocapfix import pipeline
    from mocapfix.kernels.compilation import is_precompiled, precompile_kernels
    from mocapfix.synthetic import compose_take, write_synthetic_take

    if not is_precompiled():
        precompile_kernels(lambda done, total: None)
    with TemporaryDirectory(prefix="mocapfix-") as folder:
        path = Path(folder) / "take.c3d"
        write_synthetic_take(path, compose_take(seconds=LOADING_DURATION_S, rate=LOADING_RATE_HZ))
        pipeline.clean(path).write(Path(folder) / "out")


def measure_result(result: CleaningResult) -> list[records.SubjectFigures]:
    """Return the figures of each subject of a cleaned take or animation."""
    return [measure_subject(each) for each in result.subject_results or (result,)]


def measure_subject(result: CleaningResult) -> records.SubjectFigures:
    """Return the figures of a take of at most one subject, with the picture of its worst moment."""
    report, take = result.subject_report, result.input_take
    fill, solve = report["fill"], report["solve"]
    frame, worst = result.comparison.worst_moment if take.visible.size else (None, None)
    return records.SubjectFigures(
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
