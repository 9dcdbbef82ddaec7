"""Choose the marker set of a take: the one that the options name, or the shipped one that fits its labels."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from mocapfix.calibrate import subject_file
from mocapfix.errors import TakeError
from mocapfix.marker_set import MarkerSet, format_name_list
from mocapfix.marker_sets.library import build_subject_marker_set, load_marker_set, load_shipped_marker_sets
from mocapfix.options import SubjectOptions
from mocapfix.subject import Subject
from mocapfix.take import Take

UNASSIGNED_SUBJECT = "others"
"""the name of the take of the markers that belong to no whole body"""


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


@dataclass(frozen=True)
class SubjectChoice:
    """The subject and the marker set of a take.

    Attributes:
        subject: the subject that the options name, None if it is to be calibrated.
        marker_set: the marker set, None where no set fits: there is no body then.
        notes: sentences for the report.
    """

    subject: Subject | None
    marker_set: MarkerSet | None
    notes: tuple[str, ...] = ()


def load_requested_subject(options: SubjectOptions) -> SubjectChoice:
    """Return the subject and the marker set that the options name, None for each that they do not name."""
    subject = options.subject
    if subject is not None:
        if isinstance(subject, str | Path):
            subject = subject_file.read_subject(subject)
        return SubjectChoice(subject, build_subject_marker_set(subject))
    return SubjectChoice(None, None if options.marker_set is None else load_marker_set(options.marker_set))


def resolve_subject(take: Take, options: SubjectOptions) -> SubjectChoice:
    """Return the subject and the marker set of one subject's take: those that the options name, or the set that its labels match.

    Raises TakeError where the named set or subject does not fit the take.
    """
    if take.subject_name == UNASSIGNED_SUBJECT:
        return SubjectChoice(None, None, ("Markers that do not form a full body are cleaned without a skeleton.",))
    requested = load_requested_subject(options)
    marker_set = requested.marker_set
    if marker_set is None:
        match = choose_marker_set(take.labels)
        notes = () if match.marker_set else (match.reason, "The take was cleaned without a skeleton: there is no BVH.")
        return SubjectChoice(None, match.marker_set, notes)
    found = marker_set.match_labels(take.labels)
    if missing := marker_set.describe_missing_body(found):
        count = f"{len(found)} of its {len(marker_set.labels)} markers"
        raise TakeError(f"{take.name}: {marker_set.name} does not fit: {count}, {missing}.")
    return requested
