"""What a take itself says of a limb it lost: how its joints went at moments alike, and at the moments around.

A Gaussian process over the take (see `alike`) is told the joints' rotations where they are known, densely beside the gap and
sparsely farther off, and asked for those in it. It is as sure as the moments it knows are near or like. Where that is not very
sure, it is asked for a model's answers too, as if they were not known in the gap: by how much the model answers otherwise there,
counts as the take's own expectation is unsure (kriging with an external drift). Asked so, a model gains on gaps of seconds, and
spoils no other; as one more pull on the poses, it made every gap's error greater.
"""

import numpy as np

from mocapfix.kernels import quaternions
from mocapfix.solve import alike
from mocapfix.solve.people import People
from mocapfix.take import runs

MOST = 0.5  # share of the joints: with more of them lost, there is no body left to recall the rest from
BESIDE, STEP = 0.6, 1 / 30  # seconds beside a gap that are learnt from densely, and what lies between two frames learnt from
LEARNT = 200  # frames at most that are learnt from
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
) -> None:
    """Write what the take tells of lost joints into `local` (T, J, 3, 3) and `variance` (T, J), rad^2.

    root (T, 3) metres, local and variance: each frame's own solve; gone (T, J) as `listening.lost` says.
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
        given = known, learn / rate, np.maximum(doubt - np.median(doubt), 0.0), asked, gap / rate
        turns = np.concatenate([2 * quaternions.of_joint(solved, j, ~gone[:, j])[learn] for j in lost], axis=1)
        expected, left, power = alike.expected(turns, *given)
        lively = (len(learn) * power.reshape(-1, 4).sum(axis=1) / 3 + BELIEVED * LIVELY) / (len(learn) + BELIEVED)
        leaves_open = DOUBT * left[:, None] * lively
        if people and leaves_open.max() > SURE**2:
            said = people.turns(solved, told, lost, np.r_[learn, gap], np.concatenate([turns, expected]))
            new = said[len(learn) :] - alike.expected(said[: len(learn)], *given)[0]
            expected += np.repeat(leaves_open / (leaves_open + (people.scale * STRAYS) ** 2), 4, axis=1) * new
        for i, j in enumerate(lost):
            quaternions.into_joint(np.ascontiguousarray(expected[:, 4 * i : 4 * i + 4]), j, local[first : last + 1])
            variance[gap, j] = leaves_open[:, i]


def together(gone: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
    """-> (first, last): the joints that are gone (T, J) from then till then, neither longer nor shorter."""
    found: dict[tuple[int, int], list[int]] = {}
    for j in np.flatnonzero(gone.any(axis=0)):
        for gap in runs(gone[:, j]):
            found.setdefault(gap, []).append(int(j))
    return {gap: np.array(lost) for gap, lost in found.items()}


def chosen(known: np.ndarray, first: int, last: int, rate: float) -> np.ndarray:
    """-> indices of the frames that a gap is learnt from, rising: of those `known` (T,), all beside it but for such as follow
    too soon on one another, and others as many as may be, evenly spread.
    """
    frames = np.flatnonzero(known)
    beyond = np.where(frames < first, first - 1 - frames, frames - last - 1)  # frames from the edge
    step = max(1, round(STEP * rate))
    beside = beyond < BESIDE * rate
    near, far = frames[beside & (beyond % step == 0)], frames[~beside]
    count = min(LEARNT - len(near), len(far))
    spread = far[np.unique(np.linspace(0, len(far) - 1, count).astype(int))] if count > 0 else far[:0]
    return np.sort(np.r_[near, spread])
