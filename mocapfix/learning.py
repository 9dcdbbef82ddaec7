"""Learning a studio's own marker set from a take: which segment each marker rides on, and where.

Something must be known to begin with: of a shipped set's labels most, else what labels say in words, else nothing but where the
markers are; then how they move decides.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mocapfix import animated, marker_set, people, prior, read
from mocapfix.calibrate import learn, unlabelled
from mocapfix.calibrate.learn import Learnt
from mocapfix.clock import Progress
from mocapfix.errors import TakeError
from mocapfix.marker_set import MarkerSet, words
from mocapfix.skeleton import cmu31
from mocapfix.take import Take

KNOWN, SAID, SEEN = 10.0, 4.0, 3.0  # log odds that a segment is right: by a known set, by words, by where the cloud lies
DOUBTFUL = 0.9  # a marker that is less likely to ride on its segment is named
SURE_SPREAD = 0.02  # metres: of a place that was measured on one person, about another's


@dataclass(frozen=True)
class Lesson:
    """What was learnt from a take.

    marker_set  the new set
    how         a sentence: where its first guess came from
    left_out    label: the reason, for those that ride on no segment
    doubtful    label: the two segments between which it may ride
    residual    metres: how far the set's markers lie from the body on average
    """

    marker_set: MarkerSet
    how: str
    left_out: dict[str, str]
    doubtful: dict[str, str]
    residual: float

    @property
    def comment(self) -> str:
        """What to write above the set."""
        said = [
            f"{self.marker_set.title}. Places are in metres on the average body, in the axes of the joint that carries them;",
            "spread is how far one person's marker lies from there (standard deviation per axis).",
            self.how,
            f"The markers lie {self.residual * 1e3:.1f} mm from the body on average.",
        ]
        said += [f"{label} may as well ride on {segment}." for label, segment in self.doubtful.items()]
        return "\n".join([*said, *(f"Left out: {label} {reason}." for label, reason in self.left_out.items())])


def learnt(
    path: str | Path,
    name: str,
    like: str | Path | None = None,
    subject_prefix: str | None = None,
    up: str | None = None,
    progress: Progress | None = None,
) -> Lesson:
    """-> the marker set that a take wears, as `name`.

    like            a set, shipped or a file, that explains some of the take's labels; None: the one that fits, if any does
    subject_prefix  whose set it is ("Jim", whose labels are "Jim:LFHD"); None: of several people, that of the most markers
    up              the file's axis to the sky, as in `read.take`

    Raises ReadError, SceneError or TakeError with a sentence for a technician.
    """
    tell = progress or (lambda stage: None)
    tell("read")
    take = read.take(path, up)
    animated.check_markers(take)
    if subject_prefix is not None:
        (take,) = people.parts(take, None, subject_prefix)
    take, labels, strangers = somebody(take.only(take.measured))
    tell("guess")
    guess, worth, how = first_guess(take, labels, like)
    tell("learn")
    body = cmu31()
    found = learn.learnt(take, labels, guess, worth, body, prior.load("mean-pose", body.skeleton))
    worn = finished(found, guess, name, f"Learnt from {take.name}", keep=worth == KNOWN)
    if lack := worn.lack(worn.labels):
        raise TakeError(f"{take.name}: no marker set can be learnt: of a body {lack.partition(';')[0]}.")
    reasons = found.attachment.reasons
    left = {label: reason for label, reason in zip(labels, reasons, strict=True) if reason}
    return Lesson(worn, how, {**left, **strangers}, doubted(found, labels), found.residual)


def somebody(take: Take) -> tuple[Take, tuple[str, ...], dict[str, str]]:
    """-> the markers of the subject with the most of them and those of no subject, their labels without the prefix, and why
    others are left out."""
    owners = take.owners
    whose = max(dict.fromkeys(owners), key=lambda owner: (bool(owner), owners.count(owner)))
    chosen: dict[str, int] = {}
    others: dict[str, str] = {}
    for column, (owner, bare) in enumerate(zip(owners, take.bare_labels, strict=True)):
        if owner not in (whose, ""):
            others[take.labels[column]] = f"is {owner}'s, not {whose}'s"
        elif bare in chosen:
            others[take.labels[column]] = "bears the same label as another"
        else:
            chosen[bare] = column
    columns = np.array(list(chosen.values()), int)
    return take.worn(columns, take.seen), tuple(chosen), others


def first_guess(take: Take, labels: tuple[str, ...], like: str | Path | None) -> tuple[MarkerSet, float, str]:
    """-> a guess at some of the markers that shows a body, the log odds that it is right about one, and a sentence on it."""
    there = [label if take.seen[:, m].any() else "" for m, label in enumerate(labels)]
    known = marker_set.load(like) if like else marker_set.choose(there).marker_set
    if known:
        guess = in_their_words(known, there)
        if lack := known.lack(known.match(there)):
            raise TakeError(f"{take.name}: {known.name} is no beginning: of its markers {len(guess.labels)} are there; {lack}.")
        others = " The others are by how they move." if len(guess.labels) < sum(map(bool, there)) else ""
        return guess, KNOWN, f"{marker_set.fit(known, there)}{others}"
    guess = words.guessed([label for label in there if label])
    if not guess.lack(guess.labels):
        return guess, SAID, f"The labels of {len(guess.labels)} markers told about where they are; the rest is by how they move."
    body = cmu31()
    limits = prior.load_limits(body.skeleton)
    guess = unlabelled.guessed(take, labels, body, prior.load("mean-pose", body.skeleton), limits)
    return guess, SEEN, "The labels tell no body: all is by where the markers lie on one and how they move. Look at it once."


def in_their_words(known: MarkerSet, labels: list[str]) -> MarkerSet:
    """-> the part of a set that a take shows, by the take's labels."""
    found = known.match(labels)
    rows = [known.labels.index(label) for label in found]
    return replace(
        known, labels=tuple(labels[column] for column in found.values()), joints=known.joints[rows], places=known.places[rows],
        spread=known.spread[rows], aliases=((),) * len(rows), optional=frozenset(),
    )  # fmt: skip


def finished(found: Learnt, guess: MarkerSet, name: str, title: str, keep: bool) -> MarkerSet:
    """-> the learnt set under its name, every place measured on this person but for those that are to be kept, a known set's."""
    worn, size = found.marker_set, found.subject.skeleton.size / cmu31().skeleton.size
    person = {label: k for k, label in enumerate(found.subject.labels)}
    places, spread = worn.places.copy(), worn.spread.copy()
    for n, label in enumerate(worn.labels):
        k = person.get(label, -1)
        if k >= 0 and not (keep and label in guess.labels) and found.subject.joints[k] == worn.joints[n]:
            places[n], spread[n] = found.subject.places[k] / size, SURE_SPREAD
    return replace(worn, name=name, title=title, places=places, spread=spread, optional=frozenset())


def doubted(found: Learnt, labels: tuple[str, ...]) -> dict[str, str]:
    """-> the markers that may ride on another segment than they were put on, and that one."""
    names, at = cmu31().skeleton.names, found.attachment
    unsure = np.flatnonzero((at.joints >= 0) & (at.sure < DOUBTFUL))
    return {labels[m]: names[at.second[m]] for m in unsure}
