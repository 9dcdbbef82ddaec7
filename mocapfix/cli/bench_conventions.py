"""The command `mocapfix bench conventions`: captures in all axes and in other units."""

from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli.arguments import TakesArgument
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, print_line, show_progress, stdout_console


def run_bench_conventions(
    takes: TakesArgument,
    cleans: Annotated[int, tyro.conf.arg(metavar="N", help="clean each C3D in N random axes as well")] = 0,
) -> int:
    """Read labelled captures in all 48 permutations of their axes and in other units: upright and in scale, or refused.

    The permutations are read with each axis that a file may declare as vertical, and with none. Fails if any is wrong.
    """
    from mocapfix.bench.conventions import WRONG, clean_in_other_axes, measure_conventions

    with show_progress("conventions") as progress:
        counts = measure_conventions(takes, progress)
        cleaned = {path.name: clean_in_other_axes(path, cleans) for path in takes if cleans and path.suffix.lower() == ".c3d"}
    table = Table("capture", "right-handed", "left-handed", "with --mirror", "units", "cleans")
    for each in counts:
        columns = (each.right_handed, each.left_handed, each.mirrored, each.units, cleaned.get(each.name, {}))
        table.add_row(each.name, *(", ".join(f"{count} {name}" for name, count in sorted(column.items())) for column in columns))
    stdout_console.print(table)
    wrong = sum(each.wrong_count for each in counts) + sum(each[WRONG] for each in cleaned.values())
    print_line(f"{len(counts)} captures, {wrong} wrong outcomes.")
    return EXIT_FAILED if wrong else EXIT_DONE
