"""Several people in one take: whose whole bodies it shows, each one's markers as a take of their own, and all together again.

Labels say whose they are ("Jim:LFHD"). Of a take that shows one whole body, or none, everything stays together: what is not
the body's (a prop, a part of somebody) is filled from how markers move together. Of a take that shows several, each is cleaned
by themselves, and what is nobody's of them, together, as if it were one more.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mocapfix.errors import TakeError
from mocapfix.faults import Fault, Faults, Fragment
from mocapfix.marker_sets import MarkerSet, choose_marker_set
from mocapfix.result import CleaningResult
from mocapfix.take import Take

UNASSIGNED_SUBJECT = "others"  # what is no whole body's, where there are several
MIN_UNASSIGNED_MARKERS = 3  # markers in a frame, or nothing can be placed


def find_whole_bodies(take: Take, marker_set: MarkerSet | None = None) -> tuple[str, ...]:
    """-> whose whole bodies a take shows, in the order of its labels; "" for the one whose labels have no name.

    worn_set  what they must wear; None: any of the shipped sets
    """
    owners, seen = np.array(take.marker_subjects, object), take.visible.any(0)
    worn = {
        owner: [take.labels[m] for m in np.flatnonzero((owners == owner) & seen)] for owner in dict.fromkeys(take.marker_subjects)
    }
    if marker_set is None:
        return tuple(owner for owner, labels in worn.items() if choose_marker_set(labels).marker_set)
    return tuple(owner for owner, labels in worn.items() if not marker_set.describe_missing_body(marker_set.match_labels(labels)))


def split_subjects(take: Take, marker_set: MarkerSet | None = None, subject_prefix: str | None = None) -> tuple[Take, ...]:
    """-> the takes that are to be cleaned, one after the other: the take as it is, unless it shows several whole bodies.

    prefix  the only one whose markers are wanted; whatever else is marked is in no take then

    Raises TakeError where nobody has that name.
    """
    if subject_prefix is not None:
        return (_select_subject(take, subject_prefix.strip().removesuffix(":")),)
    people = find_whole_bodies(take, marker_set)
    if len(people) < 2:
        return (take,)
    owners = np.array(take.marker_subjects, object)
    each = [take.extract_markers(np.flatnonzero(owners == person), person or "unnamed") for person in people]
    rest = np.flatnonzero(~np.isin(owners, people))
    if take.visible[:, rest].sum(1).max(initial=0) >= MIN_UNASSIGNED_MARKERS:
        return (*each, take.extract_markers(rest, UNASSIGNED_SUBJECT))
    alone = ", ".join(take.labels[m] for m in rest)
    note = f"Nobody's, and never three of them seen at a time, so left as they are: {alone}."
    return tuple(replace(part, notes=(*part.notes, note)) if alone else part for part in each)


def format_subject_names(bodies: Iterable[Take]) -> str:
    """-> the people's names, as one reads them in a sentence."""
    return " and ".join(body.subject_name for body in bodies if body.subject_name != UNASSIGNED_SUBJECT)


def _select_subject(take: Take, subject_prefix: str) -> Take:
    owners = np.array([owner.casefold() for owner in take.marker_subjects], object)
    which = np.flatnonzero(owners == subject_prefix.casefold())
    if not subject_prefix or not len(which):
        there = ", ".join(dict.fromkeys(owner for owner in take.marker_subjects if owner))
        whose = f"its markers are those of {there}" if there else "its labels carry no names"
        raise TakeError(f"{take.name}: nobody in it is called {subject_prefix!r}; {whose}.")
    if len(which) == len(owners):
        return take
    part = take.extract_markers(which, take.marker_subjects[which[0]])
    return replace(
        part, notes=(*part.notes, f"Only {part.subject_name}'s markers were looked at: the rest of the file is as it was.")
    )


def merge_results(take: Take, subject_results: tuple[CleaningResult, ...]) -> CleaningResult:
    """-> the result of a whole take, from the results of its parts, which it holds; it has no subject or motion of its own.

    What was taken over from a trajectory that nobody named is the first one's who took it.
    """
    mended, labelled, error = take, take, np.full(take.visible.shape, np.nan)
    faults, left, donors = [], [], []
    for each in subject_results:
        which = take.find_marker_indices(each.input_take)
        mended, labelled = _insert_part(mended, which, each.take), _insert_part(labelled, which, each.relabelled_take)
        index = [*which.tolist(), *range(len(take.labels), len(take.labels) + _count_unlabelled(take))]
        faults += [_map_fault_indices(fault, index) for fault in each.faults.items]
        left += [replace(one, marker=index[one.marker]) for one in each.unfilled_runs]
        donors += [index[donor] for donor in each.fragment_donors]
        if each.residual_m is not None:
            error[:, which] = each.residual_m
    changes = tuple(change for each in subject_results for change in each.changes)
    report = {"people": {each.input_take.subject_name: each.report for each in subject_results}}
    found = Faults().add_faults(faults)
    gone = tuple(sorted(left, key=lambda one: (one.marker, one.first)))
    return CleaningResult(
        take,
        labelled,
        mended,
        found,
        changes,
        gone,
        tuple(sorted(donors)),
        None,
        None,
        None,
        error,
        report,
        subject_results=subject_results,
    )


def _insert_part(whole: Take, marker_indices: np.ndarray, part: Take) -> Take:
    """-> the whole take with its markers `which` as they are in a part of it, and the part's unlabelled trajectories."""
    given = {
        "markers": (whole.markers, part.markers),
        "source": (whole.source_points, part.source_points),
        "deviation": (_get_sd(whole.sample_sd, whole), _get_sd(part.sample_sd, part)),
        "computed": (whole.visible & ~whole.measured, part.visible & ~part.measured),
    }
    changed = {}
    for name, (old, new) in given.items():
        changed[name] = old.copy()
        changed[name][:, marker_indices] = new
    return replace(whole, **changed, unlabelled=part.unlabelled)


def _get_sd(deviation: np.ndarray | None, take: Take) -> np.ndarray:
    return np.full(take.visible.shape, np.nan) if deviation is None else deviation


def _count_unlabelled(take: Take) -> int:
    return len(take.unlabelled.labels) if take.unlabelled else 0


def _map_fault_indices(fault: Fault, trajectory_indices: list[int]) -> Fault:
    """-> a part's fault as one of the whole take, where the part's trajectories are those at `index`."""
    moved = {"marker": trajectory_indices[fault.marker], "others": tuple(trajectory_indices[m] for m in fault.other_markers)}
    if isinstance(fault, Fragment) and fault.donor >= 0:
        moved["donor"] = trajectory_indices[fault.donor]
    return replace(fault, **moved)
