"""The stages in order for an animation: what a solver, a suit or a film made of somebody's joints, cleaned.

    animation = read                            its own numbers, and what they mean: turns of joints, a place of the root
    faults    = detect.turns.found(...)         what is lost, pops and flips, trembles
    mended    = solve.turns.mended(...)         each as its kind allows
    put_back  what is not to be touched, and what was decided against

The points of the take that is shown are the joints' tips, so that a joint which turns wrongly is a point in the wrong place.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix import change_file, changes, notes, record
from mocapfix.animated_result import AnimatedResult
from mocapfix.animation import Animation
from mocapfix.clock import Clock, Progress
from mocapfix.detect import turns as detected
from mocapfix.errors import SceneError
from mocapfix.faults import MENDED, Fault, Faults, over
from mocapfix.fill import FillOptions, touchable
from mocapfix.left import named
from mocapfix.pipeline import ANYTHING, ONE_THREAD, check_options
from mocapfix.solve import turns as solved
from mocapfix.take import Take


@ONE_THREAD
def clean_animation(
    animation: Animation,
    *,
    options: FillOptions = ANYTHING,
    only: Sequence[str] = (),
    decisions: str | Path | None = None,
    progress: Progress | None = None,
) -> AnimatedResult:
    """-> an animation cleaned: what is wrong with its joints' turns and its root's place found and mended; all else as it was.

    options    what may be touched: the joints kept and the only frames (the file's, from 1)
    only       the kinds of fault that are mended, of faults.MENDED; none named: all
    decisions  the changes file of an earlier cleaning of this animation, with somebody's decisions
    progress   told each stage's name as it begins

    Raises MocapfixError with a sentence for a technician; nothing is written.
    """
    if strange := [kind for kind in only if kind not in MENDED]:
        raise SceneError(f"There is no kind of fault {strange[0]!r} to mend; choose of: {', '.join(MENDED)}.")
    clock = Clock(progress=progress)
    local, root = animation.rotations(), animation.places()[:, 0]
    orders = [axes(animation, j) for j in range(len(animation.names))]
    before = tips(animation)
    check_options(before, options)
    decided = change_file.load(decisions, before) if decisions else ()
    with clock("detect"):
        found = detected.found(animation.names, root, local, orders, animation.rate)
        found = [fault for fault in found if not _of_decision(fault, decided, "keep")]
        before = _without_lost(before, found)
    with clock("solve"):
        mended = solved.mended(animation.parents, root, local, orders, found, animation.rate)
    made = [f for f in found if _asked(f, only) and not _of_decision(f, decided, "reject")]
    touched = touchable(before, options) & over(made, before.seen.shape) & (mended.way != solved.AS_IT_IS)
    values = put(animation, mended, touched)
    cleaned = animation.with_values(values)
    after = _after(before, tips(cleaned), reach(cleaned, mended.variance), touched)
    found = [_measured(fault, before, after) for fault in found]
    told = Faults(tuple(sorted(found, key=lambda f: (f.marker, f.first))))
    ways = np.where(touched, np.array(solved.WAYS, object)[mended.way], "")
    # each entry is about a fault whose samples were changed; what was decided against is told as it was
    entries = [change for change, _ in changes.made(before, before, after, told.items, None, ways)]
    entries += [each.as_change() for each in decided]
    left = named(after, np.full(after.seen.shape, "nothing tells of it", object))
    report = {
        "take": record.of_take(before, None),
        "faults": record.of_faults(before, told),
        "changes": change_file.plain(entries),
        "subject": None,
        "solve": None,
        "fill": record.of_fill(before, before, after, left),
        "seconds": clock.seconds,
        "notes": [*animation.notes, *notes.guesses(after)],
    }
    return AnimatedResult(animation, cleaned, before, after, told, tuple(entries), left, report)


def axes(animation: Animation, joint: int) -> str:
    """-> a joint's axes of rotation, the outermost first, as "ZYX"; "" where it has none of its own."""
    return "".join("XYZ"[axis] for axis in animation.turning(joint)[1])


def tips(animation: Animation) -> Take:
    """-> the take of an animation: where each joint's tip is, the middle of its children and end sites, and last its root."""
    position, rotation = animation.world()
    markers = np.empty((animation.frames, len(animation.names) + 1, 3))
    for j in range(len(animation.names)):
        children = position[:, animation.parents == j]
        ends = animation.ends[j] @ animation.axes.T * animation.unit
        beyond = position[:, [j]] + ends @ np.swapaxes(rotation[:, j], -1, -2)
        points = np.concatenate([children, beyond], axis=1)
        markers[:, j] = points.mean(1) if points.shape[1] else position[:, j]
    markers[:, -1] = position[:, 0]
    return Take(markers, (*animation.names, f"{animation.names[0]}'s place"), animation.rate, path=animation.path)


def put(animation: Animation, mended: solved.Mended, touched: np.ndarray) -> np.ndarray:
    """-> (T, C) the animation's values with the courses `touched` (T, N) as they are mended, and all others as they were."""
    now = animation
    for j in np.flatnonzero(touched[:, :-1].any(0)):
        frames = np.flatnonzero(touched[:, j])
        now = now.with_values(now.with_rotations(np.array([j]), frames, mended.local[frames, j][:, None]))
    frames = np.flatnonzero(touched[:, -1])
    return now.with_places(np.array([0]), frames, mended.root[frames][:, None]) if len(frames) else now.values


def reach(animation: Animation, variance: np.ndarray) -> np.ndarray:
    """-> (T, N) metres per axis: how unsure the tips are where the courses have a variance (T, N), rad^2 and m^2 per axis: a
    turn by a small angle about an axis moves a point by that times its distance from the axis."""
    joints, points = animation.world()[0], tips(animation).markers
    square = np.tile(variance[:, -1:], (1, variance.shape[1]))
    for j in range(len(animation.parents)):
        at = j
        while at >= 0:
            square[:, j] += variance[:, at] * ((points[:, j] - joints[:, at]) ** 2).sum(-1) * 2 / 3
            at = animation.parents[at]
    return np.sqrt(square)


def _without_lost(take: Take, faults: Sequence[Fault]) -> Take:
    """-> the take without what is there only as zeros."""
    lost = over([fault for fault in faults if fault.kind == "gap"], take.seen.shape)
    return replace(take, markers=np.where(lost[..., None], np.nan, take.markers))


def _after(before: Take, mended: Take, unsure: np.ndarray, touched: np.ndarray) -> Take:
    return before.with_markers(mended.markers, np.where(touched, unsure, np.nan))


def _measured(fault: Fault, before: Take, after: Take) -> Fault:
    """-> the fault with how far, in metres, its points lie from where they are put; NaN where they were not there."""
    away = np.linalg.norm((before.markers - after.markers)[fault.frames][:, list(fault.markers)], axis=-1)
    known = away[~np.isnan(away)]
    return replace(fault, severity=float(known.mean()) if len(known) else np.nan)


def _asked(fault: Fault, only: Sequence[str]) -> bool:
    return not only or fault.kind in only


def _of_decision(fault: Fault, decided: Sequence[change_file.Decided], decision: str) -> bool:
    return any(each.decision == decision and each.about(fault) for each in decided)

