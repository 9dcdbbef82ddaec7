"""What each way of filling a lost limb's gap is worth alone: what the solve weighs against one another."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from mocapfix.kernels.pose import Tree
from mocapfix.motion import Motion
from mocapfix.prior.contract import PoseModel
from mocapfix.skeleton import cmu31
from mocapfix.solve.people import People

MOMENT = 0.067  # seconds over which the speed at an edge is measured


def alone(
    found: Motion, lost: np.ndarray, first: int, last: int, rate: float, model: PoseModel | None
) -> Iterator[tuple[str, Motion]]:
    """Yield ways and the motion each makes of a solved one, in which the joints `lost` lack in the frames first to last."""
    gap = np.arange(first, last + 1)
    ends = np.array([first - 1, last + 1])
    known = {j: Rotation.from_matrix(found.rotations[:, j]) for j in lost}
    yield "slerp", put(found, gap, {j: Slerp(ends, turns[ends])(gap) for j, turns in known.items()})
    yield "cubic", put(found, gap, {j: cubic(turns, ends, gap, rate) for j, turns in known.items()})
    if model is not None:
        asked = np.r_[ends[0], gap, ends[1]]
        said = answers(found, lost, asked, model)
        yield "model, each frame alone", put(found, gap, {j: turns[1:-1] for j, turns in said.items()})
        yield "model, corrected at both edges", put(found, gap, {j: corrected(said[j], known[j][ends]) for j in lost})


def put(found: Motion, gap: np.ndarray, turns: dict[int, Rotation]) -> Motion:
    """-> the motion with these joints' rotations in the frames of the gap."""
    rotations = found.rotations.copy()
    for j, turn in turns.items():
        rotations[gap, j] = turn.as_matrix()
    return replace(found, rotations=rotations)


def cubic(turns: Rotation, ends: np.ndarray, gap: np.ndarray, rate: float) -> Rotation:
    """-> the cubic Hermite curve of rotation vectors from the one end, with the speed that the joint has at either."""
    span, latest = max(1, round(MOMENT * rate)), len(turns) - 1
    away = np.stack([np.zeros(3), (turns[ends[1]] * turns[ends[0]].inv()).as_rotvec()])
    before, after = max(ends[0] - span, 0), min(ends[1] + span, latest)
    leaving = (turns[ends[0]] * turns[before].inv()).as_rotvec() / max(ends[0] - before, 1)
    coming = (turns[after] * turns[ends[1]].inv()).as_rotvec() / max(after - ends[1], 1)
    return Rotation.from_rotvec(CubicHermiteSpline(ends, away, [leaving, coming])(gap)) * turns[ends[0]]


def answers(found: Motion, lost: np.ndarray, frames: np.ndarray, model: PoseModel) -> dict[int, Rotation]:
    """-> joint: what the model makes of it in each of the frames, given the joints that are not lost."""
    body = cmu31()
    told = np.array([j for j in np.flatnonzero(body.free)[1:] if j not in lost])
    tree = Tree(body.skeleton.parents, body.skeleton.offsets, body.free)
    either = np.ones((len(frames), 4 * len(lost)))
    turns = People(tree, lambda: model, 1.0).turns(found.root, found.rotations, told, lost, frames, either)
    return {j: Rotation.from_quat(turns[:, 4 * i : 4 * i + 4]) for i, j in enumerate(lost)}


def corrected(said: Rotation, edges: Rotation) -> Rotation:
    """-> what was said of a gap between its two edges, first and last of `said`, with the error there blended across."""
    share = np.linspace(0, 1, len(said))[1:-1, None]
    missed = edges * said[[0, -1]].inv()
    return Rotation.from_rotvec((1 - share) * missed[0].as_rotvec() + share * missed[1].as_rotvec()) * said[1:-1]
