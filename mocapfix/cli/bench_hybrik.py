"""The command `mocapfix bench hybrik`: measure HybrIK's closed form and the initialisations of the solve."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, print_json, show_progress, stdout_console

JITTER_FIGURE_NAME = "hybrik-jitter.png"
TWIST_FIGURE_NAME = "twist-distribution.png"


def run_bench_hybrik(
    data: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FOLDER", help="CMU motion with the test subjects; by default 1,000 shipped poses of theirs"),
    ] = None,
    captures: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="C3D files on which the initialisations are compared too")
    ] = None,
    figures: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="DIR",
            help=f"draw the errors into {JITTER_FIGURE_NAME} and, with --data, people's twists into {TWIST_FIGURE_NAME}",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Compare the variants of HybrIK on noisy joints, sources of a bone's twist, initialisations of the solve, and speed."""
    from mocapfix.bench.initialisation import measure_hybrik
    from mocapfix.files.output_files import make_output_folder

    if figures:
        make_output_folder(figures)
    with show_progress("hybrik") as progress:
        results: Mapping[str, Any] = measure_hybrik(data, captures, progress)
    if figures:
        draw_hybrik_figures(figures, data, results)
    if as_json:
        print_json(results)
        return EXIT_DONE
    stdout_console.print(f"{results['poses']:,} poses of people outside the training data; mm over all joints/body/hands")
    stdout_console.print(build_jitter_table("distance from the true joints", results["jitter_mm"], results["given_mm"]))
    stdout_console.print(build_jitter_table("distance from the given joints", results["from_given_mm"]))
    stdout_console.print(
        build_jitter_table("distance from the true joints, with another person's bones", results["wrong_bones_mm"])
    )
    stdout_console.print(build_twist_table(results["twist"]))
    closed_form_fps = ", ".join(f"{variant} {fps:,.0f}" for variant, fps in results["fps_by_way"].items())
    stdout_console.print(
        f"Frames per second on {results['threads']} threads: X {results['fps']:,.0f} from joints, "
        f"{results['from_markers_fps']:,.0f} from markers. Closed form alone, with given twists: {closed_form_fps}."
    )
    for name, rows in results["starts"].items():
        stdout_console.print(build_initialisation_table(name, rows))
    return EXIT_DONE


def draw_hybrik_figures(folder: Path, data: Path | None, results: Mapping[str, Any]) -> None:
    """Draw the errors on noisy joints and, if there is motion, the distribution of twists, into a folder."""
    from mocapfix.bench import pictures, twists

    pictures.draw_joint_noise(folder / JITTER_FIGURE_NAME, dict(results))
    if data:
        pictures.draw_twists(folder / TWIST_FIGURE_NAME, twists.compute_twist_distribution(data))


def build_jitter_table(title: str, results: Mapping[str, Any], unprocessed: Mapping[str, Any] | None = None) -> Table:
    """Return the errors of each variant by the noise of the joints.

    results      errors by part of the body, by variant, by noise in mm
    unprocessed  errors of the noisy joints themselves, by noise, for the first row
    """
    table = Table("", *(f"±{noise_mm} mm" for noise_mm in results), title=title, title_justify="left")
    rows: dict[str, Mapping[str, Any]] = {"as given": unprocessed} if unprocessed else {}
    rows |= {variant: {noise: by_variant[variant] for noise, by_variant in results.items()} for variant in results["0"]}
    for variant, row in rows.items():
        table.add_row(variant, *("/".join(f"{error:.1f}" for error in errors.values()) for errors in row.values()))
    return table


def build_twist_table(results: Mapping[str, Any]) -> Table:
    """Return the errors of joints, markers and twists by source of the twists."""
    table = Table("twists", *results)
    for key, heading in (("joints_mm", "joints, mm"), ("markers_mm", "markers, mm")):
        table.add_row(f"[bold]{heading}[/]", *(f"{row[key]:.1f}" for row in results.values()))
    table.add_section()
    for joint_name in next(iter(results.values()))["twist_deg"]:
        table.add_row(f"{joint_name}, degrees", *(f"{row['twist_deg'][joint_name]:.1f}" for row in results.values()))
    return table


def build_initialisation_table(takes: str, results: Mapping[str, Any]) -> Table:
    """Return the outcome of the solves of some takes by initialisation."""
    title = f"{takes}: {next(iter(results.values()))['frames']:,} frames"
    table = Table("", *results, title=title, title_justify="left")
    for key, heading, number_format in (
        ("start_markers_mm", "marker distance before the solve, mm", ".1f"),
        ("start_joints_mm", "joint error before the solve, mm", ".1f"),
        ("wrong_first_solve", "wrong frames, first solve", "d"),
        ("wrong", "wrong frames", "d"),
        ("wrong_from_start", "... but not when initialised with the truth", "d"),
        ("unconverged", "unconverged frames", "d"),
        ("iterations_first_solve", "iterations, first solve", ".1f"),
        ("iterations", "iterations", ".1f"),
        ("start_seconds", "initialisation, s", ".2f"),
        ("seconds", "initialisation and solve, s", ".2f"),
    ):
        table.add_row(heading, *("" if row[key] is None else format(row[key], number_format) for row in results.values()))
    return table
