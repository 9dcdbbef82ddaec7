"""The commands that measure pose priors: mocapfix bench prior, mocapfix bench hands."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, show_progress, stdout_console


def run_bench_prior(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="motion, of which the subjects of the benchmark are taken; "
                                   "by default 1,000 poses of theirs that ship")
    ] = None,
    frames: Annotated[int, tyro.conf.arg(metavar="N", help="how many poses")] = 1000,
    paper_split: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="weights trained with --interleaved: do MNN-IK's test on its own "
                                   "split, too; needs --data")
    ] = None,
    figure: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png", help="draw the errors over the iterations")] = None,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Compare the pose priors: from a few joints as MNN-IK does, from all of them, on lost limbs, and in frames a second."""
    from mocapfix.bench.pose_priors import measure_pose_priors
    from mocapfix.files.output_files import make_output_folder

    if figure:
        make_output_folder(figure.parent)
    with show_progress("prior") as progress:
        said = measure_pose_priors(data, frames, paper_split, figure is not None, progress)
    if figure:
        from mocapfix.bench import pictures

        pictures.draw_iterations(figure, said["iterations"], said["default"])
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return EXIT_DONE
    stdout_console.print(
        build_given_joints_table(f"{said['poses']} poses of people that no prior has seen", said, said["default"])
    )
    if "paper_split" in said:
        split = "the paper's own split: frames between those that were learned from"
        stdout_console.print(build_given_joints_table(split, said["paper_split"], said["default"]))
    table = Table("all joints given", "places moved, mm", "error amid noise of 3 mm, mm", "twist, degrees")
    for name, row in said["all_joints"].items():
        table.add_row(name, f"{row['bias_mm']:.2f}", f"{row['noisy_mm']:.2f}", f"{row['twist_deg']:.1f}")
    stdout_console.print(table)
    if said["limb"]:
        stdout_console.print(build_limb_table(said["limb"]))
    stdout_console.print(
        f"{said['default']}: {said['fps']:,.0f} frames a second of which 10 joints are given, from a course through time; "
        f"{said['fps_from_mean_pose']:,.0f} from the mean pose."
    )
    return EXIT_DONE


def build_limb_table(results: dict) -> Table:
    """-> how far a lost limb is off, by the whole solve and by each way alone."""
    lost = [(limb, seconds) for limb in ("arm", "leg") for seconds in results[limb]]
    table = Table("a lost limb's joints, mm off", *(f"{limb}, {seconds} s" for limb, seconds in lost))
    for way, row in (("[bold]mocapfix[/]", results), *results["ways"].items()):
        table.add_row(way, *(f"{row[limb][seconds]:.0f}" for limb, seconds in lost))
    return table


def build_given_joints_table(title: str, results: dict, default: str) -> Table:
    """-> MNN-IK's table: every prior's errors by how many joints are given."""
    table = Table("mm / degrees", *(f"{count} joints" for count in results["given_joints"]), title=title, title_justify="left")
    for name in next(iter(results["given_joints"].values())):
        rows = [by_name[name] for by_name in results["given_joints"].values()]
        table.add_row(
            name,
            *(
                f"{row['position_mm']:.1f} ± {row['position_sd']:.0f} / {row['rotation_deg']:.1f} ± {row['rotation_sd']:.0f}"
                for row in rows
            ),
        )
    better = (
        f"{row['position_percent']:.0f} and {row['rotation_percent']:.0f} % better than {name}"
        for name, row in results["better"].items()
    )
    table.caption = f"{default} is {', '.join(better)} (mean of the columns)"
    return table


def run_bench_hands(
    one_marker: Annotated[Path, tyro.conf.arg(metavar="TAKE", help="a C3D in CMU's 41 markers; one stays on the right hand")],
    crossed: Annotated[Path, tyro.conf.arg(metavar="TAKE", help="one in which the hands come together, to be shaken")],
    output_folder: Annotated[Path, tyro.conf.arg(name="out", metavar="DIR", help="where the two pictures go")] = Path(),
    as_json: JsonOption = False,
) -> int:
    """Damage the hands of two sound captures as MNN-IK's section 5.1 does, clean them, and draw before and after."""
    from mocapfix.bench import hands, pictures
    from mocapfix.files.output_files import make_output_folder

    make_output_folder(output_folder)
    said = {}
    for name, path, damage in (
        ("hand-one-marker", one_marker, hands.ONE_MARKER_DAMAGE),
        ("crossed-hands", crossed, hands.CROSSED_HANDS_DAMAGE),
    ):
        with show_progress(path.name):
            moment = hands.compare_hands(path, damage)
        pictures.draw_hands(output_folder / f"{name}.png", moment)
        said[name] = {"alone_mm": moment.markers_only_mm, "cleaned_mm": moment.cleaned_mm}
        if not as_json:
            errors = f"{moment.markers_only_mm:.0f} mm off by the markers alone, {moment.cleaned_mm:.0f} mm cleaned"
            stdout_console.print(f"{escape(str(output_folder / name))}.png: {errors}.", soft_wrap=True)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
    return EXIT_DONE


PRIOR_BENCH_COMMANDS = {"prior": run_bench_prior, "hands": run_bench_hands}
