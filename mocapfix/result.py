"""What cleaning a take gives, and how it is put into a folder."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mocapfix import change_file, record, subject_file
from mocapfix.changes import Change
from mocapfix.clock import Clock, Progress
from mocapfix.errors import WriteError
from mocapfix.faults import Faults
from mocapfix.left import Left
from mocapfix.motion import Motion
from mocapfix.subject import Subject
from mocapfix.take import Take

KINDS = ("c3d", "bvh", "subject.yaml", "changes.yaml", "report.json", "report.html", "rrd")
OF_BODY = ("bvh", "subject.yaml")


@dataclass(frozen=True)
class Result:
    """A cleaned take and everything known of it.

    before   the take as it was read;  labelled  the same with its labels put right;  take  as it was mended
    faults   what was wrong;  changes  what was done about it;  left  what stays empty, and why
    donors   markers whose labels only name pieces of others
    subject  the person, motion their poses: None where no marker set fits
    joints   (T, J, 3) metres, the solved joints;  error (T, M) metres, each believed marker from the body, NaN elsewhere
    report   the record, as the JSON report holds it (see mocapfix.record)
    people   of a take of several people each one's result, of their own markers (see mocapfix.people); this one is then of
             the whole take, has no body, and its report holds theirs, by name
    """

    before: Take
    labelled: Take
    take: Take
    faults: Faults
    changes: tuple[Change, ...]
    left: tuple[Left, ...]
    donors: tuple[int, ...]
    subject: Subject | None
    motion: Motion | None
    joints: np.ndarray | None
    error: np.ndarray | None
    report: dict
    people: tuple["Result", ...] = ()

    def write(self, folder: str | Path, overwrite: bool = False, progress: Progress | None = None) -> dict[str, Path]:
        """Write the mended C3D, BVH, subject, report and recording into a folder, made where it is not there.

        All are written beside their places first and put there together, so that none is missing or half-written.
        -> the files by kind; of several people "Jim.bvh" and the like, and one "c3d". Raises WriteError where one is there
        already (and overwrite is False), or cannot be written.
        """
        folder, stem, bodies = Path(folder), self._stem, self.people or (self,)
        targets = check_free(folder, stem, overwrite, self.before.path, [each.before.stem for each in bodies])
        make_folder(folder)
        try:
            with TemporaryDirectory(dir=folder, prefix=f".{stem}.") as beside:
                self._write_into(Path(beside), progress)
                for target in targets:
                    part = Path(beside) / target.name
                    if part.exists():
                        part.replace(target)
                    elif target.name.endswith(OF_BODY):  # of an earlier cleaning, with a body
                        target.unlink(missing_ok=True)
        except OSError as error:
            raise WriteError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder.") from error
        return {path.name.removeprefix(f"{stem}."): path for each in bodies for path in each.outputs(folder).values()}

    def outputs(self, folder: Path) -> dict[str, Path]:
        """-> what `write` puts into a folder of one body or none, by kind."""
        outputs = outputs_in(folder, self._stem, self.before.stem)
        return {kind: path for kind, path in outputs.items() if self.subject or kind not in OF_BODY}

    @property
    def _stem(self) -> str:
        return self.before.path.stem if self.before.path else "take"

    def _write_into(self, folder: Path, progress: Progress | None) -> None:
        """The file is written once, whoever is in it; then what is each one's own."""
        from mocapfix import write

        bodies = self.people or (self,)
        clocks = [Clock(dict(each.report["seconds"]), progress) for each in bodies]
        with clocks[0]("write"):
            beyond = write.c3d(outputs_in(folder, self._stem)["c3d"], self.before, self.take)
        for each, clock in zip(bodies, clocks, strict=True):
            own = {int(m): k for k, m in enumerate(self.before.of_part(each.before))}
            lost = [(t, own[m]) for t, m in beyond if m in own]
            each._write_body(outputs_in(folder, self._stem, each.before.stem), clock, lost)

    def _write_body(self, outputs: dict[str, Path], clock: Clock, beyond: list[tuple[int, int]]) -> None:
        """Write all but the mended file, which could not hold the samples `beyond`, of one body or none."""
        from mocapfix import show, write

        report = {**self.report, "seconds": clock.seconds}
        after, left = self.take, self.left
        with clock("write"):
            if beyond:
                markers = self.take.markers.copy()
                markers[tuple(np.array(beyond).T)] = np.nan
                after = self.take.with_markers(markers, self.take.deviation)
                left += tuple(Left(m, t, t, "its mended place is beyond what this integer file can hold") for t, m in beyond)
                report["fill"] = record.of_fill(self.before, self.labelled, after, left, self.donors)
            if self.subject and self.motion:
                write.bvh(outputs["bvh"], self.subject.skeleton, self.motion, self.before.rate)
                subject_file.save(outputs["subject.yaml"], self.subject)
        skeleton = self.subject.skeleton if self.subject else None
        shown = show.Cleaning(self.before, self.labelled, after, self.faults, self.changes, skeleton, self.joints, self.error)
        with clock("show"):
            show.comparison(outputs["rrd"], shown)
            show.report(outputs["report.html"], report, shown)
        change_file.save(outputs["changes.yaml"], self.before, self.changes)
        outputs["report.json"].write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def outputs_in(folder: Path, stem: str, own: str = "") -> dict[str, Path]:
    """-> what may be written into a folder, by kind, each named by the input's stem; what is one person's of several by their
    `own` stem, but the mended file is everybody's."""
    return {kind: folder / f"{stem if kind == 'c3d' else own or stem}.{kind}" for kind in KINDS}


def check_free(
    folder: Path, stem: str, overwrite: bool, source: Path | None = None, own: Sequence[str] = ("",)
) -> tuple[Path, ...]:
    """-> the outputs, of each one's `own` stem. Raises WriteError where one is there already and must not be replaced, or would
    replace the input, or another."""
    outputs = outputs_in(folder, stem)
    if source and outputs["c3d"].exists() and outputs["c3d"].samefile(source):
        raise WriteError(f"{source}: is the input itself and is never replaced; choose another folder than its own with --out.")
    if len({each.casefold() for each in own}) < len(own):
        raise WriteError(f"{source}: the files of two of its people would be called the same; give one of them another name.")
    targets = tuple(dict.fromkeys(path for each in own for path in outputs_in(folder, stem, each).values()))
    check_not_there(targets, overwrite)
    return targets


def check_not_there(outputs: Iterable[Path], overwrite: bool) -> None:
    """Raise WriteError naming the first output that is there already, unless it may be replaced."""
    there = [path for path in outputs if path.exists()]
    if there and not overwrite:
        raise WriteError(f"{there[0]}: is there already; give --overwrite to replace it, or choose another place.")


def make_folder(folder: Path) -> None:
    """Make an output folder. Raises WriteError naming it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(f"{folder}: cannot be made a folder ({error.strerror}); choose another with --out.") from error
