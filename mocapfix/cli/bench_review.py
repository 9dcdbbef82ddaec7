"""The command `mocapfix bench review`: the review page in a browser."""

from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

from rich.table import Table

from mocapfix.cli.arguments import JsonOption, describe_option
from mocapfix.cli.console import EXIT_DONE, print_json, show_progress, stdout_console


def run_bench_review(
    folder: Annotated[
        Path | None, describe_option("DIR", "keep the takes there, to measure again", "none", name="folder")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Measure the review page in Chromium, on a take of a minute and one of ten minutes.

    Measured are the time until it can be used, the time of an edit, pictures a second while playing, and the server's memory.
    """
    from mocapfix.bench.review_page import measure_review

    with nullcontext(folder) if folder else TemporaryDirectory(prefix="mocapfix-") as used, show_progress("review") as progress:
        figures = measure_review(Path(used), progress)
    if as_json:
        print_json(figures)
        return EXIT_DONE
    table = Table("quantity", "measured")
    table.add_row("page can be used after", f"{figures['ready_s']:.2f} s")
    table.add_row("a decision is saved after", f"{figures['saved_ms']:.0f} ms")
    table.add_row("the page shows it after", f"{figures['shown_ms']:.0f} ms")
    table.add_row("pictures a second while playing", f"{figures['frames_per_s']:.0f}")
    table.add_row("memory of the server, ten minutes of take", f"{figures['server_memory_mb']:.0f} MB")
    stdout_console.print(table)
    return EXIT_DONE
