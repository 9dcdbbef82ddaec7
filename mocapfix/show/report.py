"""The report page: one HTML file that needs nothing outside it, for a technician to read, send and print."""

from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np

from mocapfix.faults import Faults
from mocapfix.files import replacing
from mocapfix.show import sections
from mocapfix.show.states import AMBER, GREEN, RED, VIOLET, states
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take

COLOURS = {"green": GREEN, "red": RED, "amber": AMBER, "violet": VIOLET}


def report(
    target: Path,
    record: dict,
    before: Take,
    after: Take,
    faults: Faults,
    skeleton: Skeleton | None,
    joints: np.ndarray | None,
    error: np.ndarray | None,
) -> None:
    """Write the page on a take: what was wrong, what was done, what was left, with pictures.

    record is the JSON report; joints (T, J, 3) metres, the solved skeleton in the world; error (T, M) metres, each seen
    marker's distance from the body, NaN where unknown. Raises WriteError where `target` cannot be written.
    """
    state = states(before, after, faults)
    body = (
        sections.overview(record, before, faults),
        sections.worst_moment(before, after, state, skeleton, joints),
        sections.time_line(before, faults, state, error),
        sections.left_empty(record),
        sections.residuals(record),
        sections.subject(record),
        sections.fault_list(record, before, faults, state),
        sections.seconds(record),
    )
    template = Template(resources.files("mocapfix.show").joinpath("report.html").read_text(encoding="utf-8"))
    texts = {"title": escape(before.name), "subtitle": escape(_subtitle(record, before))}
    page = template.substitute(texts, body="\n".join(body), **COLOURS)
    with replacing(target) as part:
        part.write_text(page, encoding="utf-8", newline="\n")


def _subtitle(record: dict, take: Take) -> str:
    first, last = take.first_frame, take.frame_number(take.frames - 1)
    worn = f", marker set {record['take']['marker_set']}" if record["take"]["marker_set"] else ""
    return f"Frames {first} to {last} at {take.rate:g} Hz ({take.frames / take.rate:.1f} s), {len(take.labels)} markers{worn}."
