"""Marker sets: which labels there are, which joint each marker rides on, and where; and which set a take wears.

nominal  a set: its markers on the average body, and which of them a take has
labels   how studios spell a marker: prefixes, case, marks between the words
file     sets as YAML, those that travel with mocapfix and one's own
choice   the set that a take's labels fit
words    what labels of no set tell
"""

from mocapfix.marker_set.choice import Choice, choose, fit
from mocapfix.marker_set.file import load, of_subject, save, shipped
from mocapfix.marker_set.nominal import LIMBS, MarkerSet

__all__ = ["LIMBS", "Choice", "MarkerSet", "choose", "fit", "load", "of_subject", "save", "shipped"]
