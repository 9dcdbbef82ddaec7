"""Shifted: markers that go elsewhere on their segment and stay there, by more than the solved body follows.

A marker's path on its segment is what the body leaves of its motion. How far the joints about it turn explains a part of
that, for no joint is quite where the body has it, and no skin keeps quite still. What they leave is fitted by one change, at any
time: at once (knocked, stuck on again) or slowly (it slides). It is believed where it is large beside all else that is left.

The body leans towards a marker that was moved, so that others about it seem to move, too: of those on joints next to each
other only the greatest change is believed, and then the body is asked again.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from mocapfix.detect import changes
from mocapfix.detect.changes import Change
from mocapfix.detect.off_body import OffBody
from mocapfix.detect.places import Place, beside
from mocapfix.faults import Moved
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject
from mocapfix.take import Take

PACE = 10.0  # Hz: so many frames a second are looked at
LEAST = 4.0  # seconds: for how long a marker is seen at least
RIDGE = 0.1  # radians: a turn of a joint that means nothing
SMALLEST = 0.008  # metres: of what the body leaves of a change
EDGE = 1.0  # seconds: what must be seen before and after a change
SURE = 1.8  # times what else is left: how large a knock is at least
BESIDE, JUST = 1.0, 0.03  # seconds about a knock in which its frame is looked for, and just before and after that frame
JUMP, CLEAR = 0.5, 8.0  # of the change, and times what it usually jumps about then: what the marker jumps there at least
SLOW, TOGETHER, SLOWLY_SURE = 4.0, 1.0, 3.5  # seconds a slide lasts at least, those of a mean, and times what those leave


class Shift(NamedTuple):
    """A marker that is elsewhere on its segment from frame `settled` on; until `first` it is where it was.

    size  metres, as far as the body does not follow;  gain  square metres: what of its path that explains
    sure  times what else is left of its path, and what is needed
    """

    marker: int
    first: int
    settled: int
    size: float
    gain: float
    sure: float


def shifts(off: OffBody, subject: Subject, motion: Motion, rate: float) -> list[Shift]:
    """-> the markers that seem to be shifted, by index: at most one change of each.

    off  how far the samples of the subject's markers lie off the body that has this motion; rate in Hz
    """
    step = max(1, round(rate / PACE))
    turns = {joint: _turns(subject.skeleton, motion, joint, step) for joint in set(subject.joints.tolist())}
    seen = (_seen(off.path[:, k], turns[int(joint)], k, rate, step) for k, joint in enumerate(subject.joints))
    return [shift for shift in seen if shift]


def worst(seeming: list[Shift], subject: Subject) -> list[Shift]:
    """-> those on joints not next to that of a greater one, the greatest first."""
    chosen: list[Shift] = []
    for shift in sorted(seeming, key=lambda each: -each.gain):
        if not any(neighbours(subject, shift.marker, other.marker) for other in chosen):
            chosen.append(shift)
    return chosen


def neighbours(subject: Subject, one: int, other: int) -> bool:
    """Are two markers on the same joint, or on one and its parent?"""
    a, b = int(subject.joints[one]), int(subject.joints[other])
    return a == b or subject.skeleton.parents[a] == b or subject.skeleton.parents[b] == a


def fault(shift: Shift, take: Take) -> Moved:
    """-> a shift as a marker that was knocked or slid."""
    label, seconds = take.bare_labels[shift.marker], (shift.settled - shift.first) / take.rate
    how = f"slides in {seconds:.0f} s" if seconds else "is knocked"
    reason = f"{label} {how} and stays elsewhere on its segment: {shift.size * 1e3:.0f} mm of that the body cannot follow."
    kind, sure = ("drift" if seconds else "moved"), shift.sure / (1 + shift.sure)
    return Moved(kind, shift.marker, shift.first, take.frames - 1, shift.size, reason, sure, settled=shift.settled)


def _turns(skeleton: Skeleton, motion: Motion, joint: int, step: int) -> np.ndarray:
    """-> (N, 3 J) radians: how a joint, but the root, and its children are turned in every `step`th frame."""
    about = [j for j, parent in enumerate(skeleton.parents) if joint in (j, parent) and parent >= 0]
    return np.concatenate([Rotation.from_matrix(motion.rotations[::step, j]).as_rotvec() for j in about], axis=1)


def _seen(path: np.ndarray, turns: np.ndarray, marker: int, rate: float, step: int) -> Shift | None:
    """-> the change that explains most of a marker's path (T, 3) metres, None where it is not sure that there is one."""
    some, pace = path[::step], rate / step
    frames = np.flatnonzero(~np.isnan(some[:, 0]))
    if len(frames) < LEAST * pace:
        return None
    there = beside(turns[frames], median_filter(some[frames], (3, 1), mode="nearest"), frames, RIDGE)
    knock, slide = changes.sudden(there, round(EDGE * pace)), changes.slow(there, round(SLOW * pace), round(TOGETHER * pace))
    sudden = knock and (slide is None or knock.gain > slide.gain) and _knock(path, there, knock, marker, rate, step)
    return sudden or (slide and _slide(there, slide, marker, pace, step))


def _knock(path: np.ndarray, there: Place, change: Change, marker: int, rate: float, step: int) -> Shift | None:
    sure = change.size / changes.rest(there, change, 1) / SURE
    before, after = (int(there.frames[at]) * step for at in (change.start, change.end))
    first, jump, usual = _onset(path, before, after, change.way, rate)
    if change.size < SMALLEST or sure < 1 or jump < max(JUMP * change.size, CLEAR * usual):
        return None
    return Shift(marker, first, first, change.size, change.gain, sure)


def _slide(there: Place, change: Change, marker: int, pace: float, step: int) -> Shift | None:
    """-> a slow change, None where it is not sure, or is not seen to begin and to end, or would rather be quicker."""
    sure = change.size / changes.rest(there, change, round(TOGETHER * pace)) / SLOWLY_SURE
    within = EDGE * pace <= change.start and change.end <= len(there.left) - EDGE * pace
    if change.size < SMALLEST or sure < 1 or not within or change.end - change.start <= round(SLOW * pace):
        return None
    first, settled = (int(there.frames[at]) * step for at in (change.start, change.end))
    return Shift(marker, first, settled, change.size, change.gain, sure)


def _onset(path: np.ndarray, before: int, after: int, way: np.ndarray, rate: float) -> tuple[int, float, float]:
    """-> the first frame at the new place, how far the marker jumps there along `way` (3,), and how far it usually does, metres.

    Of the frames from BESIDE before to BESIDE after those given, the one at which the path (T, 3) jumps farthest.
    """
    begin, aside = max(0, before - round(BESIDE * rate)), max(1, round(JUST * rate))
    along = path[begin : after + round(BESIDE * rate) + 1] @ (way / np.linalg.norm(way))
    seen = np.flatnonzero(~np.isnan(along))
    if len(seen) < 4 * aside:
        return after, 0.0, 0.0
    total, cuts = np.r_[0, np.cumsum(along[seen])], np.arange(aside, len(seen) - aside + 1)
    jump = (total[cuts + aside] - 2 * total[cuts] + total[cuts - aside]) / aside
    most = int(jump.argmax())
    usual = np.sqrt(np.mean(jump[abs(cuts - cuts[most]) >= aside] ** 2))
    return begin + int(seen[cuts[most]]), float(jump[most]), float(usual)
