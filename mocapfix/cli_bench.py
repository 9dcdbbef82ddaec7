"""The commands that measure mocapfix against what is known to be true: mocapfix bench ..."""

import json
import sys
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli_bench_animations import animations
from mocapfix.cli_bench_faults import faults
from mocapfix.cli_bench_hybrik import hybrik
from mocapfix.cli_bench_prior import PRIOR_BENCHES
from mocapfix.console import DONE, Flag, Json, out, staged


def solver(
    as_json: Json = False,
    quick: Annotated[Flag, tyro.conf.arg(help="time everything a few times only: in seconds, but roughly")] = False,
) -> int:
    """Time the solver: beside scipy on a task with known truth, and SCOPE's experiments beside a dense solve."""
    from mocapfix.bench.solver import alone

    with staged("solver"):
        said = alone(quick)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return DONE
    table = Table("the common task", "clean", "noisy", title=f"600 frames, 53 markers, 31 joints; {said['threads']} threads")
    for key, what, shown in (
        ("fps_one_thread", "frames a second, one thread", ",.0f"),
        ("fps_all_threads", "frames a second, all threads", ",.0f"),
        ("scipy_fps", f"scipy's, of {said['scipy_frames']} frames", ",.0f"),
        ("over_scipy", "times scipy's, one thread", ".0f"),
        ("joint_error_mm", "joint error, mm", ".2f"),
    ):
        table.add_row(what, *(format(said[key][name], shown) for name in ("clean", "noisy")))
    out.print(table)
    table = Table("experiment", "joints", "numbers measured", "shape parameters", "us", "dense, us", "times as fast")
    for row in said["experiments"]:
        table.add_row(
            *(str(row[key]) for key in ("experiment", "joints", "measured", "shapes")),
            *(f"{row[key]:.1f}" for key in ("sparse_us", "dense_us", "speedup")),
        )
    out.print(table)
    for joints, us in said["direction_us"].items():
        out.print(f"One direction at {joints} joints: {us:.1f} us; dense {said['dense_direction_us'][joints]:.0f} us.")
    out.print(f"51 joints cost {said['k51_over_k23']:.2f} times 23; dense {said['dense_k51_over_k23']:.2f} times.")
    return DONE


def uncertainty(as_json: Json = False) -> int:
    """Compare predicted deviations with the truth of composed takes: does it lie within them as often as it should?"""
    from mocapfix.bench.uncertainty import measure

    with staged("uncertainty"):
        said = measure()
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return DONE
    table = Table("per axis", "samples", "error, mm", "predicted, mm", "within it", "within twice")
    for what, name in (("joints", "joints"), ("filled_markers", "filled markers")):
        for part, row in ((f"[bold]{name}[/]", said[what]), *said[what]["by"].items()):
            shown = (f"{row['error_mm']:.1f}", f"{row['deviation_mm']:.1f}")
            table.add_row(part, str(row["samples"]), *shown, f"{row['within_1_sigma']:.0%}", f"{row['within_2_sigma']:.0%}")
        table.add_section()
    out.print(table)
    out.print("Of a normal distribution, 68 % lie within one standard deviation and 95 % within two.")
    return DONE


def calibration(as_json: Json = False) -> int:
    """Compare calibrated bones, marker places and joints with the truth of people composed with crooked bones."""
    from mocapfix.bench.calibration import measured

    with staged("calibration"):
        rows = measured()
    if as_json:
        sys.stdout.write(json.dumps({"people": rows[:-1], "mean": rows[-1]}, indent=1) + "\n")
        return DONE
    table = Table("mean error, mm", "bones", "marker places", "joints", "... of the average body: bones", "places", "joints")
    columns = [f"{body}{what}_mm" for body in ("", "average_") for what in ("bones", "places", "joints")]
    for row in rows:
        table.add_row(str(row["person"]), *(f"{row[column]:.1f}" for column in columns))
    out.print(table)
    return DONE


def files(as_json: Json = False) -> int:
    """Time reading and writing of files: a minute of 53 markers at 120 Hz."""
    from mocapfix.bench.files import REPEATS, measured

    with staged("files"):
        rows = measured()
    if as_json:
        sys.stdout.write(json.dumps(rows, indent=1) + "\n")
        return DONE
    table = Table("what", "frames", f"ms (median of {REPEATS})")
    for row in rows:
        table.add_row(row["what"], str(row["frames"]), f"{row['ms']:.1f}")
    out.print(table)
    return DONE


BENCHES = {
    "solver": solver,
    "uncertainty": uncertainty,
    "calibration": calibration,
    "faults": faults,
    "files": files,
    "animations": animations,
    "hybrik": hybrik,
    **PRIOR_BENCHES,
}
