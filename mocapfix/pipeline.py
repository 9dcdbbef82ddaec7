"""The stages in order: the map of the whole program."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from mocapfix import calibrate, detect, fill, initialise, marker_set, prior, read, record, solve, subject_file
from mocapfix.clock import Clock, Progress
from mocapfix.errors import SceneError, TakeError
from mocapfix.fill import FillOptions
from mocapfix.kernels import kinematics
from mocapfix.marker_set import MarkerSet
from mocapfix.motion import Motion
from mocapfix.prior import models
from mocapfix.prior.contract import PoseModel
from mocapfix.result import Result
from mocapfix.scenes import PRIOR, START, STARTS
from mocapfix.skeleton import cmu31
from mocapfix.solve import SolveOptions
from mocapfix.subject import Subject
from mocapfix.take import Take, runs

ANYTHING = FillOptions()  # may be touched
GUESS = 0.06  # metres per axis: a fill less sure than this is named
ASTRAY, STAYS = 0.1, 0.05  # metres and seconds: a marker so far from the body for so long is worth a look
FAR = 0.06  # metres: a marker that lies farther from the body most of the time is hardly the marker it is labelled


def clean(
    path: str | Path,
    *,
    marker_set: str | Path | None = None,
    subject: str | Path | Subject | None = None,
    prior: str = PRIOR,
    prior_scale: float = 1.0,
    init: str = START,
    options: FillOptions = ANYTHING,
    progress: Progress | None = None,
) -> Result:
    """-> the take at `path`, cleaned: faults found, the body calibrated and solved, gaps and faulty samples mended.

    marker_set  a shipped set's name or a YAML file; None chooses by the take's labels
    subject     a subject file (or a Subject) from an earlier calibration; None calibrates from this take
    prior       what people's poses are like, where a limb is lost: a trained prior's name, its .safetensors file, or "none"
    prior_scale  times the prior's standard deviations: with 2 it is believed half as much
    init        the way to each frame's first pose, from which it is solved: one of scenes.STARTS
    options     what may be touched and how sure a fill must be
    progress    told each stage's name as it begins

    Raises MocapfixError with a sentence for a technician; nothing is written.
    """
    if not 0 < prior_scale < float("inf"):
        raise SceneError(f"A prior's scale must be more than 0 and finite, not {prior_scale:g}.")
    if init not in STARTS:
        raise SceneError(f"There is no start {init!r}; choose one of: {', '.join(STARTS)}.")
    clock, model = Clock(progress=progress), trained(prior)
    weighed = SolveOptions(prior_scale=prior_scale)
    with clock("read"):
        take = read.take(path)
    check_options(take, options)
    with clock("detect"):
        faults = detect.faults(take)
    believed = faults.believed(take)
    if not (believed.sum(1) >= 3).any():
        raise TakeError(f"{take.name}: no frame shows three markers, so nothing can be placed; check the labels and the export.")
    known, set_of_take, notes = wearing(take, marker_set, subject)
    motion, joints, error, columns = None, None, None, np.zeros(0, int)
    if set_of_take is not None:
        columns = set_of_take.columns(take.labels)
        known, motion = posed(take.worn(columns, faults.heard(take)), set_of_take, known, model, weighed, init, clock)
        joints, error, more = held_against(take, take.worn(columns, believed), columns, known, motion)
        notes += more
    with clock("fill"):
        after, left = fill.take(take, believed, columns, known, motion, options)
    notes += guesses(after)
    solved = None
    if known and motion and error is not None:
        solved = record.of_solve(take, known, motion, error, prior, prior_scale, init)
    report = {
        "take": record.of_take(take, set_of_take.name if set_of_take else None),
        "faults": record.of_faults(take, faults),
        "subject": record.of_subject(known) if known else None,
        "solve": solved,
        "fill": record.of_fill(take, after, left),
        "seconds": clock.seconds,
        "notes": notes,
    }
    return Result(take, after, faults, left, known, motion, joints, error, report)


def trained(name: str) -> Callable[[], PoseModel] | None:
    """-> what loads a trained prior when it is first asked for, for not every take needs one; None for "none".

    Raises SceneError where there is no such prior.
    """
    if name == "none":
        return None
    models.find(name)
    return cache(lambda: models.load(name, cmu31().skeleton))


def posed(
    worn: Take,
    worn_set: MarkerSet,
    subject: Subject | None,
    model: Callable[[], PoseModel] | None,
    options: SolveOptions,
    init: str,
    clock: Clock,
) -> tuple[Subject, Motion]:
    """-> the subject, calibrated where it is not known yet, and its motion."""
    body = cmu31()
    poses = prior.load("mean-pose", body.skeleton)
    if subject is None:
        with clock("calibrate"):
            subject = calibrate.subject(worn, worn_set, body, poses)
    with clock("initialise"):
        start = initialise.motion(worn, subject, body, poses, init)
    with clock("solve"):
        motion = solve.motion(worn, subject, body, poses, prior.load_limits(body.skeleton), start, options, model)
    return subject, motion


def calibrated(paths: Sequence[str | Path], name: str | Path | None = None, pose_prior: str = "mean-pose") -> Subject:
    """-> one person's subject from one or several takes of them, together.

    Raises TakeError where no marker set fits, or the takes do not wear the same one.
    """
    takes = [read.take(path) for path in paths]
    worn, sets = [], []
    for take in takes:
        _, worn_set, notes = wearing(take, name, None)
        if worn_set is None:
            raise TakeError(f"{take.name}: {notes[0]} There is no body to calibrate.")
        sets.append(worn_set)
        worn.append(take.worn(worn_set.columns(take.labels), detect.faults(take).believed(take)))
    if len({each.name for each in sets}) > 1:
        names = ", ".join(f"{take.name} ({each.name})" for take, each in zip(takes, sets, strict=True))
        raise TakeError(f"The takes wear different marker sets: {names}; calibrate them apart, or name one with --marker-set.")
    together = worn[0].with_markers(np.concatenate([each.markers for each in worn]))
    body = cmu31()
    return calibrate.subject(together, sets[0], body, prior.load(pose_prior, body.skeleton))


def wearing(
    take: Take, name: str | Path | None, subject: str | Path | Subject | None
) -> tuple[Subject | None, MarkerSet | None, list[str]]:
    """-> the subject where one is given, the marker set that the take wears (None where none fits), and notes on that.

    Raises TakeError where the set or subject that was named does not fit the take.
    """
    if subject is not None:
        known = subject if isinstance(subject, Subject) else subject_file.load(subject)
        worn_set = marker_set.of_subject(known)
    elif name is not None:
        known, worn_set = None, marker_set.load(name)
    else:
        choice = marker_set.choose(take.labels)
        without = [] if choice.marker_set else [choice.reason, "The take was cleaned without a skeleton: there is no BVH."]
        return None, choice.marker_set, without
    found = worn_set.match(take.labels)
    if lack := worn_set.lack(found):
        raise TakeError(f"{take.name}: {worn_set.name} does not fit: {len(found)} of its {len(worn_set.labels)} markers, {lack}.")
    return known, worn_set, []


def held_against(
    take: Take, worn: Take, columns: np.ndarray, subject: Subject, motion: Motion
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """-> joints (T, J, 3), each believed marker's distance from the body (T, M), and notes where the body fits badly."""
    joints, markers = kinematics.placed(subject, motion)
    there = columns >= 0
    distance = np.linalg.norm(worn.markers - markers, axis=-1)
    error = np.full(take.seen.shape, np.nan)
    error[:, columns[there]] = distance[:, there]
    return joints, error, [*unmarked(worn, subject), *other_markers(take, columns), *strays(take, error)]


def unmarked(worn: Take, subject: Subject) -> list[str]:
    """-> a note on the joints whose markers the take never shows."""
    shown = set(subject.joints[worn.seen.any(0)].tolist())
    names = [subject.skeleton.names[j] for j in dict.fromkeys(subject.joints.tolist()) if j not in shown]
    return [f"No marker of {', '.join(names)} is in the take: there the pose is people's mean pose."] if names else []


def other_markers(take: Take, columns: np.ndarray) -> list[str]:
    """-> a note on the markers that are not the solved person's."""
    others = [label for m, label in enumerate(take.labels) if m not in columns]
    whose = {take.labels[m].rpartition(":")[0] for m in columns if m >= 0} - {""}
    who = f"The body is {', '.join(sorted(whose))}'s. " if whose and others else ""
    return [f"{who}Not of its marker set, so filled only from how markers move together: {', '.join(others)}."] if others else []


def strays(take: Take, error: np.ndarray) -> list[str]:
    """-> notes on markers that lie far from the body: all along, or over the frames where labels may have been swapped."""
    notes = []
    for m in np.flatnonzero((error > FAR).any(0)):
        seen = ~np.isnan(error[:, m])
        if (error[:, m] > FAR).sum() > 0.5 * seen.sum():
            far = f"more than {FAR * 1e3:.0f} mm from the body for half the take"
            notes.append(f"{take.labels[m]} lies {far}: is it labelled right?")
            continue
        for first, last in runs(error[:, m] > ASTRAY):
            if (last - first + 1) / take.rate >= STAYS:
                frames = f"frames {take.frame_number(first)} to {take.frame_number(last)}"
                off = f"{np.median(error[first : last + 1, m]) * 1e3:.0f} mm from the body"
                notes.append(f"{take.labels[m]}, {frames}: lies {off} and was kept; look for swapped labels.")
    return notes


def guesses(after: Take) -> list[str]:
    """-> a note on filled samples that are hardly more than guesses, none where all are better."""
    poor = np.zeros(after.seen.shape, bool) if after.deviation is None else after.deviation > GUESS
    if not poor.any():
        return []
    labels = ", ".join(after.labels[m] for m in np.flatnonzero(poor.any(0)))
    return [
        f"{poor.sum()} filled samples are hardly more than guesses, with a predicted error above {GUESS * 1e3:.0f} mm: {labels}."
    ]


def check_options(take: Take, options: FillOptions) -> None:
    """Raise TakeError where --keep or --frames name what the take does not have."""
    known = set(take.labels) | set(take.bare_labels)
    if strange := [label for label in options.keep if label not in known]:
        raise TakeError(f"{take.name}: has no marker {', '.join(strange)} to keep; its markers are {', '.join(take.labels)}.")
    if options.frames:
        first, last = take.first_frame, take.frame_number(take.frames - 1)
        a, b = options.frames
        if a > b:
            raise TakeError(f"{take.name}: frames {a} to {b}: the first must not come after the last.")
        if b < first or a > last:
            raise TakeError(f"{take.name}: frames {a} to {b} are not in the take, which has {first} to {last}.")
