"""What is written of a cleaned take beside the usual files, and at which rate."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite

from mocapfix.animation import Animation
from mocapfix.errors import WriteError
from mocapfix.files.layouts import TableLayout
from mocapfix.motion import Motion
from mocapfix.subject import Subject
from mocapfix.take import Take
from mocapfix.write import rig
from mocapfix.write.output_formats import (
    BVH_FORMAT,
    DEFAULT_FORMATS,
    OPTIONAL_FORMATS,
    ExportedMotion,
    OutputFormat,
    build_rig_format,
    get_source_suffixes,
)
from mocapfix.write.resampling import is_frame_subset, resample_motion

MAX_OUTPUT_RATE_HZ = 1000.0  # frames a second


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
        if strange := [kind for kind in self.also if kind not in OPTIONAL_FORMATS]:
            raise WriteError(f"There is no kind of file {strange[0]!r} to write; choose of: {', '.join(OPTIONAL_FORMATS)}.")
        if self.fps is not None and not 0 < self.fps <= MAX_OUTPUT_RATE_HZ:
            raise WriteError(f"Frames a second must be more than 0 and at most {MAX_OUTPUT_RATE_HZ:g}, not {self.fps:g}.")
        if not isfinite(self.floor):
            raise WriteError(f"A floor must lie at some height in metres, not {self.floor:g}.")
        suffixes = [suffix for kind in self.formats for suffix in kind.all_suffixes]
        if twice := [suffix for suffix in suffixes if suffixes.count(suffix) > 1]:
            raise WriteError(f"Two of what is to be written would both be called .{twice[0]}; name one of them.")

    @cached_property
    def formats(self) -> tuple[OutputFormat, ...]:
        """-> everything that is to be written, in this order."""
        rigs = [build_rig_format(rig.load_rig(name)) for name in dict.fromkeys(self.bvh_for)]
        return (BVH_FORMAT, *rigs, *(OPTIONAL_FORMATS[name] for name in dict.fromkeys(self.also)), *DEFAULT_FORMATS)

    def build_exported_motion(self, subject: Subject | None, motion: Motion | None, rate: float) -> ExportedMotion | None:
        """-> somebody's motion at the wanted rate; None where there is nobody."""
        fps = self.fps or rate
        if not (subject and motion):
            return None
        standing = replace(motion, root_position=motion.root_position - [0.0, self.floor, 0.0]) if self.floor else motion
        return ExportedMotion(subject, resample_motion(standing, rate, fps), fps, self.floor)

    def build_notes(self, take: Take, has_body: bool) -> list[str]:
        """-> sentences on what was written otherwise than usual or beside it."""
        asked = [
            kind
            for kind in self.formats
            if kind not in (BVH_FORMAT, *DEFAULT_FORMATS) and kind.suffix not in get_source_suffixes(take.path)
        ]
        said = [f"{kind.suffix} {kind.usage_note}" for kind in asked if kind.usage_note and (has_body or not kind.needs_body)]
        whose = "whose joints are whose is not known" if isinstance(take.layout, Animation) else "the take has no skeleton"
        said += [f"There is no {kind.suffix}, for {whose}." for kind in asked if kind.needs_body and not has_body]
        if isinstance(take.layout, TableLayout) and not take.layout.has_field_per_sample:
            said.append(f"{take.name} lists only what was seen, so that the mended markers are written as a plain table.")
        if has_body and self.fps and self.fps != take.rate:
            picked = is_frame_subset(take.rate, self.fps)
            how = f"one of {take.rate / self.fps:.0f}, as solved" if picked else "on splines through the solved ones"
            rest = "what was mended keeps" if isinstance(take.layout, Animation) else "markers keep"
            said.append(f"What moves has {self.fps:g} frames a second ({how}); {rest} the take's {take.rate:g}.")
        if has_body and self.floor:
            rest = "its own file" if isinstance(take.layout, Animation) else "the markers"
            said.append(f"What moves is written {self.floor:g} m lower than {rest}, for that high is the floor.")
        return said
