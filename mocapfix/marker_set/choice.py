"""Which of the shipped sets a take wears, by its labels."""

from collections.abc import Sequence
from dataclasses import dataclass

from mocapfix.marker_set.file import shipped
from mocapfix.marker_set.labels import listed
from mocapfix.marker_set.nominal import MarkerSet


@dataclass(frozen=True)
class Choice:
    """The marker set a take wears, None where none fits, and a sentence that says why."""

    marker_set: MarkerSet | None
    reason: str


def choose(labels: Sequence[str]) -> Choice:
    """-> of the shipped sets that find a whole body among a take's labels, the one that explains most of them; of sets that
    explain as many, the one of which the fewest are absent.

    A whole body is most of the set's markers (nominal.SHARE), with some on hips, thorax and at least three of the four limbs.
    """
    ranked = sorted(((each, each.match(labels)) for each in shipped()), key=lambda pair: _explains(*pair), reverse=True)
    best = next((each for each, found in ranked if not each.lack(found)), None)
    if best:
        return Choice(best, fit(best, labels))
    nearest, found = ranked[0]
    why = f"nearest came {nearest.name} with {_counted(nearest, found)}, but {nearest.lack(found)}"
    if not found:
        why = f"none of them is in any set ({', '.join(each.name for each in shipped())})"
    return Choice(None, f"No marker set fits the labels {listed(labels)}: {why}.")


def fit(worn: MarkerSet, labels: Sequence[str]) -> str:
    """-> a sentence on how many of a set's markers are among a take's labels."""
    return f"{worn.title}: {_counted(worn, worn.match(labels))} were found."


def _explains(worn: MarkerSet, found: dict[str, int]) -> tuple[int, int]:
    return len(found), -len(worn.absent(found))


def _counted(worn: MarkerSet, found: dict[str, int]) -> str:
    needed, extra = len(worn.required) - len(worn.absent(found)), len(found) - len(worn.required) + len(worn.absent(found))
    return f"{needed} of its {len(worn.required)} markers" + (f" and {extra} that it may do without" if extra else "")
