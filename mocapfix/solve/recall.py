"""What a take itself says of a limb it lost: how its joints went at moments alike, and at the moments around.

A Gaussian process over the take (see `kernels.process`) is told the joints' rotations where they are known, densely beside
the gap and sparsely farther off, and asked for those in it. It is as sure as the moments it knows are near or like. Where that
is not very sure, it is asked for a model's answers too, as if they were not known in the gap: by how much the model answers
otherwise there, counts as the take's own expectation is unsure (kriging with an external drift). Asked so, a model gains on
gaps of seconds, and spoils no other; as one more pull on the poses, it made every gap's error greater.
"""

import numpy as np

from mocapfix.kernels import quaternions
from mocapfix.kernels.gaps import chosen, together
from mocapfix.kernels.process import Likeness, learnt
from mocapfix.solve import alike
from mocapfix.solve.people import People

MOST = 0.5  # share of the joints: with more of them lost, there is no body left to recall the rest from
FEWEST = 3  # frames, without which there is nothing to go by
LIVELY, BELIEVED = 0.02, 10  # rad^2: the power of an unknown joint's course, believed as much as so many frames
DOUBT = 1.5  # by how much what is expected errs more, in rad^2, than the process says of itself
SURE = 0.1  # radians: what the take knows so well of all that a gap lost, no model knows better
STRAYS = 0.3  # radians per axis: how far people's limbs are from what is new in a model's answer


def lost_joints(
    root: np.ndarray,
    local: np.ndarray,
    variance: np.ndarray,
    gone: np.ndarray,
    free: np.ndarray,
    rate: float,
    people: People | None = None,
    likeness: Likeness = alike.LIKENESS,
) -> None:
    """Write what the take tells of lost joints into `local` (T, J, 3, 3) and `variance` (T, J), rad^2.

    root (T, 3) metres, local and variance: each frame's own solve; gone (T, J) as `listening.lost` says; likeness: how far
    moments tell of each other.
    """
    joints = np.flatnonzero(free)[1:]
    body = gone[:, joints].mean(axis=1) <= MOST
    solved = local.copy() if gone.any() else local
    for (first, last), lost in together(gone & body[:, None]).items():
        told = joints[~gone[first : last + 1, joints].any(axis=0)]
        learn = chosen(body & ~gone[:, np.r_[told, lost]].any(axis=1), first, last, rate)
        if len(learn) < FEWEST:
            continue
        gap, doubt = np.arange(first, last + 1), variance[learn][:, lost].max(axis=1)
        known, asked = (alike.circumstances(root, solved, told, frames, rate) for frames in (learn, gap))
        given = known, learn / rate, np.maximum(doubt - np.median(doubt), 0.0), likeness
        turns = np.concatenate([2 * quaternions.of_joint(solved, j, ~gone[:, j])[learn] for j in lost], axis=1)
        course = learnt(turns, *given)
        expected, left = course.expected(asked, gap / rate)
        power = np.fmax(course.missed((last - first + 1) / rate), course.power).reshape(-1, 4).sum(axis=1) / 3
        lively = (len(learn) * power + BELIEVED * LIVELY) / (len(learn) + BELIEVED)
        leaves_open = DOUBT * left[:, None] * lively
        if people and leaves_open.max() > SURE**2:
            said = people.turns(solved, told, lost, np.r_[learn, gap], np.concatenate([turns, expected]))
            new = said[len(learn) :] - learnt(said[: len(learn)], *given).expected(asked, gap / rate)[0]
            expected += np.repeat(leaves_open / (leaves_open + (people.scale * STRAYS) ** 2), 4, axis=1) * new
        for i, j in enumerate(lost):
            quaternions.into_joint(np.ascontiguousarray(expected[:, 4 * i : 4 * i + 4]), j, local[first : last + 1])
            variance[gap, j] = leaves_open[:, i]
