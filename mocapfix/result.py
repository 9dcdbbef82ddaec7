"""What cleaning a take gives, and how it is put into a folder."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from mocapfix import record, write
from mocapfix.changes import Change
from mocapfix.clock import Clock, Progress
from mocapfix.errors import WriteError
from mocapfix.faults import Faults
from mocapfix.left import Left
from mocapfix.motion import Motion
from mocapfix.outputs import OutputOptions
from mocapfix.subject import Subject
from mocapfix.take import Take

if TYPE_CHECKING:
    from mocapfix.show import Cleaning

MENDED = "c3d"
USUAL = OutputOptions()


@dataclass(frozen=True)
class Result:
    """A cleaned take and everything known of it.

    before   the take as it was read;  labelled  the same with its labels put right;  take  as it was mended
    faults   what was wrong;  changes  what was done about it;  left  what stays empty, and why
    donors   markers whose labels only name pieces of others
    subject  the person, motion their poses: None where no marker set fits
    joints   (T, J, 3) metres, the solved joints;  error (T, M) metres, each believed marker from the body, NaN elsewhere
    report   the record, as the JSON report holds it (see mocapfix.record)
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

    def write(
        self, folder: str | Path, overwrite: bool = False, progress: Progress | None = None, options: OutputOptions = USUAL
    ) -> dict[str, Path]:
        """Write the mended C3D, BVH, subject, changes, report and recording, and what `options` name, into a folder, made
        where it is not there.

        All are written beside their places first and put there together, so that none is missing or half-written.
        -> the files by kind. Raises WriteError where one is there already (and overwrite is False), or cannot be written.
        """
        folder, stem = Path(folder), self.before.path.stem if self.before.path else "take"
        targets = check_free(folder, stem, overwrite, self.before.path, options)
        make_folder(folder)
        try:
            with TemporaryDirectory(dir=folder, prefix=f".{stem}.") as beside:
                parts = {kind: Path(beside) / path.name for kind, path in targets.items()}
                self._write_into(parts, options, progress)
                there = {kind for kind, part in parts.items() if part.exists()}
                for kind, target in targets.items():
                    if kind in there:
                        parts[kind].replace(target)
                    else:  # of an earlier cleaning, with a body
                        target.unlink(missing_ok=True)
        except OSError as error:
            raise WriteError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder.") from error
        return {kind: path for kind, path in targets.items() if kind in there}

    def _write_into(self, targets: dict[str, Path], options: OutputOptions, progress: Progress | None) -> None:
        clock = Clock(dict(self.report["seconds"]), progress)
        with clock("write"):
            beyond = write.c3d(targets[MENDED], self.before, self.take)
            moving = options.moving(self.subject, self.motion, self.before.rate)
        notes = [*self.report["notes"], *options.notes(moving is not None, self.before.rate)]
        report = {**self.report, "seconds": clock.seconds, "notes": notes}
        final = replace(self, report=report)._without(beyond)
        for kind in options.kinds:
            if moving or not kind.body:
                with clock(kind.stage):
                    kind.write(targets[kind.suffix], final, moving)

    def _without(self, beyond: list[tuple[int, int]]) -> "Result":
        """-> the result with the samples (frame, marker) empty that the mended file cannot hold."""
        if not beyond:
            return self
        markers = self.take.markers.copy()
        markers[tuple(np.array(beyond).T)] = np.nan
        after = self.take.with_markers(markers, self.take.deviation)
        left = self.left + tuple(Left(m, t, t, "its mended place is beyond what this integer file can hold") for t, m in beyond)
        fill = record.of_fill(self.before, self.labelled, after, left, self.donors)
        return replace(self, take=after, left=left, report={**self.report, "fill": fill})

    @cached_property
    def shown(self) -> "Cleaning":
        """-> what the page and the recording show."""
        from mocapfix.show import Cleaning

        skeleton = self.subject.skeleton if self.subject else None
        return Cleaning(self.before, self.labelled, self.take, self.faults, self.changes, skeleton, self.joints, self.error)


def check_free(
    folder: Path, stem: str, overwrite: bool, source: Path | None = None, options: OutputOptions = USUAL
) -> dict[str, Path]:
    """-> what may be written into a folder, by kind, each named by the input's stem.

    Raises WriteError where an output is there already and must not be replaced, or would replace the input.
    """
    targets = {suffix: folder / f"{stem}.{suffix}" for suffix in (MENDED, *(kind.suffix for kind in options.kinds))}
    if source and targets[MENDED].exists() and targets[MENDED].samefile(source):
        raise WriteError(f"{source}: is the input itself and is never replaced; choose another folder than its own with --out.")
    check_not_there(targets.values(), overwrite)
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
