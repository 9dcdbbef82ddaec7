"""The kinds of file that cleaning a take may write: a line for each."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mocapfix import change_file, subject_file, write
from mocapfix.animation import Animation
from mocapfix.motion import Motion
from mocapfix.rig import Rig
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject
from mocapfix.table_layout import TableLayout
from mocapfix.take import Take

if TYPE_CHECKING:
    from mocapfix.result import Result

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
    worn    is there none without markers on it?
    stage   under which its time is counted
    note    what whoever opens it must know
    """

    suffix: str
    write: Callable[[Path, "Result", Any], object]
    brings: tuple[str, ...] = ()
    body: bool = False
    worn: bool = False
    stage: str = "write"
    note: str = ""

    @property
    def suffixes(self) -> tuple[str, ...]:
        return (self.suffix, *self.brings)


def _bvh(target: Path, result: "Result", moving: Moving) -> None:
    write.bvh(target, moving.skeleton, moving.motion, moving.rate)


def bvh_for(wanted: Rig) -> Kind:
    """-> a BVH as a program wants it."""
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
        take = result.places.with_markers(result.places.markers - [0.0, moving.floor, 0.0], result.places.deviation)
        write.npz(target, take, moving.skeleton, moving.motion, moving.rate)
    else:
        write.npz(target, result.places)


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
    write.new_c3d(target, result.places)


def _trc(target: Path, result: "Result", moving: Moving | None) -> None:
    write.trc(target, result.places)


def _csv(target: Path, result: "Result", moving: Moving | None) -> None:
    write.csv(target, result.places)


BVH = Kind("bvh", _bvh, body=True)
USUAL = (
    Kind("subject.yaml", _subject, body=True, worn=True),
    Kind("changes.yaml", _changes),
    Kind("rrd", _recording, stage="show"),
    Kind("report.html", _page, stage="show"),
    Kind("report.json", _report),  # the last, so that it has every other one's seconds
)
ALSO = {
    "gltf": Kind("glb", _gltf, body=True, note="is binary glTF: metres, Y up."),
    "amc": Kind("amc", _amc, ("asf",), body=True, note="goes with the asf: CMU's form, units of 56.444 mm, Y up."),
    "npz": Kind("npz", _npz),
    "c3d": Kind("c3d", _c3d, note="is new: the markers alone, with how sure each filled sample is."),
    "trc": Kind("trc", _trc),
    "csv": Kind("csv", _csv),
}


def mended(target: Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write the take's own file with only the changed samples replaced, or, where it has no place for every sample, a plain
    table instead; beside an AMC its skeleton, as it is. -> the (frame, marker) indices that could not be stored."""
    if isinstance(before.layout, Animation) and isinstance(after.layout, Animation):
        write.patched(target, before.layout, after.layout.values)
        if before.layout.skeleton:
            shutil.copyfile(before.layout.skeleton, target.with_suffix(".asf"))
        return []
    if isinstance(before.layout, TableLayout):
        if before.layout.has_places:
            return write.table(target, before, after)
        write.csv(target, after)
        return []
    return write.c3d(target, before, after)


def own_suffixes(source: Path | None) -> tuple[str, ...]:
    """-> the mended file's, the input's own, and with an AMC its skeleton's."""
    own = (source.suffix[1:].lower() if source else "") or "c3d"
    return ("amc", "asf") if own == "amc" else (own,)
