"""What `mocapfix clean`, `inspect` and `run` do: clean takes one after the other and summarise what was changed, list the faults
of a take without cleaning it, run a scene, which is a cleaning job or a 2-D keypoint scene.
"""

import json
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from mocapfix.cli import console
from mocapfix.cli.console import print_line, print_note, print_usage_error, show_progress
from mocapfix.errors import MocapfixError, WriteError, describe_error, join_names
from mocapfix.io.files import OUTPUT_FOLDER_SUFFIX, check_outputs_absent
from mocapfix.model.system import count_cores
from mocapfix.options import CleanOptions
from mocapfix.solve.parallel import start_second_process

MAX_LISTED_RUNS = 5  # runs of unfilled samples, or markers with unfilled samples, that the summary lists
MAX_PRINTED_NOTES = 12  # notes that it prints
MAX_LISTED_REASONS = 3  # reasons of unfilled samples that it lists
CLIP_SUFFIXES = (".glb", ".vrm")  # files of characters that hold animations
ANIMATION_SUFFIXES = (".bvh", ".amc", ".asf")  # files without markers, for which few kernels are needed
if TYPE_CHECKING:
    from mocapfix.report.report import FaultEntry, FillSection, InspectionReport, Report, TakeSection


def find_usage_problem(takes: Sequence[Path], options: CleanOptions, clips: Path | None, overwrite: bool) -> str:
    """Return which arguments do not fit together, "" if all do. Raises WriteError if the file of clips exists."""
    if not takes:
        return "clean: name at least one take."
    if options.review.review_files and len(takes) > 1:
        return "--changes is for one take; clean the others separately."
    if options.output != CleanOptions().output:
        from mocapfix.output_formats import list_output_formats

        try:
            list_output_formats(options.output)
        except MocapfixError as error:
            return describe_error(error)
    problem = find_clips_problem(clips, options.output.characters, takes) if clips else ""
    check_outputs_absent([clips] if clips and not problem else [], overwrite)
    return problem


def find_clips_problem(target: Path, characters: Sequence[str | Path], takes: Sequence[Path]) -> str:
    """Return why the motions of all takes cannot be written into one file, "" if they can."""
    if len(characters) != 1:
        return f"--clips {target}: a file of clips is of one character; give exactly one --character."
    if target.suffix.lower() not in CLIP_SUFFIXES:
        return f"--clips {target}: is written as binary glTF; name a file that ends in {' or '.join(CLIP_SUFFIXES)}."
    if target.is_dir() or not target.parent.is_dir():
        return f"--clips {target}: is a folder, or in none that exists; name a file in a folder that exists."
    if target.resolve() in {Path(each).resolve() for each in (*characters, *takes)}:
        return f"--clips {target}: would replace the character or a take; choose another name."
    return ""


def clean_takes(
    takes: Sequence[Path],
    output_folder: Path | None,
    options: CleanOptions,
    *,
    overwrite: bool = False,
    as_json: bool = False,
    clips: Path | None = None,
) -> int:
    """Clean takes one after the other and print a summary of each; a take that fails does not stop the others.

    Returns the exit status.

    Args:
        output_folder: Where the output files go; None for TAKE.mocapfix/ beside each take.
        clips: File for the motions of all takes as animations of the character, if there is one.
    """
    if problem := find_usage_problem(takes, options, clips, overwrite):
        return print_usage_error(problem)
    from mocapfix.io.capture import read_capture
    from mocapfix.model.stage_timer import StageTimer

    reports: list[Report] = []
    clip_paths: list[Path] = []
    written: set[Path] = set()
    laboratory: dict[str, str] = {}
    attempts = console.TakeAttempts()
    is_shared = count_cores() > 1 and not options.initialise.is_fast
    with start_second_process("mocapfix.fill.gap_filling", "mocapfix.report.recording") if is_shared else nullcontext():
        for take in takes:
            with attempts.attempt(take):
                folder = output_folder or choose_output_folder(take)
                if folder / take.stem in written:
                    raise WriteError(f"{take}: another take of this name was written to {folder}; clean it into another folder.")
                with show_progress(take.name, needs_kernels=take.suffix.lower() not in ANIMATION_SUFFIXES) as progress:
                    timer = StageTimer(report_progress=progress)
                    with timer("read"):
                        capture = read_capture(take, options.read, has_windows=True)
                    from mocapfix import pipeline  # after a bad file is refused: this takes longer than reading it
                    from mocapfix.result import check_outputs_free

                    targets = check_outputs_free(folder, take.stem, overwrite, take, options.output)
                    check_files_kept([*takes, *([clips] if clips else [])], targets)
                    result = pipeline.clean_capture(capture, options, timer)
                    result.write(folder, overwrite, progress, options.output)
                written.add(folder / take.stem)
                results = result.subject_results or (result,)
                lacks_body = bool(options.output.characters) and all(each.motion is None for each in results)
                for each in results:
                    outputs = each.get_written_paths(folder, options.output)
                    reports.append(json.loads(outputs["report.json"].read_text(encoding="utf-8")))
                    laboratory[format_take_name(reports[-1]["take"])] = reports[-1]["take"].get("laboratory", "")
                    clip_paths += [path for suffix, path in outputs.items() if suffix.endswith(CLIP_SUFFIXES)]
                    problems = each.describe_missing_outputs(folder, options.output)
                    problems += [note for note in reports[-1]["notes"] if lacks_body and note.endswith(" has no body.")]
                    if not as_json:
                        notes = [note for note in reports[-1]["notes"] if note not in problems]
                        print_summary({**reports[-1], "notes": notes}, outputs, options.subject.subject_prefix)
                    for problem in problems:
                        console.print_error(problem)
                        attempts.failed.append(take)
    if clips and clip_paths:
        with attempts.attempt(clips):
            from mocapfix.characters.character_files import write_clips

            write_clips(clips, clip_paths)
            if not as_json:
                print_line(escape(f"{clips}: {len(clip_paths)} motions as animations of one character."))
    if not as_json and (note := describe_laboratory(laboratory, options)):
        print_line(escape(note))
    if as_json and reports:
        console.print_json(reports if len(takes) > 1 or len(reports) > 1 else reports[0])
    return console.EXIT_FAILED if attempts.failed else console.EXIT_DONE


def choose_output_folder(take: Path) -> Path:
    """Return the output folder TAKE.mocapfix/ beside a take. Raises WriteError if the take is an output itself."""
    folder = take.parent.resolve()
    if folder.suffix == OUTPUT_FOLDER_SUFFIX:
        raise WriteError(
            f"{take}: is an output of mocapfix, since it is in {folder.name}/; clean the original, or name a folder with --out."
        )
    return take.parent / f"{take.stem}{OUTPUT_FOLDER_SUFFIX}"


def check_files_kept(files: Sequence[Path], targets: Sequence[Path]) -> None:
    """Raise WriteError if an output of a take would replace one of the files of the command: its takes, and that of the clips."""
    places = {file.resolve(): file for file in files}
    for target in targets:
        if replaced := places.get(target.resolve()):
            raise WriteError(f"{replaced}: would be replaced by an output; choose another folder with --out.")


def print_summary(report: "Report", outputs: Mapping[str, Path], subject_prefix: str | None = None) -> None:
    """Print in a few lines what a cleaning did."""
    from mocapfix.report.terms import JOINT_TERMS, MARKER_TERMS, format_fault_counts, format_frame_range, format_number

    fill, take, changes = report["fill"], report["take"], report["changes"]
    terms = JOINT_TERMS if take.get("animation") else MARKER_TERMS
    relabelled = f", {fill['relabelled']} relabelled" if fill["relabelled"] else ""
    print_line(
        f"[bold]{escape(format_take_name(take))}[/]: {fill['missing_before']} {terms.samples} were missing, "
        f"{fill['filled']} filled; {fill['replaced']} faulty ones replaced{relabelled}; {fill['left_empty']} left {terms.left}. "
        f"{report['seconds']['total']:.1f} s."
    )
    if report["solve"]:
        print_line(f"  {take['marker_set']}: mean marker residual {report['solve']['marker_residual_mm']['mean']:.1f} mm.")
    if accepted := [change["kind"] for change in changes if change["decision"] == "accept"]:
        rejected = f"; {len(changes) - len(accepted)} rejected by decision" if len(changes) > len(accepted) else ""
        print_line(f"  changed: {format_fault_counts(accepted)}{rejected}.")
    made = [change for change in changes if change["decision"] == "accept" and change["predicted_mm"] is not None]
    if worst := max(made, key=lambda change: change["predicted_mm"] or 0.0, default=None):
        what = f"{worst['kind']} of {escape(join_names(worst['markers']))}"
        where = f"frame{'s' * (worst['last'] > worst['first'])} {format_frame_range(worst['first'], worst['last'])}"
        print_line(f"  worst predicted error: {format_number(worst['predicted_mm'])} mm, {what}, {where}.")
    for line in describe_left_empty(fill, f"left {terms.left}"):
        print_note(line)
    print_notes(report["notes"], "in the report")
    print_output_files(outputs)
    if changes:
        prefix = ["--subject-prefix", subject_prefix] if subject_prefix else []
        arguments = escape(shlex.join([*prefix, "--changes", str(outputs["changes.yaml"]), "--overwrite"]))
        folder = escape(shlex.quote(str(outputs["changes.yaml"].parent)))
        print_line(f"  To look at the changes in the browser, and reject some: mocapfix review {folder}")
        same = " and the same options" if len(report.get("arguments", [])) > 1 else ""
        print_line(f"  To undo a change by hand, edit its decision in the changes file and clean again with {arguments}{same}")


def print_notes(notes: Sequence[str], place: str) -> None:
    """Print the first notes, and how many more there are, and where."""
    for note in notes[:MAX_PRINTED_NOTES]:
        print_note(note)
    if more := len(notes[MAX_PRINTED_NOTES:]):
        print_line(f"  ... and {more} more {'note' if more == 1 else 'notes'}, {place}.")


def describe_left_empty(fill: "FillSection", left: str) -> list[str]:
    """Return lines on what a cleaning left as it was: each interval, or the markers and the reasons where there are many."""
    runs, markers = fill["unfilled"], fill["left_by_marker"]
    if len(runs) <= MAX_LISTED_RUNS:
        return [f"{left}: {run['marker']}, frames {run['first']}-{run['last']}: {run['reason']}." for run in runs]
    reasons: Counter[str] = Counter()
    for entry in markers:
        reasons.update(entry["reasons"])
    more = f"; the report lists {len(markers):,} markers" if len(markers) > MAX_LISTED_RUNS else ""
    listed = ", ".join(f"{entry['marker']} {entry['samples']:,}" for entry in markers[:MAX_LISTED_RUNS])
    lines = [f"{left}, by marker: {listed}{more}."]
    return lines + [f"{left}: {count:,} samples: {reason}." for reason, count in reasons.most_common(MAX_LISTED_REASONS)]


def describe_laboratory(evidence: Mapping[str, str], options: CleanOptions) -> str:
    """Return the sentence that suggests the purpose of laboratories for takes that look like theirs; "" if it is not needed.

    Args:
        evidence: By the name of a take, what suggests a laboratory; "" if nothing does.
    """
    found = [(take, reason) for take, reason in evidence.items() if reason]
    if not found or "purpose" in options.purpose.given:
        return ""
    take, reason = found[0]
    what = f"{take} looks like a take" if len(evidence) == 1 else f"{len(found):,} takes, such as {take}, look like those"
    return (
        f"{what} of a laboratory ({reason}): --purpose lab writes only what measurements can rely on. "
        "(--purpose animation hides this note.)"
    )


def print_output_files(outputs: Mapping[str, Path]) -> None:
    """Print the folder and the names of the files that were written."""
    paths = list(outputs.values())
    print_note(f"{paths[0].parent}/: {', '.join(path.name for path in paths)}")


def format_take_name(take: "TakeSection") -> str:
    """Return the name of the take in a report: its file's, with the subject's if the file has several."""
    return f"{take['file']} ({take['person']})" if "person" in take else take["file"]


def inspect_take(take: Path, options: CleanOptions, as_json: bool) -> int:
    """Print the faults of a take; return the exit status."""
    from mocapfix import pipeline

    with show_progress(take.name) as progress:
        inspections = pipeline.inspect(take, options, progress=progress)
    if as_json:
        console.print_json(inspections if len(inspections) > 1 else inspections[0])
        return console.EXIT_DONE
    for inspection in inspections:
        print_faults(inspection)
    return console.EXIT_DONE


def print_faults(inspection: "InspectionReport") -> None:
    """Print the faults of a take, or of one subject in it, as a table."""
    take = inspection["take"]
    last_frame = take["first_frame"] + take["frames"] - 1
    is_animation = "animation" in take
    point = "joint" if is_animation else "marker"
    size = f"{take['markers']} {point}s, frames {take['first_frame']} to {last_frame} at {take['rate_hz']:g} Hz"
    print_line(f"{escape(format_take_name(take))}: {size}.")
    print_notes(inspection["notes"], "with --json")
    if not inspection["faults"]:
        console.stdout_console.print("No faults were detected.")
        return
    from rich.table import Table  # slow to import

    table = Table(point, "kind", "frames", "severity" if is_animation else "severity, mm", "confidence", "reason")
    for fault in inspection["faults"]:
        frames, severity = f"{fault['first']}-{fault['last']}", _format_severity(fault, is_animation)
        what = escape(fault["marker"]), fault["kind"], frames, severity
        table.add_row(*what, f"{fault['confidence']:.0%}", escape(fault["reason"]))
    console.stdout_console.print(table)


def _format_severity(fault: "FaultEntry", with_unit: bool) -> str:
    if (severity_deg := fault.get("severity_deg")) is not None:
        return f"{severity_deg:.0f} degrees"
    if fault["severity_m"] is None:
        return ""
    return f"{fault['severity_m'] * 1e3:.0f}{' mm' if with_unit else ''}"


def run_cleaning_job(path: Path, output_folder: Path, overwrite: bool) -> int:
    """Clean the takes of the job at `path`; return the exit status."""
    from mocapfix.batch.job_files import read_cleaning_job
    from mocapfix.io.files import make_output_folder
    from mocapfix.surveys import calibrate_takes

    job = read_cleaning_job(path)
    takes = job.list_takes(output_folder)
    print_line(f"[bold]{escape(job.header.title)}[/]: {len(takes)} {'take' if len(takes) == 1 else 'takes'}.")
    make_output_folder(output_folder)
    job.write_composed_takes(output_folder, overwrite)
    subject = job.get_subject_file()
    if calibration_takes := job.list_calibration_takes():
        with show_progress(path.name, needs_kernels=True) as progress:
            progress("calibrate")
            subject = calibrate_takes(calibration_takes, job.options)
    return clean_takes(takes, output_folder, job.options.change(subject=subject), overwrite=overwrite)


def run_keypoints_job(path: Path, output_folder: Path, overwrite: bool) -> int:
    """Estimate poses and camera of the keypoint scene at `path`; return the exit status."""
    from mocapfix.keypoints import keypoint_scene

    with show_progress(path.name) as progress:
        result = keypoint_scene.run_keypoint_scene(path, progress)
        outputs = result.write(output_folder, overwrite)
    report = result.report
    print_line(
        f"[bold]{escape(result.title)}[/]: {report['frames']} frames, mean reprojection error "
        f"{report['reprojection_px']['mean']:.1f} px; camera scale {report['camera']['pixels_per_metre']:.1f} pixels per metre. "
        f"{report['seconds']['total']:.1f} s."
    )
    for note in report["notes"]:
        print_line(escape(note))
    print_output_files(outputs)
    return console.EXIT_DONE


SCENE_RUNNERS = {"clean": run_cleaning_job, "keypoints-2d": run_keypoints_job}
