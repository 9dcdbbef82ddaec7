"""Results of the benchmarks on the terminal: nested mappings and rows, as JSON or as tables."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, cast

from rich.markup import escape
from rich.table import Table

from mocapfix.cli.console import EXIT_DONE, print_json, stdout_console

UNIT_PATTERN = re.compile(r"_(mm|deg|fps|mb|ms|us|s)(?=_|$)")  # a unit in the key of a result


def print_results(results: Any, as_json: bool) -> int:
    """Print results, and return the exit status of a command that has done so.

    Mappings of the same depth become a table with a row for each. Keys are headings, with their unit behind a comma.

    Args:
        results: Mappings and lists of numbers, texts and further mappings.
        as_json: Print them as JSON instead.
    """
    if as_json:
        print_json(results)
    else:
        _print_part("", results)
    return EXIT_DONE


def format_heading(key: object) -> str:
    """Return a key as words: "joint_error_mm" as "joint error, mm"."""
    return UNIT_PATTERN.sub(r", \1", str(key)).replace("_", " ")


def format_value(value: object) -> str:
    """Return a number, a text, or a list or mapping of these as the text of a cell."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format_value(each)}" for key, each in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(format_value, value))
    if isinstance(value, float):
        return "" if value != value else f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return "" if value is None else str(value)


def _print_part(title: str, part: Any) -> None:
    """Print numbers and texts as one table, rows of the same columns as one each, and what is deeper under its key."""
    if isinstance(part, Sequence):
        _print_table(title, [("", row) for row in part])
        return
    tables: dict[tuple[str, ...], list[tuple[str, Mapping[str, Any]]]] = {}
    deeper: dict[str, Any] = {}
    for key, each in cast("Mapping[str, Any]", part).items():
        if not isinstance(each, Mapping | list) or not each:
            tables.setdefault((), []).append((format_heading(key), {"value": each}))
        elif _is_row(each):
            tables.setdefault(tuple(each), []).append((format_heading(key), cast("Mapping[str, Any]", each)))
        else:
            deeper[key] = each
    for rows in tables.values():
        _print_table(title, rows)
    for key, each in deeper.items():
        _print_part(f"{title}: {format_heading(key)}".removeprefix(": "), each)


def _is_row(part: Any) -> bool:
    """Return whether this is a mapping of numbers and texts, or of lists and mappings of these beside such."""
    if not isinstance(part, Mapping) or all(isinstance(each, Mapping) for each in part.values()):
        return False
    nested = [each for each in part.values() if isinstance(each, Mapping)]
    return not any(isinstance(inner, Mapping | list) for each in nested for inner in each.values())


def _print_table(title: str, rows: Sequence[tuple[str, Mapping[str, Any]]]) -> None:
    keys = list(dict.fromkeys(key for _, row in rows for key in row))
    has_names = any(name for name, _ in rows)
    table = Table(*([""] if has_names else []), *map(format_heading, keys), title=escape(title), title_justify="left")
    for name, row in rows:
        table.add_row(*([escape(str(name))] if has_names else []), *(escape(format_value(row.get(key))) for key in keys))
    stdout_console.print(table)
