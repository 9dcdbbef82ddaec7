"""The command `mocapfix bench contacts`: contacts, held feet and gait events, compared with known truth and force plates."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.table import Table

from mocapfix.cli.arguments import JsonOption
from mocapfix.cli.console import EXIT_DONE, print_json, print_line, print_usage_error, show_progress, stdout_console

if TYPE_CHECKING:
    from mocapfix.bench.contacts import ContactAgreement, HeldFeetErrors
    from mocapfix.bench.contacts_plates import PlateAgreement, PlateEventError

HELD_COLUMNS = (
    ("slide_mm_s", "slide, mm/s", ".1f"),
    ("true_slide_mm_s", "true slide", ".1f"),
    ("drift_mm", "drift, mm", ".2f"),
    ("feet_mm", "feet, mm", ".1f"),
    ("other_joints_mm", "other joints, mm", ".1f"),
    ("acceleration_ratio", "acceleration ratio", ".2f"),
    ("knee_ratio", "of knees", ".2f"),
    ("sink_mm", "sink, mm", ".2f"),
    ("lost_fill_mm", "lost markers, mm", ".1f"),
)
"""Key, heading and number format of a column."""


def run_bench_contacts(
    data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="motion with the test subjects; by default composed motion")
    ] = None,
    plates: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER", help="C3D captures with force plates, compared with events from markers")
    ] = None,
    takes: Annotated[int, tyro.conf.arg(metavar="N", help="number of takes; 0 for force plates alone")] = 6,
    as_json: JsonOption = False,
) -> int:
    """Hold the feet of takes with known truth, whole and with markers of standing feet lost; compare events with force plates."""
    from mocapfix.bench.contacts import measure_contacts
    from mocapfix.bench.contacts_plates import measure_plate_events

    if takes < 0 or (takes == 0 and plates is None):
        return print_usage_error(f"bench contacts: --takes must be at least 1 without --plates, not {takes}.")
    with show_progress("contacts") as progress:
        errors, agreements = measure_contacts(data, takes, progress) if takes else ([], [])
        events, frames = measure_plate_events(plates, progress) if plates is not None else ([], [])
    if as_json:
        print_json(
            {name: [asdict(each) for each in rows] for name, rows in _name_rows(errors, agreements, events, frames).items()}
        )
        return EXIT_DONE
    if errors:
        stdout_console.print(build_held_table(errors))
        _print_agreement(agreements)
    if plates is not None:
        _print_plate_errors(events, frames)
    return EXIT_DONE


def build_held_table(errors: "Sequence[HeldFeetErrors]") -> Table:
    """Return the mean over takes of each damage and way to hold feet."""
    from mocapfix.bench.contacts import average_errors

    table = Table("damage", "feet", *(heading for _, heading, _ in HELD_COLUMNS))
    groups: dict[tuple[str, str], list[HeldFeetErrors]] = defaultdict(list)
    for each in errors:
        groups[each.damage, each.mode].append(each)
    for (damage, mode), rows in groups.items():
        values = [(average_errors(rows, key), number_format) for key, _, number_format in HELD_COLUMNS]
        table.add_row(damage, mode, *("" if isnan(value) else format(value, number_format) for value, number_format in values))
    return table


def _print_agreement(agreements: "Sequence[ContactAgreement]") -> None:
    for damage in dict.fromkeys(each.damage for each in agreements):
        own = [each for each in agreements if each.damage == damage]
        common, found, true = (sum(getattr(each, f"{name}_frames") for each in own) for name in ("common", "found", "true"))
        mean_f1 = sum(each.f1 for each in own) / len(own)
        print_line(
            f"Contacts, {damage}: precision {common / max(found, 1):.3f}, recall {common / max(true, 1):.3f}, "
            f"F1 {2 * common / max(found + true, 1):.3f}; mean F1 of the takes {mean_f1:.3f}."
        )


def _print_plate_errors(events: "Sequence[PlateEventError]", frames: "Sequence[PlateAgreement]") -> None:
    import numpy as np

    from mocapfix.bench.contacts_plates import compute_frame_f1

    for kind in ("foot strike", "foot off"):
        errors = np.array([each.error_ms for each in events if each.kind == kind])
        found = errors[np.isfinite(errors)]
        if len(found):
            print_line(
                f"{kind}: {len(found)} of {len(errors)} found, median error {np.median(np.abs(found)):.1f} ms, "
                f"median delay {np.median(found):.1f} ms."
            )
    if not events:
        print_line("No capture has a load of a force plate by a single foot.")
        return
    events_f1, rule_f1 = (compute_frame_f1(frames, method) for method in ("events", "height and speed"))
    print_line(f"F1 by frame: {events_f1:.3f}; of the height-and-speed rule {rule_f1:.3f}.")


def _name_rows(*rows: Sequence[Any]) -> dict[str, Sequence[Any]]:
    return dict(zip(("held_feet", "contacts", "plate_events", "plate_frames"), rows, strict=True))
