"""What is written of a cleaned take beside the usual files, and at which rate."""

from dataclasses import replace
from functools import cache

from mocapfix.errors import WriteError
from mocapfix.files.layouts import TableLayout
from mocapfix.motion import Motion
from mocapfix.options import OutputOptions
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


@cache
def list_output_formats(options: OutputOptions) -> tuple[OutputFormat, ...]:
    """Return the formats of all files that are to be written, in this order.

    Raises SceneError if there is no such rig, WriteError if two formats would write the same file.
    """
    rigs = [build_rig_format(rig.load_rig(name)) for name in dict.fromkeys(options.rigs)]
    extra = [OPTIONAL_FORMATS[name] for name in dict.fromkeys(options.extra_formats)]
    formats = (BVH_FORMAT, *rigs, *extra, *DEFAULT_FORMATS)
    suffixes = [suffix for each in formats for suffix in each.all_suffixes]
    if repeated := [suffix for suffix in suffixes if suffixes.count(suffix) > 1]:
        raise WriteError(f"Two of the requested files would both have the suffix .{repeated[0]}; request one of them.")
    return formats


def build_exported_motion(
    options: OutputOptions, subject: Subject | None, motion: Motion | None, rate: float
) -> ExportedMotion | None:
    """-> somebody's motion at the wanted rate; None where there is nobody."""
    fps = options.output_rate_hz or rate
    if not (subject and motion):
        return None
    standing = (
        replace(motion, root_position=motion.root_position - [0.0, options.floor_height_m, 0.0])
        if options.floor_height_m
        else motion
    )
    return ExportedMotion(subject, resample_motion(standing, rate, fps), fps, options.floor_height_m)


def build_output_notes(options: OutputOptions, take: Take, has_body: bool) -> list[str]:
    """-> sentences on what was written otherwise than usual or beside it."""
    asked = [
        kind
        for kind in list_output_formats(options)
        if kind not in (BVH_FORMAT, *DEFAULT_FORMATS) and kind.suffix not in get_source_suffixes(take.path)
    ]
    said = [f"{kind.suffix} {kind.usage_note}" for kind in asked if kind.usage_note and (has_body or not kind.needs_body)]
    whose = "whose joints are whose is not known" if take.point_kind == "joint" else "the take has no skeleton"
    said += [f"There is no {kind.suffix}, for {whose}." for kind in asked if kind.needs_body and not has_body]
    if isinstance(take.layout, TableLayout) and not take.layout.has_field_per_sample:
        said.append(f"{take.name} lists only what was seen, so that the mended markers are written as a plain table.")
    if has_body and options.output_rate_hz and options.output_rate_hz != take.rate:
        picked = is_frame_subset(take.rate, options.output_rate_hz)
        how = f"one of {take.rate / options.output_rate_hz:.0f}, as solved" if picked else "on splines through the solved ones"
        rest = "what was mended keeps" if take.point_kind == "joint" else "markers keep"
        said.append(f"What moves has {options.output_rate_hz:g} frames a second ({how}); {rest} the take's {take.rate:g}.")
    if has_body and options.floor_height_m:
        rest = "its own file" if take.point_kind == "joint" else "the markers"
        said.append(f"What moves is written {options.floor_height_m:g} m lower than {rest}, for that high is the floor.")
    return said
