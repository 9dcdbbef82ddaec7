"""The command `mocapfix bench stress`: extreme motion with known truth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from mocapfix.cli.arguments import FlagOption, JsonOption
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, print_json, show_progress, stdout_console

QUICK_MOTIONS = ("straight arm", "kick", "cartwheel")
QUICK_RATES_HZ = (120.0,)


def run_bench_stress(
    data: Annotated[
        tuple[Path, ...], tyro.conf.arg(metavar="FOLDER", help="folders of motion with test.npz, whose fastest tenth is used")
    ] = (),
    quick: Annotated[FlagOption, tyro.conf.arg(help=f"only {', '.join(QUICK_MOTIONS)} at {QUICK_RATES_HZ[0]:g} Hz")] = False,
    as_json: JsonOption = False,
) -> int:  # fmt: skip
    """Clean strikes, kicks, throws and acrobatics with known truth: limbs lost in sight, joint errors, sound samples changed.

    The status is 1 if a limit is exceeded.
    """
    from mocapfix.bench.stress import MAX_ERROR_RATIO, MAX_LIMB_ERROR_M, STRESS_RATES_HZ, measure_stress
    from mocapfix.synthetic.extreme_motions import EXTREME_MOTIONS

    motions, rates_hz = (QUICK_MOTIONS, QUICK_RATES_HZ) if quick else (tuple(EXTREME_MOTIONS), STRESS_RATES_HZ)
    with show_progress("stress") as progress:
        results: Mapping[str, Any] = measure_stress(data, motions, rates_hz, progress)
    totals = results["all"]
    status = EXIT_DONE if totals["within_limits"] else EXIT_FAILED
    if as_json:
        print_json(results)
        return status
    headings = (
        "frames lost in sight",
        "joint error, mm",
        "over ordinary",
        "largest of a seen limb, mm",
        "where",
        "changed",
        "poor",
    )
    table = Table("take", *headings)
    for row in results["takes"]:
        lost = ", ".join(f"{part} {count}" for part, count in row["lost_in_sight"].items()) or "0"
        errors = (f"{row['joint_error_mm']:.1f}", f"{row['over_ordinary']:.2f}", f"{row['limb_error_mm']:.0f}")
        name = f"{row['name']} (ordinary)" if row["ordinary"] and row["kind"] == "performed" else row["name"]
        where = f"{row['limb']}, frame {row['frame']}"
        table.add_row(name, lost, *errors, where, f"{row['changed_share']:.3%}", str(row["poor_frames"]))
    table.add_section()
    errors = ("", f"{totals['over_ordinary']:.2f}", f"{totals['limb_error_mm']:.0f}")
    table.add_row("all", str(totals["lost_frames"]), *errors, "", f"{totals['changed_share']:.3%}", str(totals["poor_frames"]))
    stdout_console.print(table)
    stdout_console.print(
        f"Limits: no frame lost in sight, {1e3 * MAX_LIMB_ERROR_M:.0f} mm for a joint of a limb whose markers are all seen, "
        f"{MAX_ERROR_RATIO:g} times the joint error of ordinary motion on average. Frames are counted from 0."
    )
    if results["skipped"]:
        stdout_console.print(f"Skipped: {results['skipped']}.")
    return status
