"""Showing what was wrong and what was done: a recording to turn and play, and a page to read and print."""

from mocapfix.report.comparison import CleaningComparison
from mocapfix.report.html_report import write_html_report
from mocapfix.report.recording import write_recording

__all__ = ["CleaningComparison", "write_html_report", "write_recording"]
