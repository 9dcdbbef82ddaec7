"""The kinds of file that cleaning a take may write: a line for each."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mocapfix import write
from mocapfix.calibrate import subject_file
from mocapfix.files.layouts import TableLayout
from mocapfix.motion import Motion
from mocapfix.report import review_file
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject
from mocapfix.take import Take
from mocapfix.write.rig import Rig

if TYPE_CHECKING:
    from mocapfix.result import CleaningResult

UNIT_NAMES = {1.0: "metres", 0.01: "centimetres"}


@dataclass(frozen=True)
class ExportedMotion:
    """Somebody and how they move, at some rate (frames a second), over a floor that was `floor` metres high and is at 0."""

    subject: Subject
    motion: Motion
    rate: float
    floor_height_m: float = 0.0

    @property
    def skeleton(self) -> Skeleton:
        return self.subject.skeleton


@dataclass(frozen=True)
class OutputFormat:
    """One kind of file.

    suffix  follows the input's stem
    write   puts it there, of what cleaning gave and of the motion at the wanted rate (None where the take has no body)
    brings  suffixes of files that it puts beside that one
    body    is there none without a body?
    worn    is there none without markers on it?
    stage   under which its time is counted
    note    what whoever opens it must know
    """

    suffix: str
    write_file: Callable[[Path, "CleaningResult", Any], object]
    companion_suffixes: tuple[str, ...] = ()
    needs_body: bool = False
    needs_markers: bool = False
    timer_stage: str = "write"
    usage_note: str = ""

    @property
    def all_suffixes(self) -> tuple[str, ...]:
        return (self.suffix, *self.companion_suffixes)


def _write_bvh(target: Path, result: "CleaningResult", moving: ExportedMotion) -> None:
    write.write_bvh(target, moving.skeleton, moving.motion, moving.rate)


def build_rig_format(rig: Rig) -> OutputFormat:
    """-> a BVH as a program wants it."""
    unit = UNIT_NAMES.get(rig.unit_m, f"units of {rig.unit_m * 1e3:.3f} mm")
    return OutputFormat(
        f"{rig.name}.bvh",
        lambda target, result, moving: write.write_rig_bvh(target, rig, moving.skeleton, moving.motion, moving.rate),
        needs_body=True,
        usage_note=f"is for {rig.program}: {unit}, Y up; {rig.note}.",
    )


def _write_gltf(target: Path, result: "CleaningResult", moving: ExportedMotion) -> None:
    write.write_gltf(target, moving.skeleton, moving.motion, moving.rate)


def _write_amc(target: Path, result: "CleaningResult", moving: ExportedMotion) -> None:
    first = result.input_take.first_frame if moving.rate == result.input_take.rate else 1
    write.write_asf_amc(target.with_suffix(".asf"), target, moving.skeleton, moving.motion, moving.rate, first)


def _write_npz(target: Path, result: "CleaningResult", moving: ExportedMotion | None) -> None:
    if moving:
        take = result.output_take.replace_markers(
            result.output_take.markers - [0.0, moving.floor_height_m, 0.0], result.output_take.sample_sd
        )
        write.write_npz(target, take, moving.skeleton, moving.motion, moving.rate)
    else:
        write.write_npz(target, result.output_take)


def _write_subject(target: Path, result: "CleaningResult", moving: ExportedMotion) -> None:
    subject_file.write_subject(target, moving.subject)


def _write_changes(target: Path, result: "CleaningResult", moving: ExportedMotion | None) -> None:
    review_file.write_review_file(target, result.input_take, result.changes)


def _write_recording(target: Path, result: "CleaningResult", moving: ExportedMotion | None) -> None:
    from mocapfix.report.recording import write_recording

    write_recording(target, result.comparison)


def _write_html_report(target: Path, result: "CleaningResult", moving: ExportedMotion | None) -> None:
    from mocapfix.report.html_report import write_html_report

    write_html_report(target, result.report, result.comparison)


def _write_json_report(target: Path, result: "CleaningResult", moving: ExportedMotion | None) -> None:
    target.write_text(json.dumps(result.report, indent=1) + "\n", encoding="utf-8")


def _write_c3d(target: Path, result: "CleaningResult", moving: ExportedMotion | None) -> None:
    write.write_c3d(target, result.output_take)


def _write_trc(target: Path, result: "CleaningResult", moving: ExportedMotion | None) -> None:
    write.write_trc(target, result.output_take)


def _write_csv(target: Path, result: "CleaningResult", moving: ExportedMotion | None) -> None:
    write.write_csv(target, result.output_take)


BVH_FORMAT = OutputFormat("bvh", _write_bvh, needs_body=True)
DEFAULT_FORMATS = (
    OutputFormat("subject.yaml", _write_subject, needs_body=True, needs_markers=True),
    OutputFormat("changes.yaml", _write_changes),
    OutputFormat("rrd", _write_recording, timer_stage="show"),
    OutputFormat("report.html", _write_html_report, timer_stage="show"),
    OutputFormat("report.json", _write_json_report),  # the last, so that it has every other one's seconds
)
OPTIONAL_FORMATS = {
    "gltf": OutputFormat("glb", _write_gltf, needs_body=True, usage_note="is binary glTF: metres, Y up."),
    "amc": OutputFormat(
        "amc", _write_amc, ("asf",), needs_body=True, usage_note="goes with the asf: CMU's form, units of 56.444 mm, Y up."
    ),
    "npz": OutputFormat("npz", _write_npz),
    "c3d": OutputFormat(
        "c3d",
        _write_c3d,
        usage_note="is a new file with positions only and the predicted standard deviation of each filled sample.",
    ),
    "trc": OutputFormat("trc", _write_trc),
    "csv": OutputFormat("csv", _write_csv),
}


def write_cleaned_copy(target: Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write the take's own file with only the changed samples replaced, or, where it has no place for every sample, a plain
    table instead. -> the (frame, marker) indices that could not be stored."""
    if isinstance(before.layout, TableLayout):
        if before.layout.has_field_per_sample:
            return write.patch_table(target, before, after)
        write.write_csv(target, after)
        return []
    return write.patch_c3d(target, before, after)


def get_source_suffixes(source: Path | None) -> tuple[str, ...]:
    """-> the mended file's, the input's own, and with an AMC its skeleton's."""
    own = (source.suffix[1:].lower() if source else "") or "c3d"
    return ("amc", "asf") if own == "amc" else (own,)
