"""An animation's faults mended: what each kind leaves of the truth is kept.

A pop or a flip hides nothing: it is turned back. A tremble hides little: it is smoothed. Only what is lost is recalled, from the
moments around it and those at which the rest of the body did alike, and from a trained model of people's poses; and of a whole
figure from time alone. Whatever no fault is about stays as it is.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.faults import Fault, over
from mocapfix.kernels import quaternions
from mocapfix.solve import alike, bridged, calmed, recall, unshifted
from mocapfix.solve.people import People
from mocapfix.take import runs

EXACT = 1e-8  # rad^2: the variance of what nobody doubts
MOVES = 1e-3  # radians: a joint that never turns by more rests
WAYS = ("", "its own motion, turned back", "its own motion, smoothed", "moments alike", "the course around it")
AS_IT_IS, TURNED_BACK, SMOOTHED, RECALLED, BRIDGED = range(len(WAYS))


class Mended(NamedTuple):
    """A figure over time, N = J + 1 courses: the joints' turns, and last the root's place.

    root (T, 3) metres;  local (T, J, 3, 3)
    variance (T, N) of what was mended, rad^2 and m^2 per axis, 0 elsewhere;  way (T, N) how: an index into WAYS
    """

    root: np.ndarray
    local: np.ndarray
    variance: np.ndarray
    way: np.ndarray


def mended(
    parents: np.ndarray,
    root: np.ndarray,
    local: np.ndarray,
    orders: Sequence[str],
    faults: Sequence[Fault],
    rate: float,
    people: People | None = None,
) -> Mended:
    """-> the figure without the faults, which are as `detect.turns.found` tells them. root (T, 3), local (T, J, 3, 3): NaN
    where there is no number; orders: each joint's axes of rotation; people: a model of the poses of this very skeleton."""
    shape = (len(root), local.shape[1] + 1)
    gone = over([fault for fault in faults if fault.kind in ("gap", "stuck")], shape)
    local = np.where(gone[:, :-1, None, None], np.eye(3), local)
    root = np.where(gone[:, -1:], 0.0, root)
    work = Mended(root, local, np.zeros(shape), np.zeros(shape, int))
    if not faults:
        return work
    unsound = over(faults, shape)
    for fault in sorted(faults, key=lambda fault: fault.last - fault.first):
        if fault.kind in ("pop", "flip", "spike"):
            _turn_back(work, fault, unsound, orders, rate)
            unsound[fault.frames, fault.marker] = False
    moving = np.flatnonzero(np.ptp(local, axis=0).max((1, 2)) > MOVES)
    for fault in faults:
        if fault.kind == "jitter":
            _smooth(work, fault, unsound, moving, rate)
    unsound &= gone
    whole = gone[:, moving].sum(1) > recall.MOST * len(moving)
    _recall(work, gone & ~whole[:, None], moving, rate, people)
    _bridge(work, parents, gone, whole, rate)
    return work


def _turn_back(work: Mended, fault: Fault, unsound: np.ndarray, orders: Sequence[str], rate: float) -> None:
    j, span, sound = fault.marker, fault.frames, ~unsound[:, fault.marker]
    if fault.kind == "spike":
        work.root[span], variance = unshifted.place(work.root, sound, fault.first, fault.last, rate)
    else:
        turned = quaternions.of_joint(work.local, j, sound)
        found, variance = unshifted.turns(turned, sound, fault.first, fault.last, orders[j], rate)
        work.local[span, j] = Rotation.from_quat(found).as_matrix()
    work.variance[span, j], work.way[span, j] = variance, TURNED_BACK


def _smooth(work: Mended, fault: Fault, unsound: np.ndarray, moving: np.ndarray, rate: float) -> None:
    j, span, sound = fault.marker, fault.frames, ~unsound[:, fault.marker]
    told = moving[(moving > 0) & (moving != j) & ~unsound[span][:, moving].any(0)]
    turned = quaternions.of_joint(work.local, j, np.ones(len(sound), bool))
    known = sound & ~unsound[:, told].any(1)
    known[span] = True
    if known.sum() - (fault.last - fault.first + 1) < calmed.FEWEST:
        return
    found, variance = calmed.turns(
        work.root, work.local, turned, told, known, fault.first, fault.last, fault.severity, rate
    )
    work.local[span, j] = Rotation.from_quat(found).as_matrix()
    work.variance[span, j], work.way[span, j] = variance, SMOOTHED


def _recall(work: Mended, gone: np.ndarray, moving: np.ndarray, rate: float, people: People | None) -> None:
    """Recall the joints that are `gone` (T, N) below the root, in place."""
    joints = gone[:, :-1].copy()
    joints[:, 0] = False
    if not joints.any():
        return
    free = np.zeros(joints.shape[1], bool)
    free[[0, *moving]] = True
    variance = np.full(joints.shape, EXACT)
    recall.lost_joints(work.root, work.local, variance, joints, free, rate, people, alike.EXACT)
    found = joints & (variance != EXACT)
    work.variance[:, :-1][found], work.way[:, :-1][found] = variance[found], RECALLED


def _bridge(work: Mended, parents: np.ndarray, gone: np.ndarray, whole: np.ndarray, rate: float) -> None:
    """Lead what is `gone` (T, N) and not yet found across, the whole figure or each joint for itself, in place."""
    left = gone & (work.way == AS_IT_IS)
    sound = np.logical_not(gone.any(axis=1))
    for first, last in runs(whole) if np.any(sound) else ():
        span, mask = slice(first, last + 1), left[first : last + 1]
        place, local, of_place, variance = bridged.figure(parents, work.root, work.local, sound, first, last, rate)
        work.root[span] = np.where(mask[:, -1:], place, work.root[span])
        work.local[span] = np.where(mask[:, :-1, None, None], local, work.local[span])
        work.variance[span] = np.where(mask, np.column_stack([variance, of_place]), work.variance[span])
        work.way[span][mask] = BRIDGED
    left &= ~whole[:, None]
    for n in np.flatnonzero(left.any(0) & ~gone.all(0)):
        for first, last in runs(left[:, n]):
            near, span = bridged.beside(~gone[:, n], first, last, rate), slice(first, last + 1)
            if not len(near):
                continue
            if n == work.local.shape[1]:
                work.root[span], work.variance[span, n] = bridged.course(work.root[near], near, first, last, rate)
            else:
                work.local[span, n], work.variance[span, n] = bridged.turn(work.local[near, n], near, first, last, rate)
            work.way[span, n] = BRIDGED
