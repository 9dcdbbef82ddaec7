"""The command `mocapfix bench session`: takes cleaned alone, and with the person known from all takes of the session."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, print_json, print_line, print_usage_error, show_progress, stdout_console


def run_bench_session(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default composed motion")
    ] = None,
    people: Annotated[int, tyro.conf.arg(metavar="N", help="number of people")] = 6,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="takes of each person")] = 6,
    seconds: Annotated[float, tyro.conf.arg(metavar="S", help="duration of a take")] = 20.0,
    as_json: JsonOption = False,
) -> int:
    """Clean the takes of several people alone and with the person known from all takes, and find markers that moved."""
    from mocapfix.bench.sessions import TEST_PEOPLE, measure_sessions

    if not 1 <= people <= len(TEST_PEOPLE) or takes < 2 or not seconds > 0:
        return print_usage_error(f"bench session: --people is 1 to {len(TEST_PEOPLE)}, --takes at least 2, --seconds above 0.")
    with show_progress("session") as progress:
        errors, outcomes = measure_sessions(data, TEST_PEOPLE[:people], takes, seconds, report_progress=progress)
    if as_json:
        print_json({"errors": [asdict(each) for each in errors], "moves": [asdict(each) for each in outcomes]})
        return EXIT_DONE
    table = Table("person", "method", "joints, mm", "bones, mm", "places, mm", "CPU s")
    for each in errors:
        figures = (each.joints_mm, each.bones_mm, each.places_mm, each.cpu_s)
        table.add_row(each.person, each.method, *(f"{figure:.2f}" for figure in figures))
    stdout_console.print(table)
    moved = [each for each in outcomes if each.marker]
    print_line(f"{sum(each.is_found for each in moved)} of {len(moved)} moved markers found.")
    print_line(f"{sum(each.false_alarms for each in outcomes)} false alarms in {len(outcomes)} sessions.")
    return EXIT_DONE
