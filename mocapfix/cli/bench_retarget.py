"""The command `mocapfix bench retarget`: motion on characters, and back."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, print_json, show_progress, stdout_console


def run_bench_retarget(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default composed motion")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Retarget motion onto each preset and back, and onto characters of other proportions, beside copied rotations."""
    from mocapfix.bench.retargeting import load_bench_motions, measure_proportions, measure_round_trips

    with show_progress("retarget") as progress:
        motions = load_bench_motions(data)
        trips = measure_round_trips(motions, progress)
        proportions = measure_proportions(motions, progress)
    if as_json:
        print_json({"presets": [asdict(each) for each in trips], "proportions": [asdict(each) for each in proportions]})
        return EXIT_DONE
    table = Table("preset", "joints, mm", "99 %", "rotations, deg", "99 %", "copied: joints, mm", "deg", "frames per second")
    for trip in trips:
        figures = (trip.joints_mm, trip.joints_p99_mm, trip.rotations_deg, trip.rotations_p99_deg, trip.copied_joints_mm)
        copied_deg, speed = f"{trip.copied_rotations_deg:.2f}", f"{trip.frames_per_second:,.0f}"
        table.add_row(trip.character, *(f"{figure:.2f}" for figure in figures), copied_deg, speed)
    stdout_console.print(table)
    table = Table("character", "method", "skate ratio", "slide, mm/s", "hands at most, mm", "palms in thighs", "depth, mm")
    for each in proportions:
        figures = (f"{each.skate_ratio:.4f}", f"{each.slide_mm_s:.1f}", f"{each.hands_mm:.1f}")
        table.add_row(each.character, each.method, *figures, f"{each.penetration_share:.4f}", f"{each.penetration_mm:.3f}")
    stdout_console.print(table)
    return EXIT_DONE
