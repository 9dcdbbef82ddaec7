"""The commands about marker sets: mocapfix marker-set list | show | learn."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import FlagOption, UpAxisOption, describe_option
from mocapfix.cli.console import EXIT_DONE, show_progress, stdout_console

if TYPE_CHECKING:
    from mocapfix.marker_sets import MarkerSet


def run_marker_set_list() -> int:
    """List the marker sets that travel with mocapfix."""
    from mocapfix.marker_sets import load_shipped_marker_sets

    table = Table("name", "what it is", "markers", "of them it may do without")
    for each in load_shipped_marker_sets():
        table.add_row(each.name, each.title, str(len(each.labels)), str(len(each.optional_labels)))
    stdout_console.print(table)
    return EXIT_DONE


def run_marker_set_show(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|FILE", help="a shipped set, or a YAML file")],
) -> int:
    """Show a marker set: which markers ride on which segment, and how else they are called."""
    from mocapfix.marker_sets import load_marker_set

    worn = load_marker_set(name)
    stdout_console.print(f"[bold]{escape(worn.name)}[/]: {escape(worn.title)}, {len(worn.labels)} markers.")
    _print_segments(worn)
    aliases = [f"{label} ({', '.join(also)})" for label, also in zip(worn.labels, worn.aliases, strict=True) if also]
    if aliases:
        stdout_console.print(f"Also called: {escape(', '.join(aliases))}.", soft_wrap=True)
    if worn.optional_labels:
        stdout_console.print(
            f"It may do without: {escape(', '.join(x for x in worn.labels if x in worn.optional_labels))}.", soft_wrap=True
        )
    return EXIT_DONE


def run_marker_set_learn(
    take: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TAKE", help="a capture of somebody who moves all joints")],
    output_path: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="NAME.yaml", help="the marker set to write")
    ],
    like: Annotated[str | None, describe_option("NAME|FILE", "a set that some of the labels are from", "by the labels")] = None,
    subject_prefix: Annotated[
        str | None, describe_option("NAME", 'whose set: "Jim" of Jim:LFHD', "who wears the most markers")
    ] = None,
    up: UpAxisOption = None,
    overwrite: Annotated[FlagOption, tyro.conf.arg(help="replace a file that is there")] = False,
) -> int:
    """Learn a marker set of your own from a take, to be given to `clean --marker-set`: what rides on which segment, and where.

    What moves with no segment, a prop or a floor marker, is left out and named. With labels that say nothing the whole body is
    found by how it stands and moves; then some frame must show somebody standing.
    """
    from mocapfix import marker_sets
    from mocapfix.files.output_files import check_outputs_absent
    from mocapfix.marker_sets import learning

    check_outputs_absent([output_path], overwrite)
    with show_progress(take.name) as progress:
        lesson = learning.learn_marker_set(take, output_path.stem, like, subject_prefix, up, progress)
        marker_sets.write_marker_set(output_path, lesson.marker_set, lesson.file_comment)
    worn, off = lesson.marker_set, lesson.mean_residual_m * 1e3
    stdout_console.print(
        f"[bold]{escape(str(output_path))}[/]: {len(worn.labels)} markers, {off:.1f} mm from the body on average.", soft_wrap=True
    )
    stdout_console.print(f"  {escape(lesson.guess_description)}", soft_wrap=True)
    _print_segments(worn)
    for label, segment in lesson.ambiguous_markers.items():
        stdout_console.print(f"  not sure: {escape(label)} may as well ride on {segment}.", soft_wrap=True)
    for label, reason in lesson.excluded_markers.items():
        stdout_console.print(f"  left out: {escape(label)} {escape(reason)}.", soft_wrap=True)
    command = escape(shlex.join(["mocapfix", "clean", str(take), "--marker-set", str(output_path)]))
    stdout_console.print(f"  To clean with it: {command}", soft_wrap=True)
    return EXIT_DONE


def _print_segments(marker_set: "MarkerSet") -> None:
    """Print which markers ride on which segment."""
    from mocapfix.skeleton import load_cmu31_body

    table = Table("segment", "markers")
    for joint in sorted(set(marker_set.joints.tolist())):
        markers = [label for label, j in zip(marker_set.labels, marker_set.joints, strict=True) if j == joint]
        table.add_row(load_cmu31_body().skeleton.names[joint], escape(", ".join(markers)))
    stdout_console.print(table)


MARKER_SET_COMMANDS = {"list": run_marker_set_list, "show": run_marker_set_show, "learn": run_marker_set_learn}
