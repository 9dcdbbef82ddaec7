"""What of a mended animation is put into it: what may be touched, is sure enough, and was not decided against."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mocapfix import changes, joint_points
from mocapfix.animation import Animation
from mocapfix.change_file import Decided
from mocapfix.changes import Change
from mocapfix.faults import Fault, Faults, over
from mocapfix.fill import FillOptions, lasting, touchable, why_not
from mocapfix.left import Left, named
from mocapfix.solve.turns import AS_IT_IS, WAYS, Mended
from mocapfix.take import Take

LOST = ("gap", "stuck")


@dataclass(frozen=True)
class Put:
    """A cleaned animation, and what there is to tell of it.

    animation      as it is now
    before, after  takes of the joints' tips, without what is not there; centres  the joints' places as they are now
    """

    animation: Animation
    before: Take
    after: Take
    centres: Take
    faults: Faults
    changes: tuple[Change, ...]
    left: tuple[Left, ...]


def put(
    tips: Take, mended: Mended, faults: Sequence[Fault], options: FillOptions, only: Sequence[str], decided: Sequence[Decided]
) -> Put:
    """-> an animation with what is to be put into it, all else as it was.

    tips  of the animation as it was read, its layout;  mended  everything, for all `faults`
    only  the kinds that are mended; none: all
    """
    lost = over([fault for fault in faults if fault.kind == "gap"], tips.seen.shape)
    before = tips.only(~lost)
    made = [f for f in faults if (not only or f.kind in only) and not any(each.refuses(f) for each in decided)]
    touch = over(made, lost.shape) & _touchable(before, options) & (mended.way != AS_IT_IS)
    refused = _refused(before, mended, faults, touch, options)
    touched = touch & (refused == "")
    now = with_mended(joint_points.moved(tips), mended, touched)
    unsure = np.where(touched, mended.variance, 0.0)
    after = _with_reach(joint_points.tips(now), unsure, touched | ~before.seen).only(touched | ~lost)
    centres = joint_points.places(now)
    centres = _with_reach(centres, unsure, np.ones(centres.seen.shape, bool))
    told = (*_told(before, after, made, mended, touched), *(each.as_change() for each in decided))
    left = named(after, np.where(refused == "", "its change was not to be made", refused))
    return Put(now, before, after, centres, Faults(tuple(faults)), told, left)


def with_mended(animation: Animation, mended: Mended, touched: np.ndarray) -> Animation:
    """-> the animation with the courses `touched` (T, J + 1) as they are mended, and all others as they were."""
    now = animation
    for j in np.flatnonzero(touched[:, :-1].any(0)):
        frames = np.flatnonzero(touched[:, j])
        now = now.with_values(now.with_rotations(np.array([j]), frames, mended.local[frames, j][:, None]))
    frames = np.flatnonzero(touched[:, -1])
    return now.with_values(now.with_places(np.array([0]), frames, mended.root[frames][:, None])) if len(frames) else now


def _touchable(before: Take, options: FillOptions) -> np.ndarray:
    """-> (T, J + 1) bool: what the options allow to change; of the root that is kept also its place."""
    touch = touchable(before, options)
    touch[:, -1] &= touch[:, 0]
    return touch


def _refused(before: Take, mended: Mended, faults: Sequence[Fault], touch: np.ndarray, options: FillOptions) -> np.ndarray:
    """-> (T, J + 1) object: why what is lost is not filled, "" elsewhere. A figure is not left half-way into a gap: where one
    sample of it is refused, all are."""
    lost = [fault for fault in faults if fault.kind in LOST]
    gone = over(lost, touch.shape)
    whole = joint_points.tips(with_mended(joint_points.moved(before), mended, mended.way != AS_IT_IS))
    unsure = np.where(mended.way == AS_IT_IS, np.nan, joint_points.reach(whole, mended.variance))
    reasons = why_not(before, gone & touch, lasting(~gone, before.rate), unsure, options)
    for fault in lost:
        if why := [reason for reason in reasons[fault.frames][:, list(fault.markers)].ravel() if reason]:
            reasons[fault.frames, list(fault.markers)] = why[0]
    return reasons


def _with_reach(points: Take, variance: np.ndarray, estimated: np.ndarray) -> Take:
    """-> the take with how unsure its points are, which are the tips of its joints or their places, where they are `estimated`
    (T, M) and courses have a variance (T, J + 1)."""
    unsure = joint_points.reach(points, variance)
    return replace(points, deviation=np.where(estimated & (unsure > 0), unsure, np.nan))


def _told(before: Take, after: Take, made: Sequence[Fault], mended: Mended, touched: np.ndarray) -> list[Change]:
    """-> an entry for every fault of which something was put in: of its own joints, not of what hangs on them."""
    mine = before.with_markers(np.where(touched[..., None], after.markers, before.markers), after.deviation)
    about = [fault for fault in made if touched[fault.frames][:, list(fault.markers)].any()]
    ways = np.where(touched, np.array(WAYS, object)[mended.way], "")
    return [change for change, _ in changes.made(before, before, mine, about, None, ways)]
