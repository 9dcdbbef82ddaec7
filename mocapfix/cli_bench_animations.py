"""The command that measures how animations are mended: mocapfix bench animations."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.console import DONE, Json, out, staged


def animations(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="CMU motion, its test people; by default motion is composed")
    ] = None,
    trials: Annotated[int, tyro.conf.arg(metavar="N", help="how many trials each kind of fault is put into")] = 12,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="which faults are drawn (a number)")] = 0,
    as_json: Json = False,
) -> int:  # fmt: skip
    """Put pops, flips, jitter and lost spans into sound animations, clean them, and compare with linear interpolation."""
    from mocapfix.bench.animations import measure

    with staged("animations") as progress:
        said = measure(data, trials, seed, progress)
    if as_json:
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
        return DONE
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
    out.print(table)
    alarms = ", ".join(f"{kind} {count:.1f}" for kind, count in said["alarms_per_minute"].items()) or "none"
    out.print(f"Short is 0.2 to 0.5 s, long 0.5 to 1 s. Alarms a minute in the sound trials: {alarms}.")
    out.print(f"Of the sound samples {said['touched']:.2%} were changed.")
    return DONE
