"""What is written of a cleaned take beside the usual files, and at which rate."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite

from mocapfix import rig
from mocapfix.animation import Animation
from mocapfix.errors import WriteError
from mocapfix.kinds import ALSO, BVH, USUAL, Kind, Moving, bvh_for, own_suffixes
from mocapfix.motion import Motion
from mocapfix.resample import picks, resampled
from mocapfix.subject import Subject
from mocapfix.table_layout import TableLayout
from mocapfix.take import Take
from mocapfix.words import worded

FASTEST = 1000.0  # frames a second


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
        rigs = [bvh_for(rig.load(name)) for name in dict.fromkeys(self.bvh_for)]
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
        asked = [kind for kind in self.kinds if kind not in (BVH, *USUAL) and kind.suffix not in own_suffixes(take.path)]
        said = [f"{kind.suffix} {worded(kind.note, take)}" for kind in asked if kind.note and (body or not kind.body)]
        whose = "whose joints are whose is not known" if isinstance(take.layout, Animation) else "the take has no skeleton"
        said += [f"There is no {kind.suffix}, for {whose}." for kind in asked if kind.body and not body]
        if isinstance(take.layout, TableLayout) and not take.layout.has_places:
            said.append(f"{take.name} lists only what was seen, so that the mended markers are written as a plain table.")
        if body and self.fps and self.fps != take.rate:
            picked = picks(take.rate, self.fps)
            how = f"one of {take.rate / self.fps:.0f}, as solved" if picked else "on splines through the solved ones"
            rest = "what was mended keeps" if isinstance(take.layout, Animation) else "markers keep"
            said.append(f"What moves has {self.fps:g} frames a second ({how}); {rest} the take's {take.rate:g}.")
        if body and self.floor:
            rest = "its own file" if isinstance(take.layout, Animation) else "the markers"
            said.append(f"What moves is written {self.floor:g} m lower than {rest}, for that high is the floor.")
        return said
