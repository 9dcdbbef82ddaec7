"""A take's body: which set it wears, whose it is, and how it moves."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix import calibrate, initialise, marker_set, prior, solve, subject_file
from mocapfix.calibrate.places import with_places
from mocapfix.clock import Clock
from mocapfix.errors import TakeError
from mocapfix.kernels import kinematics
from mocapfix.marker_set import MarkerSet
from mocapfix.mend import Parts
from mocapfix.motion import Motion
from mocapfix.prior.contract import PoseModel
from mocapfix.skeleton import cmu31
from mocapfix.solve import SolveOptions
from mocapfix.subject import Subject
from mocapfix.take import Take


@dataclass(frozen=True)
class How:
    """How a body is found: what poses are like, what the solve believes, from which start, and the name of the poses' model."""

    model: Callable[[], PoseModel] | None
    options: SolveOptions
    start: str
    prior: str = "none"


@dataclass(frozen=True)
class Solved:
    """A body and its motion.

    person   the subject;  worn  the subject and a marker more for every new place of a moved one
    columns  (K,) the column among the take's parts of each of `worn`'s markers, -1 where it has none
    joints   (T, J, 3) metres;  markers (T, K, 3) metres, where the body has them
    """

    person: Subject
    worn: Subject
    motion: Motion
    columns: np.ndarray
    joints: np.ndarray
    markers: np.ndarray

    def of_take(self, parts: Parts) -> np.ndarray:
        """-> (T, M, 3) metres: where the body has the take's markers, NaN where it has none."""
        there = self.columns >= 0
        out = np.full(parts.take.markers.shape, np.nan)
        out[:, self.columns[there]] = self.markers[:, there]
        return parts.joined(out)


def wearing(
    take: Take, name: str | Path | None, subject: str | Path | Subject | None
) -> tuple[Subject | None, MarkerSet | None, list[str]]:
    """-> the subject where one is given, the marker set that the take wears (None where none fits), and notes on that.

    Raises TakeError where the set or subject that was named does not fit the take.
    """
    known, worn_set = asked(name, subject)
    if worn_set is None:
        choice = marker_set.choose(take.labels)
        without = [] if choice.marker_set else [choice.reason, "The take was cleaned without a skeleton: there is no BVH."]
        return None, choice.marker_set, without
    found = worn_set.match(take.labels)
    if lack := worn_set.lack(found):
        raise TakeError(f"{take.name}: {worn_set.name} does not fit: {len(found)} of its {len(worn_set.labels)} markers, {lack}.")
    return known, worn_set, []


def asked(name: str | Path | None, subject: str | Path | Subject | None) -> tuple[Subject | None, MarkerSet | None]:
    """-> the subject and the marker set that were named, None where none was."""
    if subject is not None:
        known = subject if isinstance(subject, Subject) else subject_file.load(subject)
        return known, marker_set.of_subject(known)
    return None, None if name is None else marker_set.load(name)


def body(parts: Parts, heard: np.ndarray, worn_set: MarkerSet, subject: Subject | None, how: How, clock: Clock) -> Solved:
    """-> the take's body: the subject, calibrated where it is not known yet, and its motion; a moved marker's new place is
    found on the body that the others show, and then tells as well.

    heard  (T, C) bool: the samples of the parts' columns that the body listens to
    """
    columns = worn_set.columns(parts.take.labels)
    worn = parts.take.worn(columns, heard)
    if subject is None:
        with clock("calibrate"):
            subject = calibrate.subject(worn, worn_set, cmu31(), prior.load("mean-pose", cmu31().skeleton))
    person, motion = subject, moving(worn, subject, how, clock)
    which = {int(column): k for k, column in enumerate(columns)}
    more = np.array([column for column in parts.more if int(parts.marker[column]) in which], int)
    if len(more):
        shown = parts.take.worn(more, heard).markers
        subject, enough = with_places(subject, motion, shown, np.array([which[int(parts.marker[c])] for c in more]))
        columns = np.r_[columns, more[enough]]
        motion = moving(parts.take.worn(columns, heard), subject, how, clock)
    joints, markers = kinematics.placed(subject, motion)
    return Solved(person, subject, motion, columns, joints, markers)


def moving(worn: Take, subject: Subject, how: How, clock: Clock) -> Motion:
    """-> the subject's motion in a take of its markers, in the subject's order."""
    average = cmu31()
    poses = prior.load("mean-pose", average.skeleton)
    with clock("initialise"):
        start = initialise.motion(worn, subject, average, poses, how.start)
    with clock("solve"):
        return solve.motion(worn, subject, average, poses, prior.load_limits(average.skeleton), start, how.options, how.model)
