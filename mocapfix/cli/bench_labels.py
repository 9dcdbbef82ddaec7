"""The command `mocapfix bench labels`: labels taken away and found again."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, print_json, show_progress, stdout_console

LABEL_COLUMNS = (
    ("takes", "takes", ".0f"),
    ("tracklets", "tracklets", ".0f"),
    ("purity", "purity", ".5f"),
    ("recall", "recall", ".4f"),
    ("precision", "precision", ".4f"),
    ("f1", "F1", ".4f"),
    ("worst_f1", "worst F1", ".4f"),
    ("seconds_per_second", "processor seconds per second", ".2f"),
)
"""key of a result, heading and number format"""


def run_bench_labels(
    data: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FOLDER", help="labelled C3D files of whole bodies; by default takes are composed"),
    ] = None,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="seed of the damage")] = 0,
    as_json: JsonOption = False,
) -> int:
    """Take the labels of takes away, label them again by their marker set, and score the labels.

    tracks: every trajectory a column. ghosts: with points that are no markers. cloud: the points of each frame in random order.
    noise: random occlusions and ghosts in each frame. broken: the same with broken trajectories. two people: clouds of two takes.
    """
    from mocapfix.bench.label_recovery import measure_label_recovery, summarise_label_scores

    with show_progress("labels") as progress:
        scores = measure_label_recovery(data, seed, progress)
    if as_json:
        print_json([asdict(score) for score in scores])
        return EXIT_DONE
    table = Table("kind", *(heading for _, heading, _ in LABEL_COLUMNS))
    for kind, row in summarise_label_scores(scores).items():
        table.add_row(kind, *(format(row[key], number_format) for key, _, number_format in LABEL_COLUMNS))
    stdout_console.print(table)
    stdout_console.print("Purity: the share of the points whose tracklet mostly shows the same marker.")
    return EXIT_DONE
