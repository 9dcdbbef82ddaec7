"""What cleaning a take gives, and how it is put into a folder."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from mocapfix import joint_points, record
from mocapfix.animation import Animation
from mocapfix.changes import Change
from mocapfix.clock import Clock, Progress
from mocapfix.errors import WriteError
from mocapfix.faults import Faults
from mocapfix.files import check_not_there, make_folder
from mocapfix.kinds import Kind, mended, own_suffixes
from mocapfix.left import Left
from mocapfix.motion import Motion
from mocapfix.outputs import OutputOptions
from mocapfix.subject import Subject
from mocapfix.take import Take

if TYPE_CHECKING:
    from mocapfix.show import Cleaning

PLAIN = OutputOptions()


@dataclass(frozen=True)
class Result:
    """A cleaned take and everything known of it.

    before   the take as it was read;  labelled  the same with its labels put right;  take  as it was mended
    faults   what was wrong;  changes  what was done about it;  left  what stays empty, and why
    donors   markers whose labels only name pieces of others
    subject  the person, motion their poses: None where no marker set fits
    joints   (T, J, 3) metres, the solved joints;  error (T, M) metres, each believed marker from the body, NaN elsewhere
    report   the record, as the JSON report holds it (see mocapfix.record)
    centres  of an animation, whose other takes are of its joints' tips (see mocapfix.joint_points), the joints' places as mended;
             subject and motion are then the 31 joints' that its own were found to be, None where they are nobody's
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
    centres: Take | None = None

    def write(
        self, folder: str | Path, overwrite: bool = False, progress: Progress | None = None, options: OutputOptions = PLAIN
    ) -> dict[str, Path]:
        """Write the mended file, BVH, subject, changes, report and recording, and what `options` name, into a folder, made
        where it is not there.

        All are written beside their places first and put there together, so that none is missing or half-written.
        -> the files by kind; of several people "Jim.bvh" and the like, and one "c3d". Raises WriteError where one is there
        already (and overwrite is False), or cannot be written.
        """
        folder, stem, bodies = Path(folder), self._stem, self.people or (self,)
        targets = check_free(folder, stem, overwrite, self.before.path, options, [each.before.stem for each in bodies])
        make_folder(folder)
        try:
            with TemporaryDirectory(dir=folder, prefix=f".{stem}.") as beside:
                self._write_into(Path(beside), options, progress)
                for target in targets:
                    part = Path(beside) / target.name
                    if part.exists():
                        part.replace(target)
                    else:  # of an earlier cleaning, with a body
                        target.unlink(missing_ok=True)
        except OSError as error:
            raise WriteError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder.") from error
        return {path.name.removeprefix(f"{stem}."): path for each in bodies for path in each.outputs(folder, options).values()}

    def outputs(self, folder: Path, options: OutputOptions = PLAIN) -> dict[str, Path]:
        """-> what `write` puts into a folder of one body or none, by kind."""
        none = [suffix for kind in options.kinds if not self._has(kind) for suffix in kind.suffixes]
        none = set(none) - set(own_suffixes(self.before.path))
        outputs = outputs_in(folder, self._stem, self.before.path, options, self.before.stem)
        return {suffix: path for suffix, path in outputs.items() if suffix not in none}

    @property
    def places(self) -> Take:
        """What is written as a take: the mended markers, or the places of an animation's joints."""
        return self.centres or self.take

    def _has(self, kind: Kind) -> bool:
        """Is there what a kind of file is about?"""
        worn = self.subject is not None and len(self.subject.labels) > 0
        return (worn or not kind.worn) and (self.motion is not None or not kind.body)

    @property
    def _stem(self) -> str:
        return self.before.path.stem if self.before.path else "take"

    def _write_into(self, folder: Path, options: OutputOptions, progress: Progress | None) -> None:
        """The file is written once, whoever is in it; then what is each one's own."""
        bodies = self.people or (self,)
        clocks = [Clock(dict(each.report["seconds"]), progress) for each in bodies]
        with clocks[0]("write"):
            target = folder / f"{self._stem}.{own_suffixes(self.before.path)[0]}"
            beyond = mended(target, self.before, self.take)
        for each, clock in zip(bodies, clocks, strict=True):
            own = {int(m): k for k, m in enumerate(self.before.of_part(each.before))}
            each._write_body(folder, options, clock, [(t, own[m]) for t, m in beyond if m in own])

    def _write_body(self, folder: Path, options: OutputOptions, clock: Clock, beyond: list[tuple[int, int]]) -> None:
        """Write all but the mended file, which could not hold the samples `beyond`, of one body or none."""
        with clock("write"):
            moving = options.moving(self.subject, self.motion, self.before.rate)
        notes = [*self.report["notes"], *options.notes(self.before, moving is not None)]
        final = replace(self, report={**self.report, "seconds": clock.seconds, "notes": notes})._without(beyond)
        for kind in options.kinds:
            if self._has(kind) and kind.suffix not in own_suffixes(self.before.path):
                with clock(kind.stage):
                    kind.write(folder / f"{self.before.stem}.{kind.suffix}", final, moving)

    def _without(self, beyond: list[tuple[int, int]]) -> "Result":
        """-> the result with the samples (frame, marker) empty that the mended file cannot hold."""
        if not beyond:
            return self
        markers = self.take.markers.copy()
        markers[tuple(np.array(beyond).T)] = np.nan
        after = self.take.with_markers(markers, self.take.deviation)
        left = self.left + tuple(Left(m, t, t, "its mended place is beyond what its file can hold") for t, m in beyond)
        fill = record.of_fill(self.before, self.labelled, after, left, self.donors)
        return replace(self, take=after, left=left, report={**self.report, "fill": fill})

    @cached_property
    def shown(self) -> "Cleaning":
        """-> what the page and the recording show."""
        from mocapfix.show import Cleaning

        skeleton, joints = self.subject.skeleton if self.subject else None, self.joints
        if isinstance(self.take.layout, Animation):
            skeleton, joints = joint_points.tree(self.take.layout)
        return Cleaning(self.before, self.labelled, self.take, self.faults, self.changes, skeleton, joints, self.error)


def outputs_in(folder: Path, stem: str, source: Path | None, options: OutputOptions, own: str = "") -> dict[str, Path]:
    """-> what may be written into a folder, by kind, each named by the input's stem; what is one person's of several by their
    `own` stem, but the mended file, of the input's suffix, is everybody's."""
    mine = own_suffixes(source)
    others = (each for kind in options.kinds for each in kind.suffixes if each not in mine)
    return {each: folder / f"{stem}.{each}" for each in mine} | {each: folder / f"{own or stem}.{each}" for each in others}


def check_free(
    folder: Path,
    stem: str,
    overwrite: bool,
    source: Path | None = None,
    options: OutputOptions = PLAIN,
    own: Sequence[str] = ("",),
) -> tuple[Path, ...]:
    """-> the outputs, of each one's `own` stem. Raises WriteError where one is there already and must not be replaced, or would
    replace the input, or another, or where the folder is a file."""
    if folder.exists() and not folder.is_dir():
        raise WriteError(f"{folder}: cannot be made a folder (it is a file); choose another with --out.")
    if len({each.casefold() for each in own}) < len(own):
        raise WriteError(f"{source}: the files of two of its people would be called the same; give one of them another name.")
    found = (outputs_in(folder, stem, source, options, each) for each in own)
    targets = tuple(dict.fromkeys(path for outputs in found for path in outputs.values()))
    if source and any(path.exists() and path.samefile(source) for path in targets):
        raise WriteError(f"{source}: is the input itself and is never replaced; choose another folder than its own with --out.")
    check_not_there(targets, overwrite)
    return targets
