"""What each way of filling a lost limb's gap is worth alone: what the solve weighs against one another."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from mocapfix.motion import Motion
from mocapfix.prior.contract import PoseModel
from mocapfix.skeleton import cmu31
from mocapfix.solve.people import People

MOMENT = 0.067  # seconds over which the speed at an edge is measured


def alone(
    found: Motion, lost: np.ndarray, first: int, last: int, rate: float, model: PoseModel | None
) -> Iterator[tuple[str, Motion]]:
    """Yield ways and the motion each makes of a solved one, in which the joints `lost` lack in the frames first to last."""
    gap, ends = np.arange(first, last + 1), np.array([first - 1, last + 1])
    turns = {j: found.rotations[:, j] for j in lost}
    yield "slerp", put(found, gap, {j: Slerp(ends, of(turns[j][ends]))(gap) for j in lost})
    yield "cubic", put(found, gap, {j: cubic(turns[j], ends, gap, rate) for j in lost})
    if model is not None:
        said = answers(found, lost, np.arange(first - 1, last + 2), model)
        yield "model, each frame alone", put(found, gap, {j: of(said[j][1:-1]) for j in lost})
        yield "model, corrected at both edges", put(found, gap, {j: corrected(said[j], turns[j][ends]) for j in lost})


def of(matrices: np.ndarray) -> Rotation:
    return Rotation.from_matrix(matrices)


def put(found: Motion, gap: np.ndarray, turns: dict[int, Rotation]) -> Motion:
    """-> the motion with these joints' rotations in the frames of the gap."""
    rotations = found.rotations.copy()
    for j, turn in turns.items():
        rotations[gap, j] = turn.as_matrix()
    return replace(found, rotations=rotations)


def cubic(turns: np.ndarray, ends: np.ndarray, gap: np.ndarray, rate: float) -> Rotation:
    """-> the cubic Hermite curve of a joint's (T, 3, 3) rotation vectors from the one end, with the speed it has at either."""
    span, (a, b) = max(1, round(MOMENT * rate)), ends
    before, after = max(a - span, 0), min(b + span, len(turns) - 1)
    from_end = of(turns[[before, a, b, after]]) * of(turns[a]).inv()
    away = from_end.as_rotvec()
    leaving, coming = -away[0] / max(a - before, 1), (away[3] - away[2]) / max(after - b, 1)
    return Rotation.from_rotvec(CubicHermiteSpline(ends, away[1:3], [leaving, coming])(gap)) * of(turns[a])


def answers(found: Motion, lost: np.ndarray, frames: np.ndarray, model: PoseModel) -> dict[int, np.ndarray]:
    """-> joint: (N, 3, 3) what the model makes of it in each of the frames, given the joints that are not lost."""
    body = cmu31()
    told = np.array([j for j in np.flatnonzero(body.free)[1:] if j not in lost])
    either = np.ones((len(frames), 4 * len(lost)))
    turns = People(lambda: model, 1.0).turns(found.rotations, told, lost, frames, either)
    return {j: Rotation.from_quat(turns[:, 4 * i : 4 * i + 4]).as_matrix() for i, j in enumerate(lost)}


def corrected(said: np.ndarray, edges: np.ndarray) -> Rotation:
    """-> what was said (N, 3, 3) of a gap between its edges, its first and last, with the error there blended across."""
    share = np.linspace(0, 1, len(said))[1:-1, None]
    missed = (of(edges) * of(said[[0, -1]]).inv()).as_rotvec()
    return Rotation.from_rotvec((1 - share) * missed[0] + share * missed[1]) * of(said[1:-1])
