"""Which of the shipped sets a take wears, by its labels."""

from collections.abc import Sequence
from dataclasses import dataclass

from mocapfix.marker_set import MarkerSet, format_name_list
from mocapfix.marker_sets.library import load_shipped_marker_sets


@dataclass(frozen=True)
class MarkerSetMatch:
    """The marker set a take wears, None where none fits, and a sentence that says why."""

    marker_set: MarkerSet | None
    reason: str


def choose_marker_set(labels: Sequence[str]) -> MarkerSetMatch:
    """-> of the shipped sets that find a whole body among a take's labels, the one that explains most of them; of sets that
    explain as many, the one of which the fewest are absent.

    A whole body is most of the set's markers (nominal.SHARE), with some on hips, thorax and at least three of the four limbs.
    """
    ranked = sorted(
        ((each, each.match_labels(labels)) for each in load_shipped_marker_sets()),
        key=lambda pair: _rank_match(*pair),
        reverse=True,
    )
    best = next((each for each, found in ranked if not each.describe_missing_body(found)), None)
    if best:
        return MarkerSetMatch(best, describe_marker_set_match(best, labels))
    nearest, found = ranked[0]
    why = f"nearest came {nearest.name} with {_format_match_count(nearest, found)}, but {nearest.describe_missing_body(found)}"
    if not found:
        why = f"none of them is in any set ({', '.join(each.name for each in load_shipped_marker_sets())})"
    return MarkerSetMatch(None, f"No marker set fits the labels {format_name_list(labels)}: {why}.")


def describe_marker_set_match(marker_set: MarkerSet, labels: Sequence[str]) -> str:
    """-> a sentence on how many of a set's markers are among a take's labels."""
    return f"{marker_set.title}: {_format_match_count(marker_set, marker_set.match_labels(labels))} were found."


def _rank_match(marker_set: MarkerSet, found_labels: dict[str, int]) -> tuple[int, int]:
    return len(found_labels), -len(marker_set.list_missing_labels(found_labels))


def _format_match_count(marker_set: MarkerSet, found_labels: dict[str, int]) -> str:
    needed, extra = (
        len(marker_set.required_labels) - len(marker_set.list_missing_labels(found_labels)),
        len(found_labels) - len(marker_set.required_labels) + len(marker_set.list_missing_labels(found_labels)),
    )
    return f"{needed} of its {len(marker_set.required_labels)} markers" + (
        f" and {extra} that it may do without" if extra else ""
    )
