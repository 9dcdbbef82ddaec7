"""The commands about marker sets: mocapfix marker-set list | show | learn."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli_arguments import Up, shown
from mocapfix.console import DONE, Flag, out, staged

if TYPE_CHECKING:
    from mocapfix.marker_set import MarkerSet


def list_sets() -> int:
    """List the marker sets that travel with mocapfix."""
    from mocapfix.marker_set import shipped

    table = Table("name", "what it is", "markers", "of them it may do without")
    for each in shipped():
        table.add_row(each.name, each.title, str(len(each.labels)), str(len(each.optional)))
    out.print(table)
    return DONE


def show(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|FILE", help="a shipped set, or a YAML file")],
) -> int:
    """Show a marker set: which markers ride on which segment, and how else they are called."""
    from mocapfix.marker_set import load

    worn = load(name)
    out.print(f"[bold]{escape(worn.name)}[/]: {escape(worn.title)}, {len(worn.labels)} markers.")
    _segments(worn)
    aliases = [f"{label} ({', '.join(also)})" for label, also in zip(worn.labels, worn.aliases, strict=True) if also]
    if aliases:
        out.print(f"Also called: {escape(', '.join(aliases))}.", soft_wrap=True)
    if worn.optional:
        out.print(f"It may do without: {escape(', '.join(x for x in worn.labels if x in worn.optional))}.", soft_wrap=True)
    return DONE


def learn(
    take: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TAKE", help="a capture of somebody who moves all joints")],
    path: Annotated[Path, tyro.conf.arg(name="output", aliases=["-o"], metavar="NAME.yaml", help="the marker set to write")],
    like: Annotated[str | None, shown("NAME|FILE", "a set that some of the labels are from", "by the labels")] = None,
    subject_prefix: Annotated[str | None, shown("NAME", 'whose set: "Jim" of Jim:LFHD', "who wears the most markers")] = None,
    up: Up = None,
    overwrite: Annotated[Flag, tyro.conf.arg(help="replace a file that is there")] = False,
) -> int:
    """Learn a marker set of your own from a take, to be given to `clean --marker-set`: what rides on which segment, and where.

    What moves with no segment, a prop or a floor marker, is left out and named. With labels that say nothing the whole body is
    found by how it stands and moves; then some frame must show somebody standing.
    """
    from mocapfix import learning, marker_set
    from mocapfix.files import check_not_there

    check_not_there([path], overwrite)
    with staged(take.name) as progress:
        lesson = learning.learnt(take, path.stem, like, subject_prefix, up, progress)
        marker_set.save(path, lesson.marker_set, lesson.comment)
    worn, off = lesson.marker_set, lesson.residual * 1e3
    out.print(f"[bold]{escape(str(path))}[/]: {len(worn.labels)} markers, {off:.1f} mm from the body on average.", soft_wrap=True)
    out.print(f"  {escape(lesson.how)}", soft_wrap=True)
    _segments(worn)
    for label, segment in lesson.doubtful.items():
        out.print(f"  not sure: {escape(label)} may as well ride on {segment}.", soft_wrap=True)
    for label, reason in lesson.left_out.items():
        out.print(f"  left out: {escape(label)} {escape(reason)}.", soft_wrap=True)
    command = escape(shlex.join(["mocapfix", "clean", str(take), "--marker-set", str(path)]))
    out.print(f"  To clean with it: {command}", soft_wrap=True)
    return DONE


def _segments(worn: "MarkerSet") -> None:
    """Print which markers ride on which segment."""
    from mocapfix.skeleton import cmu31

    table = Table("segment", "markers")
    for joint in sorted(set(worn.joints.tolist())):
        markers = [label for label, j in zip(worn.labels, worn.joints, strict=True) if j == joint]
        table.add_row(cmu31().skeleton.names[joint], escape(", ".join(markers)))
    out.print(table)


MARKER_SETS = {"list": list_sets, "show": show, "learn": learn}
