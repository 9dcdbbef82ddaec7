"""The command `mocapfix inspect`: list the faults of a take without cleaning it."""

from typing import TYPE_CHECKING, Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from mocapfix.cli.arguments import FlagOption, TakeArgument, build_options_argument, parse_options
from mocapfix.cli.clean import format_take_name, print_notes
from mocapfix.cli.console import EXIT_DONE, print_json, print_line, show_progress, stdout_console

if TYPE_CHECKING:
    from mocapfix.report.report import FaultEntry, InspectionReport

    InspectArguments = object
else:
    InspectArguments = build_options_argument(("read", "subject"))


def run_inspect(
    take: TakeArgument,
    options: InspectArguments,
    as_json: Annotated[FlagOption, tyro.conf.arg(name="json", help="print JSON (an array for several subjects)")] = False,
) -> int:
    """List the faults of a take: all that clean would detect. Writes nothing."""
    from mocapfix import pipeline

    parsed = parse_options(options)
    with show_progress(take.name) as progress:
        inspections = pipeline.inspect(take, parsed, progress=progress)
    if as_json:
        print_json(inspections if len(inspections) > 1 else inspections[0])
        return EXIT_DONE
    for inspection in inspections:
        print_faults(inspection)
    return EXIT_DONE


def print_faults(inspection: "InspectionReport") -> None:
    """Print the faults of a take, or of one subject in it, as a table."""
    take = inspection["take"]
    last_frame = take["first_frame"] + take["frames"] - 1
    is_animation = "animation" in take
    point = "joint" if is_animation else "marker"
    size = f"{take['markers']} {point}s, frames {take['first_frame']} to {last_frame} at {take['rate_hz']:g} Hz"
    print_line(f"{escape(format_take_name(take))}: {size}.")
    print_notes(inspection["notes"], "with --json")
    if not inspection["faults"]:
        stdout_console.print("No faults were detected.")
        return
    severity_heading = "severity" if is_animation else "severity, mm"
    table = Table(point, "kind", "frames", severity_heading, "confidence", "reason")
    for fault in inspection["faults"]:
        table.add_row(
            escape(fault["marker"]),
            fault["kind"],
            f"{fault['first']}-{fault['last']}",
            _format_severity(fault, is_animation),
            f"{fault['confidence']:.0%}",
            escape(fault["reason"]),
        )
    stdout_console.print(table)


def _format_severity(fault: "FaultEntry", with_unit: bool) -> str:
    if (severity_deg := fault.get("severity_deg")) is not None:
        return f"{severity_deg:.0f} degrees"
    if fault["severity_m"] is None:
        return ""
    return f"{fault['severity_m'] * 1e3:.0f}{' mm' if with_unit else ''}"
