"""Injection of faults into the joint rotations and the root position of a sound motion.

The faults are those of marker-based solvers, inertial suits and video. In a gap the last value is held, or the values are zero
or absent.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton

FAULT_SPACING_S = 2.0  # between two faults
EDGE_MARGIN_S = 0.8  # before the first fault and after the last
FAULT_DURATION_RANGES_S = {"1 frame": (0.0, 0.0), "short": (0.2, 0.5), "long": (0.5, 1.0)}
INJECTED_JITTER_SD_RAD = np.radians(3.0)
MIN_POP_DEG, MAX_POP_DEG = 10, 60
MIN_ROOT_OFFSET_M, MAX_ROOT_OFFSET_M = 0.1, 0.5
INJECTED_LIMB_JOINT_NAMES = (("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot"), ("ForeArm", "Hand"), ("Leg", "Foot"))
# Suffixes of the joints that get faults.
INJECTABLE_JOINT_NAMES = ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand", "Neck", "Head", "LowerBack", "Spine", "Shoulder")


class InjectedAnimationFault(NamedTuple):
    """A fault of some joints in the frames first..last, inclusive. A fault of all joints includes the root position."""

    kind: str
    joints: tuple[int, ...]
    first: int
    last: int


@dataclass(frozen=True)
class _Target:
    """The poses that an injector changes in place, the frames that it changes, and its source of random numbers."""

    root_position: Float[np.ndarray, "T 3"]
    local_rotations: Float[np.ndarray, "T J 3 3"]
    skeleton: Skeleton
    frames: slice
    rng: np.random.Generator


def inject_animation_faults(
    motion: Motion, skeleton: Skeleton, rate: float, kind: str, duration_name: str, rng: np.random.Generator
) -> tuple[Motion, list[InjectedAnimationFault]]:
    """Return a motion with as many faults of a kind as fit into it, and the faults. Absent values are NaN.

    kind           one of ANIMATION_FAULT_INJECTORS
    duration_name  one of FAULT_DURATION_RANGES_S
    """
    root_position, local_rotations = motion.root_position.copy(), motion.local_rotations.copy()
    faults: list[InjectedAnimationFault] = []
    min_duration_s, max_duration_s = FAULT_DURATION_RANGES_S[duration_name]
    margin = round(EDGE_MARGIN_S * rate)
    next_first = margin
    while True:
        frame_count = max(1, round(rng.uniform(min_duration_s, max_duration_s) * rate))
        first = next_first + int(rng.integers(margin))
        if first + frame_count + margin > motion.frame_count:
            break
        last = first + frame_count - 1
        target = _Target(root_position, local_rotations, skeleton, slice(first, last + 1), rng)
        faults.append(InjectedAnimationFault(kind, ANIMATION_FAULT_INJECTORS[kind](target), first, last))
        next_first = last + 1 + round(FAULT_SPACING_S * rate)
    return replace(motion, root_position=root_position, local_rotations=local_rotations), faults


def _inject_flip(target: _Target) -> tuple[int, ...]:
    """Rotate one joint by 180 degrees about one of its axes."""
    joint = _draw_joint(target)
    flip = _convert_rotation_vectors(target.rng.permuted([np.pi, 0.0, 0.0]))
    target.local_rotations[target.frames, joint] = target.local_rotations[target.frames, joint] @ flip
    return (joint,)


def _inject_pop(target: _Target) -> tuple[int, ...]:
    """Rotate one joint by 10 to 60 degrees: in its own axes, in those of its parent, or in one of its angles."""
    joint, angle = _draw_joint(target), np.radians(target.rng.uniform(MIN_POP_DEG, MAX_POP_DEG))
    variant = target.rng.integers(3)
    rotations = target.local_rotations[target.frames, joint]
    if variant == 2:
        angles = Rotation.from_matrix(rotations).as_euler("ZYX")
        angles[:, target.rng.integers(3)] += angle * target.rng.choice([-1, 1])
        target.local_rotations[target.frames, joint] = Rotation.from_euler("ZYX", angles).as_matrix()
        return (joint,)
    axis = target.rng.normal(size=3)
    offset = _convert_rotation_vectors(angle * axis / np.linalg.norm(axis))
    target.local_rotations[target.frames, joint] = offset @ rotations if variant else rotations @ offset
    return (joint,)


def _inject_jitter(target: _Target) -> tuple[int, ...]:
    """Add independent noise to the rotations of one joint or of a limb."""
    joints = (_draw_joint(target),) if target.rng.integers(2) else _draw_limb(target)
    frame_count = target.frames.stop - target.frames.start
    for joint in joints:
        noise = _convert_rotation_vectors(target.rng.normal(0, INJECTED_JITTER_SD_RAD, (frame_count, 3)))
        target.local_rotations[target.frames, joint] = target.local_rotations[target.frames, joint] @ noise
    return joints


def _inject_limb_gap(target: _Target) -> tuple[int, ...]:
    """Hold the rotations of a limb, or set them to zero or NaN."""
    joints = _draw_limb(target)
    values = [target.local_rotations[target.frames.start - 1, joints], np.eye(3), np.nan]
    target.local_rotations[target.frames, joints] = values[target.rng.integers(3)]
    return joints


def _inject_figure_gap(target: _Target) -> tuple[int, ...]:
    """Hold all rotations and the root position, or set them to zero or NaN."""
    variant, before = target.rng.integers(3), target.frames.start - 1
    target.local_rotations[target.frames] = [target.local_rotations[before], np.eye(3), np.nan][variant]
    target.root_position[target.frames] = [target.root_position[before], np.zeros(3), np.nan][variant]
    return tuple(range(target.local_rotations.shape[1]))


def _inject_root_offset(target: _Target) -> tuple[int, ...]:
    """Move the root by 0.1 to 0.5 m."""
    direction = target.rng.normal(size=3)
    distance_m = target.rng.uniform(MIN_ROOT_OFFSET_M, MAX_ROOT_OFFSET_M)
    target.root_position[target.frames] += distance_m * direction / np.linalg.norm(direction)
    return (0,)


ANIMATION_FAULT_INJECTORS: dict[str, Callable[[_Target], tuple[int, ...]]] = {
    "flip": _inject_flip,
    "pop": _inject_pop,
    "jitter": _inject_jitter,
    "limb gap": _inject_limb_gap,
    "figure gap": _inject_figure_gap,
    "root offset": _inject_root_offset,
}


def _draw_joint(target: _Target) -> int:
    joints = [joint for joint, name in enumerate(target.skeleton.names) if name.endswith(INJECTABLE_JOINT_NAMES)]
    return int(target.rng.choice(joints))


def _draw_limb(target: _Target) -> tuple[int, ...]:
    side = ("Left", "Right")[target.rng.integers(2)]
    names = INJECTED_LIMB_JOINT_NAMES[target.rng.integers(len(INJECTED_LIMB_JOINT_NAMES))]
    return tuple(target.skeleton.find_joint(side + name) for name in names)


def _convert_rotation_vectors(vectors: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    return Rotation.from_rotvec(vectors).as_matrix()
