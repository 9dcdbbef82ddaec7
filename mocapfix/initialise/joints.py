"""Joint positions from markers, every frame by itself, and how sure they are."""

import numpy as np

from mocapfix import prior
from mocapfix.kernels import kinematics
from mocapfix.kernels.segments import Meetings, Segments, lay_frames
from mocapfix.kernels.threads import over_frames
from mocapfix.prior import Prior
from mocapfix.skeleton import Body
from mocapfix.subject import Subject
from mocapfix.take import Take

CALIBRATION = 0.75  # of the deviation that calibration foretells of its own error: it allows for more than people differ
EXACT = 1e-7  # metres: no marker keeps its place better
NOWHERE = 0.5  # metres: a joint known no better than this is not known


def positions(worn: Take, subject: Subject, body: Body) -> tuple[np.ndarray, np.ndarray]:
    """-> joint positions (T, J, 3) and their standard deviations per axis (T, J), in metres; NaN where next to nothing tells.

    Each segment is registered to its own markers, each as near to its place as the subject's `spread` says, and to what its
    neighbours know: of the joint in common, and of its axes as far as people keep to the mean pose there. So a limb without
    markers hangs as people's do, and its joints say how unsure that is. Joints at the same place get the same position.

    worn  the take's markers in the subject's order, NaN where not seen or not believed
    """
    rigid = Rigid(subject, body, prior.load("mean-pose", subject.skeleton))
    position, variance = np.empty((worn.frames, len(body.free), 3)), np.empty((worn.frames, len(body.free)))
    markers = np.ascontiguousarray(worn.markers, float)
    over_frames(lay_frames, worn.frames, rigid.segments(), rigid.meetings(), markers, position, variance)
    unknown = ~(variance < NOWHERE**2)
    deviation = np.sqrt(variance + (CALIBRATION * subject.joint_sd) ** 2)
    position[unknown], deviation[unknown] = np.nan, np.nan
    return position, deviation


class Rigid:
    """A body as rigid segments: each free joint with the joints below it that are not free, which stay in the mean pose.

    carrier  (J,) the segment that carries each joint
    place    (J, 3) metres: the joint in that segment's axes
    axes     (J, 3, 3): the joint's axes in the segment's
    own      (S,) the joint that each segment is named for
    """

    def __init__(self, subject: Subject, body: Body, people: Prior):
        self.subject, self.people = subject, people
        skeleton, count = subject.skeleton, len(body.free)
        self.own = np.flatnonzero(body.free)
        self.carrier = np.cumsum(body.free) - 1
        self.place, self.axes = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
        for j in np.flatnonzero(~body.free):
            above = skeleton.parents[j]
            self.carrier[j] = self.carrier[above]
            self.place[j] = self.place[above] + self.axes[above] @ skeleton.offsets[j]
            self.axes[j] = self.axes[above] @ people.rotations[j]

    def segments(self) -> Segments:
        """-> the segments, how they hang together and what they wear."""
        subject, above = self.subject, self.subject.skeleton.parents[self.own]
        axes = self.axes[above]
        habit = axes @ self.people.information[self.own] @ np.swapaxes(axes, 1, 2)
        on = self.carrier[subject.joints]
        order = np.argsort(on, kind="stable")
        at, stance = kinematics.carried(kinematics.tree_of(subject.skeleton), np.zeros((1, 3)), self.people.rotations[None])
        standing = at[0, subject.joints] + np.einsum("kab,kb->ka", stance[0, subject.joints], subject.places)
        riding = subject.joints[order]
        place = self.place[riding] + np.einsum("kab,kb->ka", self.axes[riding], subject.places[order])
        return Segments(
            np.where(above < 0, -1, self.carrier[above]), self.origins(), axes @ self.people.rotations[self.own], habit,
            np.searchsorted(on[order], np.arange(len(self.own) + 1)), order, place,
            1 / np.maximum(subject.spread[order], EXACT) ** 2, stance[0, self.own], standing[order],
        )  # fmt: skip

    def origins(self) -> np.ndarray:
        """-> (S, 3) metres: each segment's own joint in its parent's axes."""
        skeleton = self.subject.skeleton
        above = skeleton.parents[self.own]
        origins = self.place[above] + np.einsum("sab,sb->sa", self.axes[above], skeleton.offsets[self.own])
        return np.where(above[:, None] < 0, 0.0, origins)

    def meetings(self) -> Meetings:
        """-> the segments that carry each joint: its own, the one above, and those whose joints lie at the same place."""
        parents = self.subject.skeleton.parents
        spots = [(int(c), tuple(np.round(p, 9))) for c, p in zip(self.carrier, self.place, strict=True)]
        for s, (j, origin) in enumerate(zip(self.own, self.origins(), strict=True)):
            if s:
                spots[j] = (int(self.carrier[parents[j]]), tuple(np.round(origin, 9)))
        below = [(s, (0.0, 0.0, 0.0), spots[j]) for s, j in enumerate(self.own) if s]
        meeting = [[spot] + [(s, place) for s, place, there in below if there == spot] for spot in spots]
        first = np.cumsum([0] + [len(each) for each in meeting])
        segment, place = zip(*(one for each in meeting for one in each), strict=True)
        return Meetings(first, np.array(segment), np.array(place))
