"""The command `mocapfix bench learned-ik`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, print_json, show_progress, stdout_console

PLUG_IN_COLUMNS = {
    "hybrik_x": "HybrIK-X",
    "hybrik_x_prior": "solved with the prior",
    "pass_1": "1 pass",
    "pass_2": "2 passes",
    "pass_3": "3 passes",
    "smoothed_hybrik_x": "smoothed joints: HybrIK-X",
    "smoothed_hybrik_x_prior": "solved with the prior",
    "window": "3 passes",
}


def run_bench_learned_ik(
    data: Annotated[Path, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects in its test.npz")],
    weights: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE.safetensors", help="another network than the shipped one")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Measure learned inverse kinematics: one step, whole takes, HybrIK's poses refined, and speed; compared with SMPLify."""
    from mocapfix.bench.learned_ik import measure_learned_ik
    from mocapfix.learned_ik.network import read_ik_network

    network = read_ik_network(weights) if weights else None
    with show_progress("learned-ik") as progress:
        results: Mapping[str, Any] = measure_learned_ik(data, progress, network)
    if as_json:
        print_json(results)
        return EXIT_DONE
    stdout_console.print(build_one_step_table(results))
    stdout_console.print(
        f"Whole takes from a true first frame: {results['sequential_mm']:.2f} mm, "
        f"{results['sequential_selected_mm']:.2f} mm with the published selector (median over takes); "
        f"worst take {results['sequential_worst_take_mm']:.2f} mm."
    )
    stdout_console.print(build_plug_in_table(results["plug_in_mm"]))
    stdout_console.print(
        f"Frames per second on one core: {results['fps_single']:,.0f} single, {results['fps_batch']:,.0f} in batches; "
        f"{results['over_smplify']:,.0f} times as fast as SMPLify."
    )
    return EXIT_DONE


def build_one_step_table(results: Mapping[str, Any]) -> Table:
    """Return the errors of one step by the number of frames from the start."""
    title = f"one step, {results['frames']:,} frames of people outside the training data; mm"
    table = Table("frames from the start", *results["one_step_mm"], title=title, title_justify="left")
    rows = {"the start itself": results["copied_mm"], "SMPLify, 100 iterations": results["smplify_mm"]}
    for passes, row in results["one_step_passes_mm"].items():
        rows[f"learned, {passes} pass{'es' if passes != '1' else ''}"] = row
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.2f}" for value in row.values()))
    return table


def build_plug_in_table(results: Mapping[str, Mapping[str, float]]) -> Table:
    """Return the errors of HybrIK's poses and of what follows them."""
    table = Table("joints with noise of 20 mm; mm", *PLUG_IN_COLUMNS.values())
    for key, name in (("noise", "all given"), ("arm_missing", "an arm missing")):
        table.add_row(name, *(f"{results[key][column]:.1f}" for column in PLUG_IN_COLUMNS))
    return table
