"""Sentences of the report about the files that are written."""

from mocapfix.files.layouts import TableLayout
from mocapfix.files.output_files import get_source_suffixes
from mocapfix.options import OutputOptions
from mocapfix.take import Take
from mocapfix.write.output_formats import BVH_FORMAT, DEFAULT_FORMATS, list_output_formats
from mocapfix.write.resampling import is_frame_subset


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
        is_json = take.path is not None and take.path.suffix.lower() == ".json"
        kind = "is JSON" if is_json else "lists only visible markers"
        notes.append(f"{take.name} {kind}, so the cleaned markers are written as a plain table.")
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
