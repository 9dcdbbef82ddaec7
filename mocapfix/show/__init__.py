"""Showing what was wrong and what was done: a recording to turn and play, and a page to read and print."""

from mocapfix.show.cleaning import Cleaning
from mocapfix.show.comparison import comparison
from mocapfix.show.report import report

__all__ = ["Cleaning", "comparison", "report"]
