"""The report page: one HTML file that needs nothing outside it, for a technician to read, send and print."""

from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from mocapfix.files.output_files import replace_atomically
from mocapfix.report import change_sections, html_sections
from mocapfix.report.comparison import CleaningComparison
from mocapfix.report.sample_states import AMBER, BLUE, GREEN, RED, VIOLET
from mocapfix.report.terms import use_joint_terms
from mocapfix.take import Take

PAGE_COLOURS = {"green": GREEN, "red": RED, "amber": AMBER, "violet": VIOLET, "blue": BLUE}


def write_html_report(target: Path, report: dict, comparison: CleaningComparison) -> None:
    """Write the page on a take: what was wrong, what was done, what was left, with pictures.

    record is the JSON report. Raises WriteError where `target` cannot be written.
    """
    body = (
        html_sections.render_overview(report, comparison),
        html_sections.render_worst_frame(comparison),
        change_sections.render_worst_changes(comparison),
        html_sections.render_timeline(comparison),
        change_sections.render_unfilled_runs(report, comparison),
        change_sections.render_unchanged_faults(comparison),
        change_sections.render_change_list(comparison),
        html_sections.render_residuals(report),
        html_sections.render_subject(report),
        html_sections.render_stage_times(report),
    )
    template = Template(resources.files("mocapfix.report").joinpath("report.html").read_text(encoding="utf-8"))
    texts = {"title": escape(comparison.input_take.name), "subtitle": escape(_format_subtitle(report, comparison.input_take))}
    page = template.substitute(texts, body="\n".join(body), **PAGE_COLOURS)
    with replace_atomically(target) as part:
        part.write_text(page, encoding="utf-8", newline="\n")


def _format_subtitle(report: dict, take: Take) -> str:
    points = f"{report['take']['markers']} {use_joint_terms('markers', take)}"
    first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
    worn = f", marker set {report['take']['marker_set']}" if report["take"]["marker_set"] else ""
    return f"Frames {first} to {last} at {take.rate:g} Hz ({take.frame_count / take.rate:.1f} s), {points}{worn}."
