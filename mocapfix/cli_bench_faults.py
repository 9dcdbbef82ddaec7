"""The command that measures what is found of faults, and how well it is mended: mocapfix bench faults."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.console import DONE, Json, out, staged

COLUMNS = (
    ("recall", "found", ".0%"),
    ("overlap", "overlap", ".0%"),
    ("false_alarms_per_minute", "false alarms a minute", ".1f"),
    ("predicted_mm", "predicted error, mm", ".1f"),
    ("true_mm", "true error, mm", ".1f"),
)


def faults(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="CMU motion, of whose test people the takes are made; by default "
                                   "takes are composed")
    ] = None,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="how many takes each kind of fault is put into")] = 6,
    as_json: Json = False,
) -> int:  # fmt: skip
    """Put faults of every kind into sound takes with known truth, clean them, and say what was found and how it was mended."""
    from mocapfix.bench.faults import measure

    with staged("faults") as progress:
        said = measure(data, takes, progress)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return DONE
    table = Table("kind", *(what for _, what, _ in COLUMNS))
    for kind, row in said.items():
        if kind == "all":
            table.add_section()
        table.add_row(kind, *("" if row[key] is None else format(row[key], shown) for key, _, shown in COLUMNS))
    out.print(table)
    out.print("The false alarms of all kinds together are those in the same takes without any faults.")
    return DONE
