"""The command `mocapfix bench prior-scope`: the trained prior in every frame, where a limb is lost, or nowhere."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, print_json, print_usage_error, show_progress, stdout_console


def run_bench_prior_scope(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default composed takes")
    ] = None,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="number of takes")] = 3,
    as_json: JsonOption = False,
) -> int:
    """Clean takes with known truth and few markers with the trained prior in every frame, for lost limbs only, and without it."""
    from mocapfix.bench.prior_scope import measure_prior_scopes

    if takes < 1:
        return print_usage_error(f"bench prior-scope: --takes must be at least 1, not {takes}.")
    with show_progress("prior-scope") as progress:
        rows = measure_prior_scopes(data, takes, report_progress=progress)
    if as_json:
        print_json({"rows": rows})
        return EXIT_DONE
    table = Table("case", "scope", "joints, mm", "95 % of joints, mm", "fills, mm", "s")
    for row in rows:
        errors = (f"{row['joint_mm']:.2f}", f"{row['joint_p95_mm']:.1f}", f"{row['fill_mm']:.1f}", f"{row['seconds']:.1f}")
        table.add_row(str(row["case"]), str(row["scope"]), *errors)
    stdout_console.print(table)
    return EXIT_DONE
