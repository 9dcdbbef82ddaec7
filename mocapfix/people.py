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
from mocapfix.marker_set import MarkerSet, choose
from mocapfix.result import Result
from mocapfix.take import Take

OTHERS = "others"  # what is no whole body's, where there are several
LEAST = 3  # markers in a frame, or nothing can be placed


def names(take: Take, worn_set: MarkerSet | None = None) -> tuple[str, ...]:
    """-> whose whole bodies a take shows, in the order of its labels; "" for the one whose labels have no name.

    worn_set  what they must wear; None: any of the shipped sets
    """
    owners, seen = np.array(take.owners, object), take.seen.any(0)
    worn = {owner: [take.labels[m] for m in np.flatnonzero((owners == owner) & seen)] for owner in dict.fromkeys(take.owners)}
    if worn_set is None:
        return tuple(owner for owner, labels in worn.items() if choose(labels).marker_set)
    return tuple(owner for owner, labels in worn.items() if not worn_set.lack(worn_set.match(labels)))


def parts(take: Take, worn_set: MarkerSet | None = None, prefix: str | None = None) -> tuple[Take, ...]:
    """-> the takes that are to be cleaned, one after the other: the take as it is, unless it shows several whole bodies.

    prefix  the only one whose markers are wanted; whatever else is marked is in no take then

    Raises TakeError where nobody has that name.
    """
    if prefix is not None:
        return (_named(take, prefix.strip().removesuffix(":")),)
    people = names(take, worn_set)
    if len(people) < 2:
        return (take,)
    owners = np.array(take.owners, object)
    each = [take.part(np.flatnonzero(owners == person), person or "unnamed") for person in people]
    rest = np.flatnonzero(~np.isin(owners, people))
    if take.seen[:, rest].sum(1).max(initial=0) >= LEAST:
        return (*each, take.part(rest, OTHERS))
    alone = ", ".join(take.labels[m] for m in rest)
    note = f"Nobody's, and never three of them seen at a time, so left as they are: {alone}."
    return tuple(replace(part, notes=(*part.notes, note)) if alone else part for part in each)


def listed(bodies: Iterable[Take]) -> str:
    """-> the people's names, as one reads them in a sentence."""
    return " and ".join(body.person for body in bodies if body.person != OTHERS)


def _named(take: Take, prefix: str) -> Take:
    owners = np.array([owner.casefold() for owner in take.owners], object)
    which = np.flatnonzero(owners == prefix.casefold())
    if not prefix or not len(which):
        there = ", ".join(dict.fromkeys(owner for owner in take.owners if owner))
        whose = f"its markers are those of {there}" if there else "its labels carry no names"
        raise TakeError(f"{take.name}: nobody in it is called {prefix!r}; {whose}.")
    if len(which) == len(owners):
        return take
    part = take.part(which, take.owners[which[0]])
    return replace(part, notes=(*part.notes, f"Only {part.person}'s markers were looked at: the rest of the file is as it was."))


def together(take: Take, people: tuple[Result, ...]) -> Result:
    """-> the result of a whole take, from the results of its parts, which it holds; it has no subject or motion of its own.

    What was taken over from a trajectory that nobody named is the first one's who took it.
    """
    mended, labelled, error = take, take, np.full(take.seen.shape, np.nan)
    faults, left, donors = [], [], []
    for each in people:
        which = take.of_part(each.before)
        mended, labelled = _with(mended, which, each.take), _with(labelled, which, each.labelled)
        index = [*which.tolist(), *range(len(take.labels), len(take.labels) + _loose(take))]
        faults += [_of_whole(fault, index) for fault in each.faults.items]
        left += [replace(one, marker=index[one.marker]) for one in each.left]
        donors += [index[donor] for donor in each.donors]
        if each.error is not None:
            error[:, which] = each.error
    changes = tuple(change for each in people for change in each.changes)
    report = {"people": {each.before.person: each.report for each in people}}
    found = Faults().with_more(faults)
    gone = tuple(sorted(left, key=lambda one: (one.marker, one.first)))
    return Result(
        take, labelled, mended, found, changes, gone, tuple(sorted(donors)), None, None, None, error, report, people=people
    )


def _with(whole: Take, which: np.ndarray, part: Take) -> Take:
    """-> the whole take with its markers `which` as they are in a part of it, and the part's unlabelled trajectories."""
    given = {
        "markers": (whole.markers, part.markers),
        "source": (whole.sources, part.sources),
        "deviation": (_known(whole.deviation, whole), _known(part.deviation, part)),
        "computed": (whole.seen & ~whole.measured, part.seen & ~part.measured),
    }
    changed = {}
    for name, (old, new) in given.items():
        changed[name] = old.copy()
        changed[name][:, which] = new
    return replace(whole, **changed, unlabelled=part.unlabelled)


def _known(deviation: np.ndarray | None, take: Take) -> np.ndarray:
    return np.full(take.seen.shape, np.nan) if deviation is None else deviation


def _loose(take: Take) -> int:
    return len(take.unlabelled.labels) if take.unlabelled else 0


def _of_whole(fault: Fault, index: list[int]) -> Fault:
    """-> a part's fault as one of the whole take, where the part's trajectories are those at `index`."""
    moved = {"marker": index[fault.marker], "others": tuple(index[m] for m in fault.others)}
    if isinstance(fault, Fragment) and fault.donor >= 0:
        moved["donor"] = index[fault.donor]
    return replace(fault, **moved)
