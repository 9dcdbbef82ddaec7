"""Choose the shipped marker set that fits the labels of a take."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from mocapfix.marker_set import MarkerSet, format_name_list
from mocapfix.marker_sets.library import load_shipped_marker_sets


@dataclass(frozen=True)
class MarkerSetMatch:
    """The marker set that fits a take, None if none does, and a sentence with the reason."""

    marker_set: MarkerSet | None
    reason: str


def choose_marker_set(labels: Sequence[str]) -> MarkerSetMatch:
    """Return the shipped set that matches the most of a take's labels, among the sets that find a whole body in them.

    Among sets that match equally many, the one with the fewest missing markers is chosen. `MarkerSet.describe_missing_body`
    defines a whole body.
    """
    shipped = load_shipped_marker_sets()
    ranked = sorted(((each, each.match_labels(labels)) for each in shipped), key=lambda pair: _rank_match(*pair), reverse=True)
    best = next((each for each, found in ranked if not each.describe_missing_body(found)), None)
    if best:
        return MarkerSetMatch(best, describe_marker_set_match(best, labels))
    nearest, found = ranked[0]
    if found:
        reason = f"the nearest is {nearest.name} with {_format_match_count(nearest, found)}, but "
        reason += nearest.describe_missing_body(found)
    else:
        reason = f"none of them is in any set ({', '.join(each.name for each in shipped)})"
    return MarkerSetMatch(None, f"No marker set fits the labels {format_name_list(labels)}: {reason}.")


def describe_marker_set_match(marker_set: MarkerSet, labels: Sequence[str]) -> str:
    """Return a sentence with the number of markers of a set that are among a take's labels."""
    return f"{marker_set.title}: {_format_match_count(marker_set, marker_set.match_labels(labels))} were found."


def _rank_match(marker_set: MarkerSet, found_labels: Collection[str]) -> tuple[int, int]:
    return len(found_labels), -len(marker_set.list_missing_labels(found_labels))


def _format_match_count(marker_set: MarkerSet, found_labels: Collection[str]) -> str:
    required_count = len(marker_set.required_labels)
    found_required_count = required_count - len(marker_set.list_missing_labels(found_labels))
    found_optional_count = len(found_labels) - found_required_count
    optional = f" and {found_optional_count} optional ones" if found_optional_count else ""
    return f"{found_required_count} of its {required_count} markers{optional}"
