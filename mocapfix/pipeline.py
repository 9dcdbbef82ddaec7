"""The stages in order: the map of the whole program."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from mocapfix import animated, calibrate, change_file, decisions, fill, looks, mend, notes, people, read, record, solved
from mocapfix import marker_set as sets
from mocapfix import prior as priors
from mocapfix.animation import Animation
from mocapfix.change_file import Decided
from mocapfix.clock import Clock, Progress
from mocapfix.errors import SceneError, TakeError
from mocapfix.faults import MENDED
from mocapfix.fill import FillOptions
from mocapfix.left import named, reasons
from mocapfix.looks import Looked, Stands
from mocapfix.marker_set import MarkerSet
from mocapfix.mend import Parts
from mocapfix.prior import models
from mocapfix.prior.contract import PoseModel
from mocapfix.result import Result
from mocapfix.scenes import PRIOR, START, STARTS
from mocapfix.skeleton import cmu31
from mocapfix.solve import SolveOptions
from mocapfix.solved import How, Solved, asked, wearing
from mocapfix.subject import Subject
from mocapfix.take import Take

ANYTHING = FillOptions()  # may be touched
# The matrices are small and the kernels have threads of their own: BLAS's only stand in the way where cores are busy.
ONE_THREAD = threadpool_limits.wrap(limits=1, user_api="blas")
SOLVES = 3  # at most, with a look at the body after each but the last


@ONE_THREAD
def clean(
    path: str | Path,
    *,
    marker_set: str | Path | None = None,
    subject: str | Path | Subject | None = None,
    prior: str = PRIOR,
    prior_scale: float = 1.0,
    init: str = START,
    options: FillOptions = ANYTHING,
    only: Sequence[str] = (),
    changes: str | Path | Sequence[str | Path] | None = None,
    subject_prefix: str | None = None,
    up: str | None = None,
    hierarchy: str | Path | None = None,
    progress: Progress | None = None,
) -> Result:
    """-> the take at `path`, cleaned: faults found, labels put right, the body calibrated and solved, the rest mended. An
    animation goes its own, shorter way (see mocapfix.animated).

    marker_set  a shipped set's name or a YAML file; None chooses by the take's labels
    subject     a subject file (or a Subject) from an earlier calibration; None calibrates from this take
    prior       what people's poses are like, where a limb is lost: a trained prior's name, its .safetensors file, or "none"
    prior_scale  times the prior's standard deviations: with 2 it is believed half as much
    init        the way to each frame's first pose, from which it is solved: one of scenes.STARTS
    options     what may be touched and how sure a fill must be
    only        the kinds of fault that are mended, of faults.MENDED; none named: all
    changes     the changes file of an earlier cleaning of this take, with somebody's decisions; of several people's one each
    subject_prefix  the one person whose markers are cleaned ("Jim", whose labels are "Jim:LFHD" and the like); None: everybody,
                in turn, and the result holds each one's
    up          "X", "Y" or "Z": the file's axis that points to the sky; None: what the file says or its markers tell
    hierarchy   of an animation: how its joints are called, a shipped style or a YAML file; None: as its names tell
    progress    told each stage's name as it begins

    Raises MocapfixError with a sentence for a technician; nothing is written.
    """
    how, clock = wanted(prior, prior_scale, init, only), Clock(progress=progress)
    with clock("read"):
        take = read.take(path, up)
    fill.check(take, options)
    files = [changes] if isinstance(changes, str | Path) else changes or ()
    about_markers = {"--marker-set": marker_set, "--subject": subject, "--subject-prefix": subject_prefix}
    animated.check(take, about_markers | {"--init": init != START, "--refill": options.refill}, hierarchy)
    if isinstance(take.layout, Animation):
        return animated.clean(take.layout, how, hierarchy, options, only, files, clock)
    bodies = parted(take, marker_set, subject, subject_prefix)
    decided = change_file.of_each(files, bodies)
    cleaned: list[Result] = []
    for body, decisions_on in zip(bodies, decided, strict=True):
        if cleaned:  # what one took over of the unlabelled is not there for the next
            body = replace(body, unlabelled=cleaned[-1].take.unlabelled)
        worn = dressed(body, marker_set, subject)
        cleaned.append(alone(body, *worn, how, options, only, decisions_on, Clock(dict(clock.seconds), progress)))
    return cleaned[0] if len(cleaned) == 1 else people.together(take, tuple(cleaned))


def parted(
    take: Take, marker_set: str | Path | None, subject: str | Path | Subject | None, prefix: str | None
) -> tuple[Take, ...]:
    """-> the takes to be cleaned by themselves: one for each of several people, else the take as it is.

    Raises TakeError where one subject is given for several people.
    """
    _, worn_set = asked(marker_set, subject)
    bodies = people.parts(take, worn_set, prefix)
    if subject is not None and len(bodies) > 1:
        shown = people.listed(bodies)
        raise TakeError(f"{take.name}: shows {shown}, and a subject is one person; say whose it is with --subject-prefix.")
    return bodies


def dressed(
    body: Take, marker_set: str | Path | None, subject: str | Path | Subject | None
) -> tuple[Subject | None, MarkerSet | None, list[str]]:
    """-> who and what a take shows, as `solved.wearing`; what is nobody's among several people is no body."""
    if body.person == people.OTHERS:
        return None, None, ["What is no whole body's: cleaned without a skeleton, from how markers move together."]
    return wearing(body, marker_set, subject)


def alone(
    take: Take,
    known: Subject | None,
    worn_set: MarkerSet | None,
    said: Sequence[str],
    how: How,
    options: FillOptions,
    only: Sequence[str],
    decided: tuple[Decided, ...],
    clock: Clock,
) -> Result:
    """-> a take of one person, or of none, cleaned; `known`, `worn_set` and `said` as from `dressed`."""
    looked, parts, body = understood(take, worn_set, known, how, change_file.vouched(take, decided), clock, options.refill)
    with clock("fill"):
        whole, why, ways = filled(looked, parts, body, options)
        placed, touch = body.of_take(parts) if body else None, fill.touchable(take, options)
        after, made = decisions.taken(take, looked, whole, placed, ways, touch, only, decided)
        left = named(after, np.where(whole.seen, "its change was not to be made", why))
    error = None if placed is None else np.linalg.norm(looked.believed.markers - placed, axis=-1)
    report = {
        "take": record.of_take(take, worn_set.name if worn_set else None),
        "faults": record.of_faults(take, looked.faults),
        "changes": change_file.plain(made),
        "subject": record.of_subject(body.person) if body else None,
        "solve": None,
        "fill": record.of_fill(take, looked.take, after, left, looked.donors),
        "seconds": clock.seconds,
        "notes": [*take.notes, *said, *notes.guesses(after)],
    }
    if body and error is not None:
        report["solve"] = record.of_solve(
            take, body.person, body.motion, error, how.prior, how.options.prior_scale, how.start
        )
        report["notes"] = [*take.notes, *said, *notes.of_body(looked, parts, body, error), *notes.guesses(after)]
    found = (body.person, body.motion, body.joints) if body else (None, None, None)
    return Result(take, looked.take, after, looked.faults, made, left, looked.donors, *found, error, report)


@ONE_THREAD
def inspected(
    path: str | Path,
    marker_set: str | Path | None = None,
    subject: str | Path | Subject | None = None,
    progress: Progress | None = None,
    subject_prefix: str | None = None,
    up: str | None = None,
    hierarchy: str | Path | None = None,
) -> list[dict]:
    """-> the record's take, faults and notes of what `clean` would find, for each of several people; nothing is written.

    Raises as `clean`.
    """
    clock, how, found = Clock(progress=progress), wanted(PRIOR, 1.0, START, ()), []
    take = read.take(path, up)
    animated.check(take, {"--marker-set": marker_set, "--subject": subject, "--subject-prefix": subject_prefix}, hierarchy)
    if isinstance(take.layout, Animation):
        return [animated.inspected(take.layout, hierarchy)]
    for body in parted(take, marker_set, subject, subject_prefix):
        known, worn_set, _ = dressed(body, marker_set, subject)
        looked, _, _ = understood(body, worn_set, known, how, lambda fault: True, clock)
        said = sets.fit(worn_set, body.labels) if worn_set else sets.choose(body.labels).reason
        found.append(record.of_inspection(body, worn_set.name if worn_set else None, body, looked.faults, [*body.notes, said]))
    return found


def wanted(prior: str, prior_scale: float, init: str, only: Sequence[str]) -> How:
    """-> how the body is to be found. Raises SceneError where something is asked for that there is not."""
    if not 0 < prior_scale < float("inf"):
        raise SceneError(f"A prior's scale must be more than 0 and finite, not {prior_scale:g}.")
    if init not in STARTS:
        raise SceneError(f"There is no start {init!r}; choose one of: {', '.join(STARTS)}.")
    if strange := [kind for kind in only if kind not in MENDED]:
        raise SceneError(f"There is no kind of fault {strange[0]!r} to mend; choose of: {', '.join(MENDED)}.")
    return How(trained(prior), SolveOptions(prior_scale=prior_scale), init, prior)


def trained(name: str) -> Callable[[], PoseModel] | None:
    """-> what loads a trained prior when it is first asked for, for not every take needs one; None for "none".

    Raises SceneError where there is no such prior.
    """
    if name == "none":
        return None
    models.find(name)
    return cache(lambda: models.load(name, cmu31().skeleton))


def understood(
    take: Take, worn_set: MarkerSet | None, subject: Subject | None, how: How, stands: Stands, clock: Clock, refill: bool = False
) -> tuple[Looked, Parts, Solved | None]:
    """-> what is wrong with a take, its parts, and its body (None where no marker set fits).

    The first look is at the trajectories, each other at the body that was solved from what was believed until then.
    """
    with clock("detect"):
        looked = looks.first(take, worn_set, subject, stands, refill)
    if not looked.believed.seen.sum(1).max() >= 3:
        raise TakeError(f"{take.name}: no frame shows three markers, so nothing can be placed; check the labels and the export.")
    parts = mend.parted(looked.take, looked.faults.items)
    if worn_set is None:
        return looked, parts, None
    for solves in range(1, SOLVES + 1):
        body = solved.body(parts, parts.split(looked.heard), worn_set, subject, how, clock)
        if solves == SOLVES:
            break
        with clock("detect"):
            more = looks.again(looked, parts, body, worn_set, stands)
        if more is None:
            break
        looked, parts = more, mend.parted(more.take, more.faults.items)
    return looked, parts, body


def filled(looked: Looked, parts: Parts, body: Solved | None, options: FillOptions) -> tuple[Take, np.ndarray, np.ndarray]:
    """-> the take with all that is missing or doubted filled or emptied, and (T, M) sentences: why what is empty is so, and how
    what was filled was found.

    What a program filled before stays as it is, and a label that only names pieces of another marker is not filled.
    """
    take, believed = looked.take, looked.believed.seen
    given = (body.columns, body.worn, body.motion) if body else (np.zeros(0, int), None, None)
    lasting = fill.lasting(believed, take.rate)[:, parts.marker]
    after, left, way = fill.take(parts.take, parts.split(believed), lasting, *given, options)
    stays = take.seen & ~take.measured
    stays[:, list(looked.donors)] = True
    stays |= believed  # also while a marker slides from place to place
    sure = np.full(after.seen.shape, np.nan) if after.deviation is None else after.deviation
    markers = np.where(stays[..., None], take.markers, parts.joined(after.markers))
    why = parts.joined(reasons(left, after.seen.shape))
    ways = np.where(stays, "", parts.joined(np.array([*fill.WAYS, ""], object)[way]))
    return take.with_markers(markers, np.where(stays, np.nan, parts.joined(sure))), why, ways


@ONE_THREAD
def calibrated(
    paths: Sequence[str | Path],
    name: str | Path | None = None,
    pose_prior: str = "mean-pose",
    subject_prefix: str | None = None,
    up: str | None = None,
) -> Subject:
    """-> one person's subject from one or several takes of them, together; of the one named, where others are in them too.

    Raises TakeError where no marker set fits, the takes do not wear the same one, or one shows several people and none is named.
    """
    takes = []
    for path in paths:
        whole = read.take(path, up)
        animated.check_markers(whole)
        take, *more = parted(whole, name, None, subject_prefix)
        if more:
            raise TakeError(
                f"{whole.name}: shows {people.listed((take, *more))}; say whose bones are wanted with --subject-prefix."
            )
        takes.append(take)
    worn, sets = [], []
    for take in takes:
        _, worn_set, notes = wearing(take, name, None)
        if worn_set is None:
            raise TakeError(f"{take.name}: {notes[0]} There is no body to calibrate.")
        sets.append(worn_set)
        looked = looks.first(take, worn_set, None, lambda fault: True)
        worn.append(looked.take.worn(worn_set.columns(take.labels), looked.believed.seen))
    if len({each.name for each in sets}) > 1:
        names = ", ".join(f"{take.name} ({each.name})" for take, each in zip(takes, sets, strict=True))
        raise TakeError(f"The takes wear different marker sets: {names}; calibrate them apart, or name one with --marker-set.")
    together = worn[0].with_markers(np.concatenate([each.markers for each in worn]))
    body = cmu31()
    return calibrate.subject(together, sets[0], body, priors.load(pose_prior, body.skeleton))
