"""The command that measures HybrIK's closed form: mocapfix bench hybrik."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.console import DONE, Json, out, staged

JITTER_FIGURE, TWIST_FIGURE = "hybrik-jitter.png", "twist-distribution.png"


def hybrik(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="CMU motion, of which the subjects of the benchmark are taken; "
                                   "by default 1,000 poses of theirs that ship")
    ] = None,
    captures: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="C3Ds on which starts of the solve are compared, too")
    ] = None,
    figures: Annotated[
        Path | None, tyro.conf.arg(metavar="DIR", help=f"draw the errors into {JITTER_FIGURE} there and, of --data, how people "
                                   f"twist their bones into {TWIST_FIGURE}")
    ] = None,
    as_json: Json = False,
) -> int:  # fmt: skip
    """Compare HybrIK's ways from joints that are off, whence a bone's twist may come, starts of the solve, and how fast it is."""
    from mocapfix.bench.hybrik import measure
    from mocapfix.files import make_folder

    if figures:
        make_folder(figures)
    with staged("hybrik") as progress:
        said = measure(data, captures, progress)
    if figures:
        drawn(figures, data, said)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return DONE
    out.print(f"{said['poses']:,} poses of people that no model has seen; mm over all joints/the body's/the hands'")
    out.print(over_jitter("from where joints truly are", said["jitter_mm"], said["given_mm"]))
    out.print(over_jitter("from where they were given", said["from_given_mm"]))
    out.print(over_jitter("from where they truly are, bones another's", said["wrong_bones_mm"]))
    out.print(of_twists(said["twist"]))
    alone = ", ".join(f"{way} {fps:,.0f}" for way, fps in said["fps_by_way"].items())
    out.print(f"Frames a second on {said['threads']} threads: X {said['fps']:,.0f} from joints, {said['from_markers_fps']:,.0f} "
              f"from markers. The closed form alone, twists given: {alone}.")  # fmt: skip
    for name, rows in said["starts"].items():
        out.print(of_starts(name, rows))
    return DONE


def drawn(folder: Path, data: Path | None, said: dict) -> None:
    from mocapfix.bench import pictures

    pictures.jitter(folder / JITTER_FIGURE, said)
    if data:
        from mocapfix.bench import twists

        pictures.twists(folder / TWIST_FIGURE, twists.distribution(data))


def over_jitter(title: str, said: dict[str, dict], given: dict[str, dict] | None = None) -> Table:
    """-> a way's errors a row, by how far joints are off; first those of the joints as they are given, where that is asked."""
    table = Table("", *(f"±{jitter} mm" for jitter in said), title=title, title_justify="left")
    rows = {"as given": given} if given else {}
    rows |= {way: {jitter: ways[way] for jitter, ways in said.items()} for way in said["0"]}
    for name, row in rows.items():
        table.add_row(name, *("/".join(f"{part:.1f}" for part in parts.values()) for parts in row.values()))
    return table


def of_twists(said: dict[str, dict]) -> Table:
    """-> where joints and markers come to lie, and every bone's error, by whence the twists are."""
    table = Table("twists", *said)
    for key, what in (("joints_mm", "joints, mm"), ("markers_mm", "markers, mm")):
        table.add_row(f"[bold]{what}[/]", *(f"{row[key]:.1f}" for row in said.values()))
    table.add_section()
    for joint in next(iter(said.values()))["twist_deg"]:
        table.add_row(f"{joint}, degrees", *(f"{row['twist_deg'][joint]:.1f}" for row in said.values()))
    return table


def of_starts(takes: str, said: dict[str, dict]) -> Table:
    """-> how solves of a set of takes end, by where they start."""
    title = f"{takes}: {next(iter(said.values()))['frames']:,} frames"
    table = Table("", *said, title=title, title_justify="left")
    for key, what, shown in (
        ("start_markers_mm", "off markers, mm", ".1f"),
        ("start_joints_mm", "off joints, mm", ".1f"),
        ("wrong_alone", "wrong, first solve", "d"),
        ("wrong", "wrong", "d"),
        ("astray", "... though right from the truth", "d"),
        ("unconverged", "unconverged", "d"),
        ("iterations_alone", "iterations, first solve", ".1f"),
        ("iterations", "iterations", ".1f"),
        ("start_seconds", "s, start", ".2f"),
        ("seconds", "s, start and solve", ".2f"),
    ):
        table.add_row(what, *("" if row[key] is None else format(row[key], shown) for row in said.values()))
    return table
