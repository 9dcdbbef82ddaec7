"""MNN-IK's test (4.2): the places of a few joints, chosen at random, are given; how near comes the whole pose?

As there, poses stand at the origin without heading, and are solved from the mean pose. All priors are given the same joints
of the same poses. The error of a pose is the mean over its 31 joints; the paper does not say of what its deviations are, here
they are those of the poses' errors about their mean.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench import contenders
from mocapfix.bench.contenders import Given, Shelf, given
from mocapfix.clock import Progress

GIVEN = (6, 8, 10, 15)
SD = 0.005  # metres: how sure a given place is said to be


def measure(rotations: np.ndarray, shelf: Shelf, middle: np.ndarray, sets: int, progress: Progress) -> dict:
    """-> number of joints given: prior: `row`, of poses (N, J, 3, 3), each solved `sets` times, from other joints each time."""
    said = {}
    for count in GIVEN:
        task = given(np.concatenate([rotations] * sets), drawn(sets * len(rotations), rotations.shape[1], count), SD)
        said[str(count)] = {}
        for name, model in shelf.items():
            progress(f"{count} joints given, {name}")
            said[str(count)][name] = row(*errors(task, contenders.solve(task, model, task.upright(middle))))
    return said


def drawn(poses: int, joints: int, count: int) -> np.ndarray:
    """-> (N, J) bool: `count` joints of each pose, always the same."""
    order = np.random.default_rng(count).random((poses, joints)).argsort(axis=1)
    return order < count


def errors(task: Given, found: contenders.Found) -> tuple[np.ndarray, np.ndarray]:
    """-> (N,) metres and (N,) radians: how far joints are from their places, and turns from the truth's, mean over joints."""
    true = contenders.placed(task.skeleton, np.zeros((len(task.rotations), 3)), task.rotations)
    far = np.linalg.norm(found.joints - true.joints, axis=2).mean(axis=1)
    turn = np.swapaxes(task.rotations, 2, 3) @ found.rotations
    return far, Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude().reshape(turn.shape[:2]).mean(axis=1)


def row(far: np.ndarray, turned: np.ndarray) -> dict[str, float]:
    """-> means and deviations over poses, of errors (N,) in metres and radians."""
    millimetres, degrees = 1e3 * far, np.degrees(turned)
    return {
        "position_mm": float(millimetres.mean()),
        "rotation_deg": float(degrees.mean()),
        "position_sd": float(millimetres.std()),
        "rotation_sd": float(degrees.std()),
    }


def better(said: dict, name: str) -> dict[str, dict[str, float]]:
    """-> other prior: by how many percent `name` is better than it."""
    others = [other for other in next(iter(said.values())) if other != name]
    keys = {"position_percent": "position_mm", "rotation_percent": "rotation_deg"}
    return {other: {percent: gain(said, name, other, key) for percent, key in keys.items()} for other in others}


def gain(said: dict, name: str, other: str, key: str) -> float:
    """-> percent, the mean over the numbers of joints given (as MNN-IK counts its 25 and 39 %, 4.2)."""
    return 100 * float(np.mean([1 - rows[name][key] / rows[other][key] for rows in said.values()]))
