"""The commands about marker sets: `mocapfix marker-set list`, `show` and `learn`."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import OverwriteOption, TakeArgument, build_options_argument, describe_option, parse_options
from mocapfix.cli.console import EXIT_DONE, print_line, show_progress, stdout_console

if TYPE_CHECKING:
    from mocapfix.marker_set import MarkerSet

    ReadArguments = object
else:
    ReadArguments = build_options_argument(("read",))


def run_marker_set_list() -> int:
    """List the shipped marker sets."""
    from mocapfix.marker_sets import load_shipped_marker_sets

    table = Table("name", "title", "markers", "of them optional")
    for each in load_shipped_marker_sets():
        table.add_row(each.name, each.title, str(len(each.labels)), str(len(each.optional_labels)))
    stdout_console.print(table)
    return EXIT_DONE


def run_marker_set_show(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|FILE", help="a shipped set, or a YAML file")],
) -> int:
    """Show the markers of a set by segment, and their other names."""
    from mocapfix.marker_sets import load_marker_set

    marker_set = load_marker_set(name)
    stdout_console.print(f"[bold]{escape(marker_set.name)}[/]: {escape(marker_set.title)}, {len(marker_set.labels)} markers.")
    _print_segments(marker_set)
    named = zip(marker_set.labels, marker_set.aliases, strict=True)
    if aliases := [f"{label} ({', '.join(names)})" for label, names in named if names]:
        print_line(f"Other names: {escape(', '.join(aliases))}.")
    if optional := [label for label in marker_set.labels if label in marker_set.optional_labels]:
        print_line(f"Optional: {escape(', '.join(optional))}.")
    return EXIT_DONE


def run_marker_set_learn(
    take: TakeArgument,
    options: ReadArguments,
    output_path: Annotated[
        Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="NAME.yaml", help="the marker set to write")
    ],
    like: Annotated[
        str | None, describe_option("NAME|FILE", "a marker set to which some of the labels belong", "by the labels")
    ] = None,
    subject_prefix: Annotated[
        str | None, describe_option("NAME", 'the subject: "Jim" of Jim:LFHD', "the one with the most markers")
    ] = None,
    overwrite: OverwriteOption = False,
) -> int:
    """Learn a marker set from a take, for `clean --marker-set`: the segment and the offset of each marker.

    The person in the take should move all joints. Markers that move with no segment, such as those of a prop, are left out and
    listed. If the labels contain no known words, the body is located by the positions and the motion of the markers; then at
    least one frame must show the person standing.
    """
    from mocapfix.files.output_files import check_outputs_absent
    from mocapfix.marker_sets import write_marker_set
    from mocapfix.marker_sets.own_set import learn_marker_set

    check_outputs_absent([output_path], overwrite)
    with show_progress(take.name) as progress:
        learned = learn_marker_set(
            take,
            output_path.stem,
            like=like,
            subject_prefix=subject_prefix,
            options=parse_options(options).read,
            progress=progress,
        )
        write_marker_set(output_path, learned.marker_set, learned.file_comment)
    marker_count, residual_mm = len(learned.marker_set.labels), learned.mean_residual_m * 1e3
    print_line(f"[bold]{escape(str(output_path))}[/]: {marker_count} markers, mean residual {residual_mm:.1f} mm.")
    print_line(f"  {escape(learned.guess_description)}")
    _print_segments(learned.marker_set)
    for name, labels in learned.marker_set.props.items():
        print_line(f"  prop: {escape(name)}, {escape(', '.join(labels))}.")
    for label, joint_name in learned.ambiguous_markers.items():
        print_line(f"  ambiguous: {escape(label)} may be attached to {joint_name} instead.")
    for label, reason in learned.excluded_markers.items():
        print_line(f"  not included: {escape(label)} {escape(reason)}.")
    command = escape(shlex.join(["mocapfix", "clean", str(take), "--marker-set", str(output_path)]))
    print_line(f"  To clean with it: {command}")
    return EXIT_DONE


def _print_segments(marker_set: "MarkerSet") -> None:
    """Print the markers of each segment."""
    from mocapfix.skeleton import load_cmu31_body

    table = Table("segment", "markers")
    for joint in sorted(set(marker_set.joints.tolist())):
        labels = [label for label, j in zip(marker_set.labels, marker_set.joints, strict=True) if j == joint]
        table.add_row(load_cmu31_body().skeleton.names[joint], escape(", ".join(labels)))
    stdout_console.print(table)


MARKER_SET_COMMANDS = {"list": run_marker_set_list, "show": run_marker_set_show, "learn": run_marker_set_learn}
