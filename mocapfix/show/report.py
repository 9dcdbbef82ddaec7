"""The report page: one HTML file that needs nothing outside it, for a technician to read, send and print."""

from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from mocapfix.files import replacing
from mocapfix.show import entries, sections
from mocapfix.show.cleaning import Cleaning
from mocapfix.show.states import AMBER, BLUE, GREEN, RED, VIOLET
from mocapfix.take import Take
from mocapfix.words import worded

COLOURS = {"green": GREEN, "red": RED, "amber": AMBER, "violet": VIOLET, "blue": BLUE}


def report(target: Path, record: dict, cleaning: Cleaning) -> None:
    """Write the page on a take: what was wrong, what was done, what was left, with pictures.

    record is the JSON report. Raises WriteError where `target` cannot be written.
    """
    body = (
        sections.overview(record, cleaning),
        sections.worst_moment(cleaning),
        entries.pictures(cleaning),
        sections.time_line(cleaning),
        entries.left_empty(record, cleaning),
        entries.unchanged(cleaning),
        entries.change_list(cleaning),
        sections.residuals(record),
        sections.subject(record),
        sections.seconds(record),
    )
    template = Template(resources.files("mocapfix.show").joinpath("report.html").read_text(encoding="utf-8"))
    texts = {"title": escape(cleaning.before.name), "subtitle": escape(_subtitle(record, cleaning.before))}
    page = template.substitute(texts, body="\n".join(body), **COLOURS)
    with replacing(target) as part:
        part.write_text(page, encoding="utf-8", newline="\n")


def _subtitle(record: dict, take: Take) -> str:
    points = f"{record['take']['markers']} {worded('markers', take)}"
    first, last = take.first_frame, take.frame_number(take.frames - 1)
    worn = f", marker set {record['take']['marker_set']}" if record["take"]["marker_set"] else ""
    return f"Frames {first} to {last} at {take.rate:g} Hz ({take.frames / take.rate:.1f} s), {points}{worn}."
