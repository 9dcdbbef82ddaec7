"""The commands that repeat the experiments of papers: `mocapfix bench hybrik` (HybrIK), `bench prior` and `bench hands` (MNN-IK).

They measure HybrIK's closed form, the initialisations of the solve, and the pose priors.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, print_json, print_line, show_progress, stdout_console

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
    from mocapfix.bench import hybrik_tables, pictures

    pictures.draw_joint_noise(folder / JITTER_FIGURE_NAME, dict(results))
    if data:
        pictures.draw_twists(folder / TWIST_FIGURE_NAME, hybrik_tables.compute_twist_distribution(data))


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


def run_bench_prior(
    data: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default 1,000 shipped poses of theirs"),
    ] = None,
    frames: Annotated[int, tyro.conf.arg(metavar="N", help="number of poses")] = 1000,
    paper_split: Annotated[
        Path | None,
        tyro.conf.arg(
            metavar="FOLDER", help="weights trained with --interleaved: repeat MNN-IK's test on its own split; needs --data"
        ),
    ] = None,
    figure: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png", help="draw the errors over the iterations")] = None,
    as_json: JsonOption = False,
) -> int:
    """Compare the pose priors: few joints given as in MNN-IK, all joints given, missing limbs, and frames per second."""
    from mocapfix.bench import pictures
    from mocapfix.bench.pose_priors import measure_pose_priors
    from mocapfix.files.output_files import make_output_folder

    if figure:
        make_output_folder(figure.parent)
    with show_progress("prior") as progress:
        results: dict[str, Any] = measure_pose_priors(data, frames, paper_split, figure is not None, progress)
    default = results["default"]
    if figure:
        pictures.draw_iterations(figure, results["iterations"], default)
    if as_json:
        print_json(results)
        return EXIT_DONE
    title = f"{results['poses']} poses of people outside the training data"
    stdout_console.print(build_given_joints_table(title, results, default))
    if "paper_split" in results:
        title = "split of the MNN-IK paper: frames between those of the training data"
        stdout_console.print(build_given_joints_table(title, results["paper_split"], default))
    table = Table("all joints given", "bias, mm", "error with noise of 3 mm, mm", "twist, degrees")
    for name, row in results["all_joints"].items():
        table.add_row(name, f"{row['bias_mm']:.2f}", f"{row['noisy_mm']:.2f}", f"{row['twist_deg']:.1f}")
    stdout_console.print(table)
    if results["limb"]:
        stdout_console.print(build_limb_table(results["limb"]))
    stdout_console.print(
        f"{default}: {results['fps']:,.0f} frames per second with 10 given joints, initialised with a smoothed motion; "
        f"{results['fps_from_mean_pose']:,.0f} initialised with the mean pose."
    )
    return EXIT_DONE


def build_limb_table(results: Mapping[str, Any]) -> Table:
    """Return the errors of a missing limb's joints, of mocapfix and of each method alone."""
    gaps = [(limb, duration_s) for limb in ("arm", "leg") for duration_s in results[limb]]
    table = Table("joints of a missing limb, mm", *(f"{limb}, {duration_s} s" for limb, duration_s in gaps))
    for method, row in (("[bold]mocapfix[/]", results), *results["ways"].items()):
        table.add_row(method, *(f"{row[limb][duration_s]:.0f}" for limb, duration_s in gaps))
    return table


def build_given_joints_table(title: str, results: Mapping[str, Any], default: str) -> Table:
    """Return MNN-IK's table: the errors of each prior by the number of given joints.

    default  the name of the prior that the caption compares with the others
    """
    by_count = results["given_joints"]
    table = Table("mm / degrees", *(f"{count} joints" for count in by_count), title=title, title_justify="left")
    for name in next(iter(by_count.values())):
        cells = [
            f"{row['position_mm']:.1f} ± {row['position_sd']:.0f} / {row['rotation_deg']:.1f} ± {row['rotation_sd']:.0f}"
            for row in (by_name[name] for by_name in by_count.values())
        ]
        table.add_row(name, *cells)
    improvements = [
        f"{row['position_percent']:.0f} and {row['rotation_percent']:.0f} % better than {name}"
        for name, row in results["better"].items()
    ]
    table.caption = f"{default} is {', '.join(improvements)} (mean of the columns)"
    return table


def run_bench_hands(
    one_marker: Annotated[
        Path, tyro.conf.arg(metavar="TAKE", help="a C3D with CMU's 41 markers, of which one is kept on the right hand")
    ],
    crossed: Annotated[Path, tyro.conf.arg(metavar="TAKE", help="a take in which the hands meet; noise is added")],
    output_folder: Annotated[
        Path, tyro.conf.arg(name="out", aliases=["-o"], metavar="DIR", help="folder for the two pictures")
    ] = Path(),
    as_json: JsonOption = False,
) -> int:
    """Damage the hands in two sound captures as in section 5.1 of MNN-IK, clean them, and draw both."""
    from mocapfix.bench import hands, pictures
    from mocapfix.files.output_files import make_output_folder

    make_output_folder(output_folder)
    results: dict[str, dict[str, float]] = {}
    for name, path, damage in (
        ("hand-one-marker", one_marker, hands.ONE_MARKER_DAMAGE),
        ("crossed-hands", crossed, hands.CROSSED_HANDS_DAMAGE),
    ):
        with show_progress(path.name):
            comparison = hands.compare_hands(path, damage)
        picture = output_folder / f"{name}.png"
        pictures.draw_hands(picture, comparison)
        results[name] = {"alone_mm": comparison.markers_only_mm, "cleaned_mm": comparison.cleaned_mm}
        if not as_json:
            errors = f"error {comparison.markers_only_mm:.0f} mm from the markers alone, {comparison.cleaned_mm:.0f} mm cleaned"
            print_line(f"{escape(str(picture))}: {errors}.")
    if as_json:
        print_json(results)
    return EXIT_DONE
