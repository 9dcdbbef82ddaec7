"""The report page: one HTML file without anything outside it, for a technician to read, send and print."""

from collections.abc import Iterable
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np

from mocapfix.faults import MISSING, Faults
from mocapfix.files import replacing
from mocapfix.show import figures, summary, timeline
from mocapfix.show.states import AMBER, DOUBTED, EMPTY, GREEN, GREY, RED, VIOLET, mended, states
from mocapfix.show.summary import number
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take

LISTED = 1000  # faults in the list at most; the JSON report has them all
UNFOLDED = 40  # faults shown without unfolding the list


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
    sections = [
        _facts(record, before),
        _summary(record, before, faults),
        _worst_moment(before, after, state, skeleton, joints),
        _timeline(before, faults, state, error),
        _left(record),
        _residuals(record),
        _subject(record),
        _faults(record, before, faults, state),
        _seconds(record),
    ]
    template = Template(resources.files("mocapfix.show").joinpath("report.html").read_text(encoding="utf-8"))
    colours = {"grey": GREY, "green": GREEN, "red": RED, "amber": AMBER, "violet": VIOLET}
    page = template.substitute(title=escape(before.name), subtitle=escape(_subtitle(record, before)), body="\n".join(sections), **colours)
    with replacing(target) as part:
        part.write_text(page, encoding="utf-8", newline="\n")
