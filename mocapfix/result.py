"""What cleaning a take gives, and how it is put into a folder."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from mocapfix.animation import Animation
from mocapfix.animations import joint_points
from mocapfix.changes import Change, UnfilledRun
from mocapfix.errors import WriteError
from mocapfix.faults import Faults
from mocapfix.files.output_files import check_outputs_absent, make_output_folder
from mocapfix.motion import Motion
from mocapfix.report import report_data
from mocapfix.report.stage_timer import ProgressCallback, StageTimer
from mocapfix.subject import Subject
from mocapfix.take import Take
from mocapfix.write.output_formats import OutputFormat, get_source_suffixes, write_cleaned_copy
from mocapfix.write.output_options import OutputOptions

if TYPE_CHECKING:
    from mocapfix.report import CleaningComparison

DEFAULT_OUTPUT_OPTIONS = OutputOptions()


@dataclass(frozen=True)
class CleaningResult:
    """A cleaned take and everything known of it.

    before   the take as it was read;  labelled  the same with its labels put right;  take  as it was mended
    faults   what was wrong;  changes  what was done about it;  left  what stays empty, and why
    donors   markers whose labels only name pieces of others
    subject  the person, motion their poses: None where no marker set fits
    joints   (T, J, 3) metres, the solved joints;  error (T, M) metres, each believed marker from the body, NaN elsewhere
    report   the record, as the JSON report holds it (see mocapfix.report.report_data)
    centres  of an animation, whose other takes are of its joints' tips (see mocapfix.animations.joint_points), the joints' places as mended;
             subject and motion are then the 31 joints' that its own were found to be, None where they are nobody's
    people   of a take of several people each one's result, of their own markers (see mocapfix.multi_subject); this one is then of
             the whole take, has no body, and its report holds theirs, by name
    """

    input_take: Take
    relabelled_take: Take
    take: Take
    faults: Faults
    changes: tuple[Change, ...]
    unfilled_runs: tuple[UnfilledRun, ...]
    fragment_donors: tuple[int, ...]
    subject: Subject | None
    motion: Motion | None
    joint_position_world: np.ndarray | None
    residual_m: np.ndarray | None
    report: dict
    subject_results: tuple["CleaningResult", ...] = ()
    joint_centres: Take | None = None

    def write(
        self,
        folder: str | Path,
        overwrite: bool = False,
        report_progress: ProgressCallback | None = None,
        options: OutputOptions = DEFAULT_OUTPUT_OPTIONS,
    ) -> dict[str, Path]:
        """Write the mended file, BVH, subject, changes, report and recording, and what `options` name, into a folder, made
        where it is not there.

        All are written beside their places first and put there together, so that none is missing or half-written.
        -> the files by kind; of several people "Jim.bvh" and the like, and one "c3d". Raises WriteError where one is there
        already (and overwrite is False), or cannot be written.
        """
        folder, stem, bodies = Path(folder), self._stem, self.subject_results or (self,)
        targets = check_outputs_free(
            folder, stem, overwrite, self.input_take.path, options, [each.input_take.output_stem for each in bodies]
        )
        make_output_folder(folder)
        try:
            with TemporaryDirectory(dir=folder, prefix=f".{stem}.") as beside:
                self._write_files(Path(beside), options, report_progress)
                for target in targets:
                    part = Path(beside) / target.name
                    if part.exists():
                        part.replace(target)
                    else:  # of an earlier cleaning, with a body
                        target.unlink(missing_ok=True)
        except OSError as error:
            raise WriteError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder.") from error
        return {
            path.name.removeprefix(f"{stem}."): path
            for each in bodies
            for path in each.get_output_paths(folder, options).values()
        }

    def get_output_paths(self, folder: Path, options: OutputOptions = DEFAULT_OUTPUT_OPTIONS) -> dict[str, Path]:
        """-> what `write` puts into a folder of one body or none, by kind."""
        none = [suffix for kind in options.formats if not self._can_write(kind) for suffix in kind.all_suffixes]
        none = set(none) - set(get_source_suffixes(self.input_take.path))
        outputs = build_output_paths(folder, self._stem, self.input_take.path, options, self.input_take.output_stem)
        return {suffix: path for suffix, path in outputs.items() if suffix not in none}

    @property
    def output_take(self) -> Take:
        """What is written as a take: the mended markers, or the places of an animation's joints."""
        return self.joint_centres or self.take

    def _can_write(self, kind: OutputFormat) -> bool:
        """Is there what a kind of file is about?"""
        worn = self.subject is not None and len(self.subject.labels) > 0
        return (worn or not kind.needs_markers) and (self.motion is not None or not kind.needs_body)

    @property
    def _stem(self) -> str:
        return self.input_take.path.stem if self.input_take.path else "take"

    def _write_files(self, folder: Path, options: OutputOptions, report_progress: ProgressCallback | None) -> None:
        """The file is written once, whoever is in it; then what is each one's own."""
        bodies = self.subject_results or (self,)
        clocks = [StageTimer(dict(each.report["seconds"]), report_progress) for each in bodies]
        with clocks[0]("write"):
            target = folder / f"{self._stem}.{get_source_suffixes(self.input_take.path)[0]}"
            beyond = write_cleaned_copy(target, self.input_take, self.take)
        for each, clock in zip(bodies, clocks, strict=True):
            own = {int(m): k for k, m in enumerate(self.input_take.find_marker_indices(each.input_take))}
            each._write_subject_files(folder, options, clock, [(t, own[m]) for t, m in beyond if m in own])

    def _write_subject_files(
        self, folder: Path, options: OutputOptions, timer: StageTimer, unstorable_samples: list[tuple[int, int]]
    ) -> None:
        """Write all but the mended file, which could not hold the samples `beyond`, of one body or none."""
        with timer("write"):
            moving = options.build_exported_motion(self.subject, self.motion, self.input_take.rate)
        notes = [*self.report["notes"], *options.build_notes(self.input_take, moving is not None)]
        final = replace(self, report={**self.report, "seconds": timer.stage_seconds, "notes": notes})._drop_samples(
            unstorable_samples
        )
        for kind in options.formats:
            if self._can_write(kind) and kind.suffix not in get_source_suffixes(self.input_take.path):
                with timer(kind.timer_stage):
                    kind.write_file(folder / f"{self.input_take.output_stem}.{kind.suffix}", final, moving)

    def _drop_samples(self, unstorable_samples: list[tuple[int, int]]) -> "CleaningResult":
        """-> the result with the samples (frame, marker) empty that the mended file cannot hold."""
        if not unstorable_samples:
            return self
        markers = self.take.markers.copy()
        markers[tuple(np.array(unstorable_samples).T)] = np.nan
        after = self.take.replace_markers(markers, self.take.sample_sd)
        left = self.unfilled_runs + tuple(
            UnfilledRun(m, t, t, "its mended place is beyond what its file can hold") for t, m in unstorable_samples
        )
        fill = report_data.build_fill_section(self.input_take, self.relabelled_take, after, left, self.fragment_donors)
        return replace(self, take=after, left=left, report={**self.report, "fill": fill})

    @cached_property
    def comparison(self) -> "CleaningComparison":
        """-> what the page and the recording show."""
        from mocapfix.report import CleaningComparison

        skeleton, joints = self.subject.skeleton if self.subject else None, self.joint_position_world
        if isinstance(self.take.layout, Animation):
            skeleton, joints = joint_points.build_joint_skeleton(self.take.layout)
        return CleaningComparison(
            self.input_take, self.relabelled_take, self.take, self.faults, self.changes, skeleton, joints, self.residual_m
        )


def build_output_paths(
    folder: Path, stem: str, source_path: Path | None, options: OutputOptions, subject_stem: str = ""
) -> dict[str, Path]:
    """-> what may be written into a folder, by kind, each named by the input's stem; what is one person's of several by their
    `own` stem, but the mended file, of the input's suffix, is everybody's."""
    mine = get_source_suffixes(source_path)
    others = (each for kind in options.formats for each in kind.all_suffixes if each not in mine)
    return {each: folder / f"{stem}.{each}" for each in mine} | {
        each: folder / f"{subject_stem or stem}.{each}" for each in others
    }


def check_outputs_free(
    folder: Path,
    stem: str,
    overwrite: bool,
    source_path: Path | None = None,
    options: OutputOptions = DEFAULT_OUTPUT_OPTIONS,
    subject_stems: Sequence[str] = ("",),
) -> tuple[Path, ...]:
    """-> the outputs, of each one's `own` stem. Raises WriteError where one is there already and must not be replaced, or would
    replace the input, or another, or where the folder is a file."""
    if folder.exists() and not folder.is_dir():
        raise WriteError(f"{folder}: cannot be made a folder (it is a file); choose another with --out.")
    if len({each.casefold() for each in subject_stems}) < len(subject_stems):
        raise WriteError(
            f"{source_path}: the files of two of its people would be called the same; give one of them another name."
        )
    found = (build_output_paths(folder, stem, source_path, options, each) for each in subject_stems)
    targets = tuple(dict.fromkeys(path for outputs in found for path in outputs.values()))
    if source_path and any(path.exists() and path.samefile(source_path) for path in targets):
        raise WriteError(
            f"{source_path}: is the input itself and is never replaced; choose another folder than its own with --out."
        )
    check_outputs_absent(targets, overwrite)
    return targets
