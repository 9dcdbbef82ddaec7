"""How studios spell a marker's name: whose it is, and what it is called whatever the case and the marks between its words."""

import re
from collections.abc import Iterator, Sequence

MARKS = re.compile(r"[\s._-]+")


def folded(name: str) -> str:
    """-> a name without case and without the marks between its words: R.Thigh.Upper, R_Thigh_Upper and rthighupper are one."""
    return MARKS.sub("", name).upper()


def readings(label: str) -> Iterator[tuple[str, str]]:
    """-> the ways to read a label as a subject's prefix and a marker's folded name.

    "Jim:LFHD" is Jim's. "Q_LThigh" may be a marker of that name or Q's LThigh, "Skeleton_2_LThigh" one of Skeleton_2.
    """
    subject, colon, name = label.rpartition(":")
    yield subject + colon, folded(name)
    for mark in re.finditer("_", name):
        if folded(name[mark.end() :]):
            yield subject + colon + name[: mark.end()], folded(name[mark.end() :])


def of_subjects(labels: Sequence[str]) -> dict[str, dict[str, int]]:
    """-> for every prefix, folded names and the index of the first label that reads so."""
    subjects: dict[str, dict[str, int]] = {}
    for index, label in enumerate(labels):
        for prefix, name in readings(label):
            subjects.setdefault(prefix, {}).setdefault(name, index)
    return subjects


def listed(names: Sequence[str], most: int = 12) -> str:
    """-> names as one reads them in a sentence, the first dozen and how many more."""
    if not names:
        return "(none)"
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
