"""What cleaning a take may write beside the mended file: a line for each kind."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mocapfix import change_file, rig, subject_file, write
from mocapfix.errors import WriteError
from mocapfix.motion import Motion
from mocapfix.resample import picks, resampled
from mocapfix.rig import Rig
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject
from mocapfix.table_layout import TableLayout
from mocapfix.take import Take

if TYPE_CHECKING:
    from mocapfix.result import Result

FASTEST = 1000.0  # frames a second
UNITS = {1.0: "metres", 0.01: "centimetres"}


@dataclass(frozen=True)
class Moving:
    """Somebody and how they move, at some rate (frames a second), over a floor that was `floor` metres high and is at 0."""

    subject: Subject
    motion: Motion
    rate: float
    floor: float = 0.0

    @property
    def skeleton(self) -> Skeleton:
        return self.subject.skeleton


@dataclass(frozen=True)
class Kind:
    """One kind of file.

    suffix  follows the input's stem
    write   puts it there, of what cleaning gave and of the motion at the wanted rate (None where the take has no body)
    brings  suffixes of files that it puts beside that one
    body    is there none without a body?
    stage   under which its time is counted
    note    what whoever opens it must know
    """

    suffix: str
    write: Callable[[Path, "Result", Any], object]
    brings: tuple[str, ...] = ()
    body: bool = False
    stage: str = "write"
    note: str = ""

    @property
    def suffixes(self) -> tuple[str, ...]:
        return (self.suffix, *self.brings)


def _bvh(target: Path, result: "Result", moving: Moving) -> None:
    write.bvh(target, moving.skeleton, moving.motion, moving.rate)


def _bvh_for(wanted: Rig) -> Kind:
    unit = UNITS.get(wanted.unit, f"units of {wanted.unit * 1e3:.3f} mm")
    return Kind(
        f"{wanted.name}.bvh",
        lambda target, result, moving: write.bvh_for(target, wanted, moving.skeleton, moving.motion, moving.rate),
        body=True,
        note=f"is for {wanted.program}: {unit}, Y up; {wanted.note}.",
    )


def _gltf(target: Path, result: "Result", moving: Moving) -> None:
    write.gltf(target, moving.skeleton, moving.motion, moving.rate)


def _amc(target: Path, result: "Result", moving: Moving) -> None:
    first = result.before.first_frame if moving.rate == result.before.rate else 1
    write.asf_amc(target.with_suffix(".asf"), target, moving.skeleton, moving.motion, moving.rate, first)


def _npz(target: Path, result: "Result", moving: Moving | None) -> None:
    if moving:
        take = result.take.with_markers(result.take.markers - [0.0, moving.floor, 0.0], result.take.deviation)
        write.npz(target, take, moving.skeleton, moving.motion, moving.rate)
    else:
        write.npz(target, result.take)


def _subject(target: Path, result: "Result", moving: Moving) -> None:
    subject_file.save(target, moving.subject)


def _changes(target: Path, result: "Result", moving: Moving | None) -> None:
    change_file.save(target, result.before, result.changes)


def _recording(target: Path, result: "Result", moving: Moving | None) -> None:
    from mocapfix import show

    show.comparison(target, result.shown)


def _page(target: Path, result: "Result", moving: Moving | None) -> None:
    from mocapfix import show

    show.report(target, result.report, result.shown)


def _report(target: Path, result: "Result", moving: Moving | None) -> None:
    target.write_text(json.dumps(result.report, indent=1) + "\n", encoding="utf-8")


def _c3d(target: Path, result: "Result", moving: Moving | None) -> None:
    write.new_c3d(target, result.take)


def _trc(target: Path, result: "Result", moving: Moving | None) -> None:
    write.trc(target, result.take)


def _csv(target: Path, result: "Result", moving: Moving | None) -> None:
    write.csv(target, result.take)


BVH = Kind("bvh", _bvh, body=True)
USUAL = (
    Kind("subject.yaml", _subject, body=True),
    Kind("changes.yaml", _changes),
    Kind("rrd", _recording, stage="show"),
    Kind("report.html", _page, stage="show"),
    Kind("report.json", _report),  # the last, so that it has every other one's seconds
)
ALSO = {
    "gltf": Kind("glb", _gltf, body=True, note="is binary glTF: metres, Y up."),
    "amc": Kind("amc", _amc, ("asf",), body=True, note="goes with the asf: CMU's form, units of 56.444 mm, Y up."),
    "npz": Kind("npz", _npz),
    "c3d": Kind("c3d", _c3d),
    "trc": Kind("trc", _trc),
    "csv": Kind("csv", _csv),
}


def mended(target: Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write the take's own file with only the changed samples replaced, or, where it has no place for every sample, a plain
    table instead. -> the (frame, marker) indices that could not be stored."""
    if isinstance(before.layout, TableLayout):
        if before.layout.has_places:
            return write.table(target, before, after)
        write.csv(target, after)
        return []
    return write.c3d(target, before, after)


def own_suffix(source: Path | None) -> str:
    """-> the mended file's: the input's own."""
    return (source.suffix[1:].lower() if source else "") or "c3d"


@dataclass(frozen=True)
class OutputOptions:
    """What is written beside the usual files, and how.

    also     kinds of file, of ALSO;  bvh_for  rigs (a shipped one's name or a YAML file): a BVH for each
    fps      frames a second of what moves; None: the take's own. Mended markers always keep the take's
    floor    metres: how high the floor lies in the take; what moves is written as standing at height 0

    Raises WriteError or SceneError where there is no such kind, rig or rate.
    """

    also: tuple[str, ...] = ()
    bvh_for: tuple[str, ...] = ()
    fps: float | None = None
    floor: float = 0.0

    def __post_init__(self) -> None:
        if strange := [kind for kind in self.also if kind not in ALSO]:
            raise WriteError(f"There is no kind of file {strange[0]!r} to write; choose of: {', '.join(ALSO)}.")
        if self.fps is not None and not 0 < self.fps <= FASTEST:
            raise WriteError(f"Frames a second must be more than 0 and at most {FASTEST:g}, not {self.fps:g}.")
        if not isfinite(self.floor):
            raise WriteError(f"A floor must lie at some height in metres, not {self.floor:g}.")
        suffixes = [suffix for kind in self.kinds for suffix in kind.suffixes]
        if twice := [suffix for suffix in suffixes if suffixes.count(suffix) > 1]:
            raise WriteError(f"Two of what is to be written would both be called .{twice[0]}; name one of them.")

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """-> everything that is to be written, in this order."""
        rigs = [_bvh_for(rig.load(name)) for name in dict.fromkeys(self.bvh_for)]
        return (BVH, *rigs, *(ALSO[name] for name in dict.fromkeys(self.also)), *USUAL)

    def moving(self, subject: Subject | None, motion: Motion | None, rate: float) -> Moving | None:
        """-> somebody's motion at the wanted rate; None where there is nobody."""
        fps = self.fps or rate
        if not (subject and motion):
            return None
        standing = replace(motion, root=motion.root - [0.0, self.floor, 0.0]) if self.floor else motion
        return Moving(subject, resampled(standing, rate, fps), fps, self.floor)

    def notes(self, take: Take, body: bool) -> list[str]:
        """-> sentences on what was written otherwise than usual or beside it."""
        asked = [kind for kind in self.kinds if kind not in (BVH, *USUAL)]
        said = [f"{kind.suffix} {kind.note}" for kind in asked if kind.note and (body or not kind.body)]
        said += [f"There is no {kind.suffix}, for the take has no skeleton." for kind in asked if kind.body and not body]
        if isinstance(take.layout, TableLayout) and not take.layout.has_places:
            said.append(f"{take.name} lists only what was seen, so that the mended markers are written as a plain table.")
        if body and self.fps and self.fps != take.rate:
            picked = picks(take.rate, self.fps)
            how = f"one of {take.rate / self.fps:.0f}, as solved" if picked else "on splines through the solved ones"
            said.append(f"What moves has {self.fps:g} frames a second ({how}); markers keep the take's {take.rate:g}.")
        if body and self.floor:
            said.append(f"What moves is written {self.floor:g} m lower than the markers, for that high is their floor.")
        return said
