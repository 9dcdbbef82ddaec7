"""Joint positions from markers, every frame by itself, and how sure they are."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mocapfix import prior
from mocapfix.initialise.bones import BONE
from mocapfix.initialise.given import LEAST
from mocapfix.kernels import kinematics
from mocapfix.kernels.segments import Meetings, Segments, lay_frames
from mocapfix.kernels.threads import over_frames
from mocapfix.prior import Prior
from mocapfix.skeleton import Body, Skeleton
from mocapfix.subject import Subject
from mocapfix.take import Take

CALIBRATION = 0.75  # of the deviation that calibration foretells of its own error: it allows for more than people differ
EXACT = 1e-7  # metres: no marker keeps its place better
NOWHERE = 0.5  # metres: a joint known no better than this is not known


class Placed(NamedTuple):
    """Where the joints are, as markers tell it.

    positions  (T, J, 3) metres, NaN where next to nothing tells
    deviation  (T, J) metres per axis, likewise
    trust      (T, K) between 0 and 1: how much each marker counted; less than a quarter where it lies 5 cm off, 0 if not seen
    """

    positions: np.ndarray
    deviation: np.ndarray
    trust: np.ndarray


def positions(worn: Take, subject: Subject, body: Body) -> Placed:
    """-> every frame's joint positions, and how sure they are.

    Each segment is registered to its own markers, each as near to its place as the subject's `spread` says, and to what its
    neighbours know: of the joint in common, and of its axes as far as people keep to the mean pose there. So a limb without
    markers hangs as people's do, and its joints say how unsure that is. Joints at the same place get the same position.

    worn  the take's markers in the subject's order, NaN where not seen or not believed
    """
    people = prior.load("mean-pose", subject.skeleton)
    rigid = rigid_parts(subject.skeleton, body.free, people)
    order = np.argsort(rigid.carrier[subject.joints], kind="stable")
    position, variance = np.empty((worn.frames, len(body.free), 3)), np.empty((worn.frames, len(body.free)))
    trust = np.empty(worn.seen.shape)
    over_frames(
        lay_frames, worn.frames, segments(subject, rigid, people, order), meetings(rigid),
        np.ascontiguousarray(worn.markers[:, order], float), position, variance, trust,
    )  # fmt: skip
    unknown = ~(variance < NOWHERE**2)
    deviation = np.maximum(np.sqrt(variance + (CALIBRATION * subject.joint_sd) ** 2), LEAST)
    position[unknown], deviation[unknown] = np.nan, np.nan
    return Placed(position, deviation, trust[:, order.argsort()])


@dataclass(frozen=True)
class Rigid:
    """A skeleton as S rigid segments: each free joint with those below it that are not free, which stay in the mean pose.

    own      (S,) the free joint of each segment
    above    (J,) the segment that each joint hangs on; the root's own for the root
    hung     (J, 3) metres: the joint in that segment's axes
    beside   (J, 3, 3): the axes of the joint's parent in that segment's
    carrier  (J,) the segment that a joint turns with: its own where it is free, else the one it hangs on
    place    (J, 3) metres: the joint in that one's axes
    axes     (J, 3, 3): its axes in that one's
    """

    own: np.ndarray
    above: np.ndarray
    hung: np.ndarray
    beside: np.ndarray
    carrier: np.ndarray
    place: np.ndarray
    axes: np.ndarray


def rigid_parts(skeleton: Skeleton, free: np.ndarray, people: Prior) -> Rigid:
    """-> the skeleton as rigid segments, the joints that are `free` (J,) turning."""
    count, own = len(free), np.flatnonzero(free)
    above, hung, beside = np.zeros(count, int), np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    carrier, place, axes = np.zeros(count, int), hung.copy(), beside.copy()
    carrier[own] = np.arange(len(own))
    for j in range(1, count):
        parent = skeleton.parents[j]
        above[j], beside[j] = carrier[parent], axes[parent]
        hung[j] = place[parent] + axes[parent] @ skeleton.offsets[j]
        if not free[j]:
            carrier[j], place[j], axes[j] = above[j], hung[j], beside[j] @ people.rotations[j]
    return Rigid(own, above, hung, beside, carrier, place, axes)


def segments(subject: Subject, rigid: Rigid, people: Prior, order: np.ndarray) -> Segments:
    """-> the segments as the kernel sees them.

    order  (K,) the subject's markers, segment by segment
    """
    own, riding, places = rigid.own, subject.joints[order], subject.places[order]
    beside = rigid.beside[own]
    at, stance = kinematics.carried(kinematics.tree_of(subject.skeleton), np.zeros((1, 3)), people.rotations[None])
    return Segments(
        parent=rigid.above[own],
        origin=rigid.hung[own],
        mean=beside @ people.rotations[own],
        habit=beside @ people.information[own] @ np.swapaxes(beside, 1, 2),
        first=np.searchsorted(rigid.carrier[riding], np.arange(len(own) + 1)),
        place=rigid.place[riding] + np.einsum("kab,kb->ka", rigid.axes[riding], places),
        weight=1 / np.maximum(subject.spread[order], EXACT) ** 2,
        stance=stance[0, own],
        standing=at[0, riding] + np.einsum("kab,kb->ka", stance[0, riding], places),
    )


def meetings(rigid: Rigid) -> Meetings:
    """-> the segments that carry each joint: the one it hangs on and, in their own joints, those that hang at the same place."""
    together = np.linalg.norm(rigid.hung[:, None] - rigid.hung, axis=2) < BONE
    together &= rigid.above[:, None] == rigid.above
    at = [[s for s, j in enumerate(rigid.own) if s and together[i, j]] for i in range(len(together))]
    segment = [s for above, here in zip(rigid.above, at, strict=True) for s in (above, *here)]
    place = [p for hung, here in zip(rigid.hung, at, strict=True) for p in (hung, *np.zeros((len(here), 3)))]
    return Meetings(np.cumsum([0] + [1 + len(here) for here in at]), np.array(segment), np.array(place))
