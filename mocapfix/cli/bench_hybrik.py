"""The command that measures HybrIK's closed form: mocapfix bench hybrik."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, show_progress, stdout_console

JITTER_FIGURE_NAME, TWIST_FIGURE_NAME = "hybrik-jitter.png", "twist-distribution.png"


def run_bench_hybrik(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="CMU motion, of which the subjects of the benchmark are taken; "
                                   "by default 1,000 poses of theirs that ship")
    ] = None,
    captures: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="C3Ds on which starts of the solve are compared, too")
    ] = None,
    figures: Annotated[
        Path | None, tyro.conf.arg(metavar="DIR", help=f"draw the errors into {JITTER_FIGURE_NAME} there and, of --data, how people "
                                   f"twist their bones into {TWIST_FIGURE_NAME}")
    ] = None,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Compare HybrIK's ways from joints that are off, whence a bone's twist may come, starts of the solve, and how fast it is."""
    from mocapfix.bench.hybrik import measure_hybrik
    from mocapfix.files.output_files import make_output_folder

    if figures:
        make_output_folder(figures)
    with show_progress("hybrik") as progress:
        said = measure_hybrik(data, captures, progress)
    if figures:
        draw_hybrik_figures(figures, data, said)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return EXIT_DONE
    stdout_console.print(f"{said['poses']:,} poses of people that no model has seen; mm over all joints/the body's/the hands'")
    stdout_console.print(build_jitter_table("from where joints truly are", said["jitter_mm"], said["given_mm"]))
    stdout_console.print(build_jitter_table("from where they were given", said["from_given_mm"]))
    stdout_console.print(build_jitter_table("from where they truly are, bones another's", said["wrong_bones_mm"]))
    stdout_console.print(build_twist_table(said["twist"]))
    alone = ", ".join(f"{way} {fps:,.0f}" for way, fps in said["fps_by_way"].items())
    stdout_console.print(f"Frames a second on {said['threads']} threads: X {said['fps']:,.0f} from joints, {said['from_markers_fps']:,.0f} "
              f"from markers. The closed form alone, twists given: {alone}.")  # fmt: skip
    for name, rows in said["starts"].items():
        stdout_console.print(build_start_table(name, rows))
    return EXIT_DONE


def draw_hybrik_figures(folder: Path, data: Path | None, results: dict) -> None:
    from mocapfix.bench import pictures

    pictures.draw_joint_noise(folder / JITTER_FIGURE_NAME, results)
    if data:
        from mocapfix.bench import twists

        pictures.draw_twists(folder / TWIST_FIGURE_NAME, twists.compute_twist_distribution(data))


def build_jitter_table(title: str, results: dict[str, dict], unprocessed: dict[str, dict] | None = None) -> Table:
    """-> a way's errors a row, by how far joints are off; first those of the joints as they are given, where that is asked."""
    table = Table("", *(f"±{jitter} mm" for jitter in results), title=title, title_justify="left")
    rows = {"as given": unprocessed} if unprocessed else {}
    rows |= {way: {jitter: ways[way] for jitter, ways in results.items()} for way in results["0"]}
    for name, row in rows.items():
        table.add_row(name, *("/".join(f"{part:.1f}" for part in parts.values()) for parts in row.values()))
    return table


def build_twist_table(results: dict[str, dict]) -> Table:
    """-> where joints and markers come to lie, and every bone's error, by whence the twists are."""
    table = Table("twists", *results)
    for key, what in (("joints_mm", "joints, mm"), ("markers_mm", "markers, mm")):
        table.add_row(f"[bold]{what}[/]", *(f"{row[key]:.1f}" for row in results.values()))
    table.add_section()
    for joint in next(iter(results.values()))["twist_deg"]:
        table.add_row(f"{joint}, degrees", *(f"{row['twist_deg'][joint]:.1f}" for row in results.values()))
    return table


def build_start_table(takes: str, results: dict[str, dict]) -> Table:
    """-> how solves of a set of takes end, by where they start."""
    title = f"{takes}: {next(iter(results.values()))['frames']:,} frames"
    table = Table("", *results, title=title, title_justify="left")
    for key, what, shown in (
        ("start_markers_mm", "off markers, mm", ".1f"),
        ("start_joints_mm", "off joints, mm", ".1f"),
        ("wrong_first_solve", "wrong, first solve", "d"),
        ("wrong", "wrong", "d"),
        ("wrong_from_start", "... though not wrong from the truth", "d"),
        ("unconverged", "unconverged", "d"),
        ("iterations_first_solve", "iterations, first solve", ".1f"),
        ("iterations", "iterations", ".1f"),
        ("start_seconds", "s, start", ".2f"),
        ("seconds", "s, start and solve", ".2f"),
    ):
        table.add_row(what, *("" if row[key] is None else format(row[key], shown) for row in results.values()))
    return table
