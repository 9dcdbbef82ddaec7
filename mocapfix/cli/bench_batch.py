"""The commands `mocapfix bench batch` and `mocapfix bench batch-kills`: speed and safety of batches."""

from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, EXIT_FAILED, print_json, print_line, show_progress, stdout_console


def run_bench_batch(
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="composed takes")] = 20,
    shortest: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="length of the shortest take")] = 10.0,
    longest: Annotated[float, tyro.conf.arg(metavar="SECONDS", help="length of the longest take")] = 20.0,
    workers: Annotated[int, tyro.conf.arg(metavar="N", help="workers")] = 2,
    as_json: JsonOption = False,
) -> int:
    """Compare a batch with cleaning the same takes in one process: rate, memory of the workers, overhead for each take."""
    from mocapfix.bench.batch_speed import measure_batch_speed

    with TemporaryDirectory(prefix="mocapfix-") as folder, show_progress("batch", needs_kernels=True) as progress:
        result = measure_batch_speed(Path(folder), takes, (shortest, longest), workers, progress)
    if as_json:
        print_json(asdict(result) | {"rate_share": result.rate_share})
    else:
        table = Table("", "value")
        for name, value in (asdict(result) | {"rate_share": result.rate_share}).items():
            table.add_row(name, str(value))
        stdout_console.print(table)
    return EXIT_DONE if result.differing == 0 else EXIT_FAILED


def run_bench_batch_kills(
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="short composed takes")] = 60,
    kills: Annotated[int, tyro.conf.arg(metavar="N", help="how often a worker is killed")] = 5,
    workers: Annotated[int, tyro.conf.arg(metavar="N", help="workers")] = 2,
    seed: Annotated[int, tyro.conf.arg(metavar="N", help="seed of the moments")] = 0,
    as_json: JsonOption = False,
) -> int:
    """Kill workers, the scheduler and the client of a batch at random moments, and compare its outputs with a quiet run."""
    from mocapfix.bench.batch_chaos import measure_chaos

    with TemporaryDirectory(prefix="mocapfix-") as folder, show_progress("batch", needs_kernels=True) as progress:
        result = measure_chaos(Path(folder), takes, kills, workers, seed, progress)
    if as_json:
        print_json(asdict(result) | {"is_sound": result.is_sound})
    else:
        print_line(f"{result.done_count} of {result.take_count} takes done in {result.seconds:.0f} s; killed: {result.kills}.")
        print_line(f"Takes by attempts: {result.attempts}; outputs that differ from the quiet run: {len(result.differing)}.")
        for error in result.client_errors:
            print_line(f"A client ended with: {error}")
    return EXIT_DONE if result.is_sound else EXIT_FAILED


BATCH_BENCH_COMMANDS = {"batch": run_bench_batch, "batch-kills": run_bench_batch_kills}
