"""The output files that options request, the motion that is written to them, and notes about both."""

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
    """Return the motion at the output rate and with the floor at height 0; None if there is no body.

    Args:
        options: Output rate and floor height.
        subject: The subject.
        motion: Its motion.
        rate: Frames per second of the motion.
    """
    if not (subject and motion):
        return None
    output_rate, floor_height_m = options.output_rate_hz or rate, options.floor_height_m
    if floor_height_m:
        motion = replace(motion, root_position=motion.root_position - [0.0, floor_height_m, 0.0])
    return ExportedMotion(subject, resample_motion(motion, rate, output_rate), output_rate, floor_height_m)


def build_output_notes(options: OutputOptions, take: Take, has_body: bool) -> list[str]:
    """Return sentences about requested formats, formats that are not written, and a changed rate or height."""
    is_animation = take.point_kind == "joint"
    requested = [
        each
        for each in list_output_formats(options)
        if each not in (BVH_FORMAT, *DEFAULT_FORMATS) and each.suffix not in get_source_suffixes(take.path)
    ]
    notes = [f"{each.suffix} {each.usage_note}" for each in requested if each.usage_note and (has_body or not each.needs_body)]
    reason = "the joints could not be identified" if is_animation else "the take has no body"
    notes += [f"{each.suffix} is not written: {reason}." for each in requested if each.needs_body and not has_body]
    if isinstance(take.layout, TableLayout) and not take.layout.has_field_per_sample:
        notes.append(f"{take.name} lists only visible markers, so the cleaned markers are written as a plain table.")
    output_rate = options.output_rate_hz
    if has_body and output_rate and output_rate != take.rate:
        is_subset = is_frame_subset(take.rate, output_rate)
        method = f"one of {take.rate / output_rate:.0f} solved frames" if is_subset else "splines between the solved frames"
        other = "the cleaned file keeps" if is_animation else "markers keep"
        notes.append(f"Motion files have {output_rate:g} frames per second ({method}); {other} {take.rate:g}.")
    if has_body and options.floor_height_m:
        other = "the cleaned file" if is_animation else "the markers"
        notes.append(f"Motion files are {options.floor_height_m:g} m lower than {other}, so that their floor is at height 0.")
    return notes
