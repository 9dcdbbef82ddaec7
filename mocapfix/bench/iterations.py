"""How the errors fall as the solve goes on: MNN-IK's Figure 5, and how near each prior comes after how many iterations."""

import numpy as np

from mocapfix.bench import contenders
from mocapfix.bench.contenders import Found, Given, Shelf, given
from mocapfix.bench.given_joints import SD, drawn, errors
from mocapfix.clock import Progress

GIVEN = 10  # joints
MOST = 25  # iterations shown


def measure(rotations: np.ndarray, shelf: Shelf, middle: np.ndarray, name: str, progress: Progress) -> dict:
    """-> the means over poses (N, J, 3, 3) as the solve goes on: it is stopped after 0, 1, ... iterations.

    A network is asked between rounds of several, and a later round is not stopped; hence `iterations`.

    iterations   prior: how many had been spent
    position_mm  prior: error of the joints
    cost         of the solve under the prior `name`: the `total`, and what of it the `given` joints and the `prior` have
    """
    task = given(rotations, drawn(len(rotations), rotations.shape[1], GIVEN), SD)
    said = {"iterations": {}, "position_mm": {}}
    for each, model in shelf.items():
        progress(f"iterations, {each}")
        way = [contenders.solve(task, model, task.upright(middle), most) for most in range(MOST + 1)]
        said["iterations"][each] = [float(found.iterations.mean()) for found in way]
        said["position_mm"][each] = [1e3 * float(errors(task, found)[0].mean()) for found in way]
        if each == name:
            said["cost"] = costs(task, way)
    return said


def costs(task: Given, way: list[Found]) -> dict[str, list[float]]:
    """-> half the sum of squares in standard deviations, of a pose after each iteration."""
    totals = np.array([found.cost.mean() for found in way])
    given = np.array([fits(task, found).mean() for found in way])
    return {"total": totals.tolist(), "given": given.tolist(), "prior": (totals - given).tolist()}


def fits(task: Given, found: Found) -> np.ndarray:
    """-> (N,) how far the given joints are from their places."""
    away = np.where(task.joints[..., None], found.joints - task.places, 0.0) / task.sd
    return 0.5 * (away**2).sum(axis=(1, 2))
