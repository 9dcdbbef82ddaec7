"""Faults put into sound motion as solvers, suits and films leave them in the joints' rotations.

Each stands at one place of a motion. What is lost is told as files tell it: by the last values held, by zeros, or by no numbers.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton

APART, BESIDE = 2.0, 0.8  # seconds between two faults; before the first and after the last
LENGTHS = {"1 frame": (0.0, 0.0), "short": (0.2, 0.5), "long": (0.5, 1.0)}  # seconds
TREMBLE = np.radians(3.0)
LIMBS = (("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot"), ("ForeArm", "Hand"), ("Leg", "Foot"))
TURNING = ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand", "Neck", "Head", "LowerBack", "Spine", "Shoulder")


class Put(NamedTuple):
    """A fault of a kind that was put into some joints (all of them: the figure and its place) over first..last, inclusive."""

    kind: str
    joints: tuple[int, ...]
    first: int
    last: int


def damaged(
    motion: Motion, skeleton: Skeleton, rate: float, kind: str, length: str, rng: np.random.Generator
) -> tuple[Motion, list[Put]]:
    """-> the motion with faults of a kind of KINDS in it, as long as LENGTHS says, as many as find room, and what they are.

    Numbers that are not there are NaN.
    """
    root, local, put = motion.root.copy(), motion.rotations.copy(), []
    least, most = LENGTHS[length]
    at = round(BESIDE * rate)
    while True:
        frames = max(1, round(rng.uniform(least, most) * rate))
        first = at + int(rng.integers(round(BESIDE * rate)))
        if first + frames + round(BESIDE * rate) > motion.frames:
            break
        last = first + frames - 1
        joints = KINDS[kind](root, local, skeleton, slice(first, last + 1), rng)
        put.append(Put(kind, joints, first, last))
        at = last + 1 + round(APART * rate)
    return replace(motion, root=root, rotations=local), put


def _flip(root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator) -> tuple[int, ...]:
    """One joint upside down about one of its own axes."""
    joint = _one(skeleton, rng)
    local[span, joint] = local[span, joint] @ _about(rng.permuted([np.pi, 0.0, 0.0]))
    return (joint,)


def _pop(root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator) -> tuple[int, ...]:
    """One joint off by 10 to 60 degrees: in its own axes, in its parent's, or in one of its angles."""
    joint, angle, way = _one(skeleton, rng), np.radians(rng.uniform(10, 60)), rng.integers(3)
    if way == 2:
        turns = Rotation.from_matrix(local[span, joint]).as_euler("ZYX")
        turns[:, rng.integers(3)] += angle * rng.choice([-1, 1])
        local[span, joint] = Rotation.from_euler("ZYX", turns).as_matrix()
        return (joint,)
    axis = rng.normal(size=3)
    turn = _about(angle * axis / np.linalg.norm(axis))
    local[span, joint] = turn @ local[span, joint] if way else local[span, joint] @ turn
    return (joint,)


def _jitter(root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator) -> tuple[int, ...]:
    """A joint or a limb trembles, each joint by itself."""
    joints = (_one(skeleton, rng),) if rng.integers(2) else _limb(skeleton, rng)
    for j in joints:
        local[span, j] = local[span, j] @ _about(rng.normal(0, TREMBLE, (span.stop - span.start, 3)))
    return joints


def _limb_lost(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    joints = _limb(skeleton, rng)
    local[span, joints] = [local[span.start - 1, joints], np.eye(3), np.nan][rng.integers(3)]
    return joints


def _figure_lost(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    way = rng.integers(3)
    local[span] = [local[span.start - 1], np.eye(3), np.nan][way]
    root[span] = [root[span.start - 1], np.zeros(3), np.nan][way]
    return tuple(range(local.shape[1]))


def _root_off(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    away = rng.normal(size=3)
    root[span] += rng.uniform(0.1, 0.5) * away / np.linalg.norm(away)
    return (0,)


KINDS: dict[str, Callable[..., tuple[int, ...]]] = {
    "flip": _flip,
    "pop": _pop,
    "jitter": _jitter,
    "limb lost": _limb_lost,
    "figure lost": _figure_lost,
    "root off": _root_off,
}


def _one(skeleton: Skeleton, rng: np.random.Generator) -> int:
    return int(rng.choice([j for j, name in enumerate(skeleton.names) if name.endswith(TURNING)]))


def _limb(skeleton: Skeleton, rng: np.random.Generator) -> tuple[int, ...]:
    side = ("Left", "Right")[rng.integers(2)]
    return tuple(skeleton.index(side + name) for name in LIMBS[rng.integers(len(LIMBS))])


def _about(vectors: np.ndarray | list[float]) -> np.ndarray:
    return Rotation.from_rotvec(vectors).as_matrix()
