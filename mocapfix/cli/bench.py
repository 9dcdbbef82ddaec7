"""The command that measures how animations are mended: mocapfix bench animations."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli.arguments import FlagOption, JsonOption
from mocapfix.cli.bench_hybrik import run_bench_hybrik
from mocapfix.cli.bench_prior import PRIOR_BENCH_COMMANDS
from mocapfix.cli.console import EXIT_DONE, show_progress, stdout_console


# MERGED: mocapfix.cli_bench_animations
def run_bench_animations(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="CMU motion, its test people; by default motion is composed")
    ] = None,
    trials: Annotated[int, tyro.conf.arg(metavar="N", help="how many trials each kind of fault is put into")] = 12,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="which faults are drawn (a number)")] = 0,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Put pops, flips, jitter and lost spans into sound animations, clean them, and compare with linear interpolation."""
    from mocapfix.bench.animation_repair import measure_animation_repair

    with show_progress("animations") as progress:
        said = measure_animation_repair(data, trials, seed, progress)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return EXIT_DONE
    told = ("mended, told where", "mended, found", "of linear: told", "found")
    table = Table("joint error, mm", "faults", "found", "linear", *told)
    for kind, lengths in said["rows"].items():
        for length, row in lengths.items():
            errors = [f"{row[f'{way}_mm']:.1f}" for way in ("linear", "told", "found")]
            shares = [f"{row[f'{way}_over_linear']:.2f}" for way in ("told", "found")]
            table.add_row(f"{kind}, {length}", str(row["faults"]), f"{row['found']:.0%}", *errors, *shares)
    table.add_section()
    for length, row in said["pooled"].items():
        table.add_row(f"all, {length}", "", "", "", "", "", *(f"{row[way]:.2f}" for way in ("told", "found") if row))
    stdout_console.print(table)
    alarms = ", ".join(f"{kind} {count:.1f}" for kind, count in said["alarms_per_minute"].items()) or "none"
    stdout_console.print(f"Short is 0.2 to 0.5 s, long 0.5 to 1 s. Alarms a minute in the sound trials: {alarms}.")
    stdout_console.print(f"Of the sound samples {said['touched']:.2%} were changed.")
    return EXIT_DONE


# MERGED: mocapfix.cli_bench_faults
# The command that measures what is found of faults, and how well it is mended: mocapfix bench faults.
FAULT_COLUMNS = (
    ("recall", "found", ".0%"),
    ("overlap", "overlap", ".0%"),
    ("false_alarms_per_minute", "false alarms a minute", ".1f"),
    ("predicted_mm", "predicted error, mm", ".1f"),
    ("true_mm", "true error, mm", ".1f"),
)


def run_bench_faults(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="CMU motion, of whose test people the takes are made; by default "
                                   "takes are composed")
    ] = None,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="how many takes each kind of fault is put into")] = 6,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Put faults of every kind into sound takes with known truth, clean them, and say what was found and how it was mended."""
    from mocapfix.bench.fault_detection import measure_fault_detection

    with show_progress("faults") as progress:
        said = measure_fault_detection(data, takes, progress)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return EXIT_DONE
    table = Table("kind", *(what for _, what, _ in FAULT_COLUMNS))
    for kind, row in said.items():
        if kind == "all":
            table.add_section()
        table.add_row(kind, *("" if row[key] is None else format(row[key], shown) for key, _, shown in FAULT_COLUMNS))
    stdout_console.print(table)
    stdout_console.print("The false alarms of all kinds together are those in the same takes without any faults.")
    return EXIT_DONE


# MERGED: mocapfix.cli_bench
# The commands that measure mocapfix against what is known to be true: mocapfix bench ...
def run_bench_solver(
    as_json: JsonOption = False,
    quick: Annotated[FlagOption, tyro.conf.arg(help="time everything a few times only: in seconds, but roughly")] = False,
) -> int:
    """Time the solver: beside scipy on a task with known truth, and SCOPE's experiments beside a dense solve."""
    from mocapfix.bench.solver_speed import measure_in_fresh_process

    with show_progress("solver"):
        said = measure_in_fresh_process(quick)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return EXIT_DONE
    table = Table("the common task", "clean", "noisy", title=f"600 frames, 53 markers, 31 joints; {said['threads']} threads")
    for key, what, shown in (
        ("fps_one_thread", "frames a second, one thread", ",.0f"),
        ("fps_all_threads", "frames a second, all threads", ",.0f"),
        ("scipy_fps", f"scipy's, of {said['scipy_frames']} frames", ",.0f"),
        ("over_scipy", "times scipy's, one thread", ".0f"),
        ("joint_error_mm", "joint error, mm", ".2f"),
    ):
        table.add_row(what, *(format(said[key][name], shown) for name in ("clean", "noisy")))
    stdout_console.print(table)
    table = Table("experiment", "joints", "numbers measured", "shape parameters", "us", "dense, us", "times as fast")
    for row in said["experiments"]:
        table.add_row(
            *(str(row[key]) for key in ("experiment", "joints", "measured", "shapes")),
            *(f"{row[key]:.1f}" for key in ("sparse_us", "dense_us", "speedup")),
        )
    stdout_console.print(table)
    for joints, us in said["direction_us"].items():
        stdout_console.print(f"One direction at {joints} joints: {us:.1f} us; dense {said['dense_direction_us'][joints]:.0f} us.")
    stdout_console.print(f"51 joints cost {said['k51_over_k23']:.2f} times 23; dense {said['dense_k51_over_k23']:.2f} times.")
    return EXIT_DONE


def run_bench_uncertainty(as_json: JsonOption = False) -> int:
    """Compare predicted deviations with the truth of composed takes: does it lie within them as often as it should?"""
    from mocapfix.bench.uncertainty import measure_uncertainty

    with show_progress("uncertainty"):
        said = measure_uncertainty()
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return EXIT_DONE
    table = Table("per axis", "samples", "error, mm", "predicted, mm", "within it", "within twice")
    for what, name in (("joints", "joints"), ("filled_markers", "filled markers")):
        for part, row in ((f"[bold]{name}[/]", said[what]), *said[what]["by"].items()):
            shown = (f"{row['error_mm']:.1f}", f"{row['deviation_mm']:.1f}")
            table.add_row(part, str(row["samples"]), *shown, f"{row['within_1_sigma']:.0%}", f"{row['within_2_sigma']:.0%}")
        table.add_section()
    stdout_console.print(table)
    stdout_console.print("Of a normal distribution, 68 % lie within one standard deviation and 95 % within two.")
    return EXIT_DONE


def run_bench_calibration(as_json: JsonOption = False) -> int:
    """Compare calibrated bones, marker offsets and joints with the truth of composed people with asymmetric bones."""
    from mocapfix.bench.calibration import measure_calibration

    with show_progress("calibration"):
        rows = measure_calibration()
    if as_json:
        sys.stdout.write(json.dumps({"people": rows[:-1], "mean": rows[-1]}, indent=1) + "\n")
        return EXIT_DONE
    table = Table("mean error, mm", "bones", "marker offsets", "joints", "... of the average body: bones", "offsets", "joints")
    columns = [f"{body}{what}_mm" for body in ("", "average_") for what in ("bones", "offsets", "joints")]
    for row in rows:
        table.add_row(str(row["person"]), *(f"{row[column]:.1f}" for column in columns))
    stdout_console.print(table)
    return EXIT_DONE


def run_bench_files(as_json: JsonOption = False) -> int:
    """Time reading and writing of files: a minute of 53 markers at 120 Hz."""
    from mocapfix.bench.file_speed import FILE_REPEATS, measure_file_speed

    with show_progress("files"):
        rows = measure_file_speed()
    if as_json:
        sys.stdout.write(json.dumps(rows, indent=1) + "\n")
        return EXIT_DONE
    table = Table("what", "frames", f"ms (median of {FILE_REPEATS})")
    for row in rows:
        table.add_row(row["what"], str(row["frames"]), f"{row['ms']:.1f}")
    stdout_console.print(table)
    return EXIT_DONE


BENCH_COMMANDS = {
    "solver": run_bench_solver,
    "uncertainty": run_bench_uncertainty,
    "calibration": run_bench_calibration,
    "faults": run_bench_faults,
    "files": run_bench_files,
    "animations": run_bench_animations,
    "hybrik": run_bench_hybrik,
    **PRIOR_BENCH_COMMANDS,
}
