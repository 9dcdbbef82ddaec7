"""How many frames a second a prior poses on all cores, of frames that need it: GIVEN joints of 31, each frame for itself."""

import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench import contenders
from mocapfix.bench.contenders import Contender, given
from mocapfix.bench.given_joints import SD, drawn
from mocapfix.clock import Progress

GIVEN = 10  # joints
ROUNDS = 3  # of which the fastest counts, for other programs slow it
AWAY, ASIDE = 0.15, 0.03  # radians and metres per axis: how far from a pose its course through time starts it


def measure(rotations: np.ndarray, model: Contender, middle: np.ndarray, progress: Progress) -> dict[str, float]:
    """-> `fps` of poses (N, J, 3, 3) from a start as a course through time gives it, and `fps_from_mean_pose`."""
    progress("frames a second")
    task, rng = given(rotations, drawn(len(rotations), rotations.shape[1], GIVEN), SD), np.random.default_rng(0)
    turned = Rotation.from_rotvec(rng.normal(0, AWAY, (rotations[..., 0, 0].size, 3))).as_matrix().reshape(rotations.shape)
    starts = {
        "fps": (rng.normal(0, ASIDE, (len(rotations), 3)), turned @ rotations),
        "fps_from_mean_pose": task.upright(middle),
    }
    spent = {name: min(seconds(lambda s=start: contenders.solve(task, model, s), ROUNDS)) for name, start in starts.items()}
    return {name: len(rotations) / least for name, least in spent.items()}


def seconds(once: Callable[[], object], rounds: int) -> list[float]:
    """-> what it took each time; it is called once before, for what is only done the first time."""
    once()
    spent = []
    for _ in range(rounds):
        started = time.perf_counter()
        once()
        spent.append(time.perf_counter() - started)
    return spent
