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

FAULT_SPACING_S, EDGE_MARGIN_S = 2.0, 0.8  # seconds between two faults; before the first and after the last
FAULT_DURATION_RANGES_S = {"1 frame": (0.0, 0.0), "short": (0.2, 0.5), "long": (0.5, 1.0)}  # seconds
INJECTED_JITTER_SD_RAD = np.radians(3.0)
LIMB_JOINT_NAMES = (("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot"), ("ForeArm", "Hand"), ("Leg", "Foot"))
INJECTABLE_JOINT_NAMES = ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand", "Neck", "Head", "LowerBack", "Spine", "Shoulder")


class InjectedAnimationFault(NamedTuple):
    """A fault of a kind that was put into some joints (all of them: the figure and its place) over first..last, inclusive."""

    kind: str
    joints: tuple[int, ...]
    first: int
    last: int


def inject_animation_faults(
    motion: Motion, skeleton: Skeleton, rate: float, kind: str, duration_name: str, rng: np.random.Generator
) -> tuple[Motion, list[InjectedAnimationFault]]:
    """-> the motion with faults of a kind of KINDS in it, as long as LENGTHS says, as many as find room, and what they are.

    Numbers that are not there are NaN.
    """
    root, local, put = motion.root_position.copy(), motion.local_rotations.copy(), []
    least, most = FAULT_DURATION_RANGES_S[duration_name]
    at = round(EDGE_MARGIN_S * rate)
    while True:
        frames = max(1, round(rng.uniform(least, most) * rate))
        first = at + int(rng.integers(round(EDGE_MARGIN_S * rate)))
        if first + frames + round(EDGE_MARGIN_S * rate) > motion.frame_count:
            break
        last = first + frames - 1
        joints = ANIMATION_FAULT_INJECTORS[kind](root, local, skeleton, slice(first, last + 1), rng)
        put.append(InjectedAnimationFault(kind, joints, first, last))
        at = last + 1 + round(FAULT_SPACING_S * rate)
    return replace(motion, root_position=root, local_rotations=local), put


def _inject_flip(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    """One joint upside down about one of its own axes."""
    joint = _draw_joint(skeleton, rng)
    local[span, joint] = local[span, joint] @ _convert_rotation_vectors(rng.permuted([np.pi, 0.0, 0.0]))
    return (joint,)


def _inject_pop(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    """One joint off by 10 to 60 degrees: in its own axes, in its parent's, or in one of its angles."""
    joint, angle, way = _draw_joint(skeleton, rng), np.radians(rng.uniform(10, 60)), rng.integers(3)
    if way == 2:
        turns = Rotation.from_matrix(local[span, joint]).as_euler("ZYX")
        turns[:, rng.integers(3)] += angle * rng.choice([-1, 1])
        local[span, joint] = Rotation.from_euler("ZYX", turns).as_matrix()
        return (joint,)
    axis = rng.normal(size=3)
    turn = _convert_rotation_vectors(angle * axis / np.linalg.norm(axis))
    local[span, joint] = turn @ local[span, joint] if way else local[span, joint] @ turn
    return (joint,)


def _inject_jitter(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    """A joint or a limb trembles, each joint by itself."""
    joints = (_draw_joint(skeleton, rng),) if rng.integers(2) else _draw_limb(skeleton, rng)
    for j in joints:
        local[span, j] = local[span, j] @ _convert_rotation_vectors(
            rng.normal(0, INJECTED_JITTER_SD_RAD, (span.stop - span.start, 3))
        )
    return joints


def _inject_limb_gap(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    joints = _draw_limb(skeleton, rng)
    local[span, joints] = [local[span.start - 1, joints], np.eye(3), np.nan][rng.integers(3)]
    return joints


def _inject_figure_gap(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    way = rng.integers(3)
    local[span] = [local[span.start - 1], np.eye(3), np.nan][way]
    root[span] = [root[span.start - 1], np.zeros(3), np.nan][way]
    return tuple(range(local.shape[1]))


def _inject_root_offset(
    root: np.ndarray, local: np.ndarray, skeleton: Skeleton, span: slice, rng: np.random.Generator
) -> tuple[int, ...]:
    away = rng.normal(size=3)
    root[span] += rng.uniform(0.1, 0.5) * away / np.linalg.norm(away)
    return (0,)


ANIMATION_FAULT_INJECTORS: dict[str, Callable[..., tuple[int, ...]]] = {
    "flip": _inject_flip,
    "pop": _inject_pop,
    "jitter": _inject_jitter,
    "limb lost": _inject_limb_gap,
    "figure lost": _inject_figure_gap,
    "root off": _inject_root_offset,
}


def _draw_joint(skeleton: Skeleton, rng: np.random.Generator) -> int:
    return int(rng.choice([j for j, name in enumerate(skeleton.names) if name.endswith(INJECTABLE_JOINT_NAMES)]))


def _draw_limb(skeleton: Skeleton, rng: np.random.Generator) -> tuple[int, ...]:
    side = ("Left", "Right")[rng.integers(2)]
    return tuple(skeleton.find_joint(side + name) for name in LIMB_JOINT_NAMES[rng.integers(len(LIMB_JOINT_NAMES))])


def _convert_rotation_vectors(vectors: np.ndarray | list[float]) -> np.ndarray:
    return Rotation.from_rotvec(vectors).as_matrix()
