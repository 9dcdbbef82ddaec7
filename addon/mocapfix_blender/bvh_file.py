"""The joints and the motion of a BVH file, in metres and in Blender's axes.

A BVH states neither its unit nor its up axis. mocapfix has found both; they follow from its joint positions of the same file.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from .axes import align_signs, make_matrices, multiply_quaternions, rotate_quaternions
from .process import ProcessError
from .solved_take import SkeletonMotion, SolvedTake

MAX_COMPARED_FRAMES = 50
"""frames in which the joints of the file are compared with those of mocapfix"""
MIN_TRANSLATION = 1e-4
"""least translation of a joint that is kept, as a share of the longest bone: smaller ones are rounding"""


@dataclass
class _Joint:
    name: str
    parent: int
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    channels: list[str] = field(default_factory=list)
    end: list[float] | None = None


def read_bvh_body(path: Path, take: SolvedTake) -> SkeletonMotion:
    """Read the cleaned BVH of a take. Raises ProcessError if it cannot be read or its axes cannot be found."""
    try:
        joints, values, frame_time = _parse_bvh(path.read_text(encoding="utf-8", errors="replace"))
        body = _build_motion(joints, values, 1.0 / frame_time)
    except (ValueError, IndexError, StopIteration) as error:
        raise ProcessError(
            f"{path.name}: the cleaned BVH cannot be read; import it with File > Import > Motion Capture."
        ) from error
    return _convert_axes(body, *_fit_axes(body, take))


def compute_joint_positions(body: SkeletonMotion, frames: np.ndarray) -> np.ndarray:
    """Compute the positions (N, J, 3) of the joints in some frames, given by their indices."""
    local = make_matrices(body.rotations[frames])
    positions, rotations = np.zeros((*local.shape[:2], 3)), np.zeros(local.shape)
    for j, parent in enumerate(body.parents):
        if parent < 0:
            positions[:, j], rotations[:, j] = body.root[frames], local[:, j]
        else:
            offsets = body.translations[j][frames] if j in body.translations else body.offsets[j][None]
            positions[:, j] = positions[:, parent] + (rotations[:, parent] @ offsets[..., None])[..., 0]
            rotations[:, j] = rotations[:, parent] @ local[:, j]
    return positions


def _parse_bvh(text: str) -> tuple[list[_Joint], np.ndarray, float]:
    """Return the joints, the values (T, C) of their channels, and the time of a frame in seconds."""
    head, _, body = text.partition("MOTION")
    joints: list[_Joint] = []
    stack: list[int | None] = []  # the joint of each open brace, None for an end site
    tokens = iter(head.replace("{", " { ").replace("}", " } ").split())
    for token in tokens:
        if token.upper() in ("ROOT", "JOINT", "END"):
            name = " ".join(iter(lambda: next(tokens), "{"))
            if token.upper() == "END":
                stack.append(None)
            else:
                joints.append(_Joint(name, stack[-1] if stack and stack[-1] is not None else -1))
                stack.append(len(joints) - 1)
        elif token == "}":
            stack.pop()
        elif token.upper() == "OFFSET":
            offset = [float(next(tokens)) for _ in range(3)]
            if stack[-1] is None:
                joints[stack[-2] or 0].end = offset
            else:
                joints[stack[-1]].offset = offset
        elif token.upper() == "CHANNELS":
            joints[-1].channels = [next(tokens).lower() for _ in range(int(next(tokens)))]
    _, frame_count, _, _, frame_time, *values = body.split()  # Frames: N Frame Time: S
    return joints, np.array(values, float).reshape(int(frame_count), -1), float(frame_time)


def _build_motion(joints: list[_Joint], values: np.ndarray, rate: float) -> SkeletonMotion:
    """Return the motion in the file's own units and axes."""
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(values), len(joints), 1))
    positions = np.tile(np.array([joint.offset for joint in joints], float), (len(values), 1, 1))
    column = 0
    for j, joint in enumerate(joints):
        has_positions = False
        for channel in joint.channels:
            axis, value = "xyz".index(channel[0]), values[:, column]
            column += 1
            if channel[1:] == "rotation":
                turn = np.zeros((len(values), 4))
                turn[:, axis], turn[:, 3] = np.sin(np.radians(value) / 2), np.cos(np.radians(value) / 2)
                rotations[:, j] = multiply_quaternions(rotations[:, j], turn)
            else:
                positions[:, j, axis], has_positions = value, True
        if j and has_positions:
            median, offset = np.nanmedian(positions[:, j], axis=0), np.array(joint.offset)
            if np.linalg.norm(median) < np.linalg.norm(median - offset):  # a displacement from the offset
                positions[:, j] += offset
    offsets = np.nanmedian(positions, axis=0)
    offsets[0] = 0.0
    tolerance = MIN_TRANSLATION * np.linalg.norm(offsets, axis=1).max()
    moving = [j for j in range(1, len(joints)) if np.nanmax(np.abs(positions[:, j] - offsets[j])) > tolerance]
    return SkeletonMotion(
        tuple(joint.name for joint in joints),
        np.array([joint.parent for joint in joints]),
        offsets,
        np.array([joint.end or [np.nan] * 3 for joint in joints], float),
        positions[:, 0],
        align_signs(rotations),
        rate,
        np.ones(len(joints), bool),
        {j: positions[:, j] for j in moving},
    )


def _fit_axes(body: SkeletonMotion, take: SolvedTake) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the scale, the rotation (3, 3) and the translation (3,) from the file's axes to Blender's, by least squares."""
    frames = np.unique(np.linspace(0, len(body.root) - 1, MAX_COMPARED_FRAMES).astype(int))
    common = [(body.names.index(label), m) for m, label in enumerate(take.labels) if label in body.names]
    ours, theirs = map(list, zip(*common, strict=True)) if common else ([], [])
    source = compute_joint_positions(body, frames)[:, ours].reshape(-1, 3)
    target = take.markers[frames][:, theirs].reshape(-1, 3)
    is_finite = np.isfinite(source).all(1) & np.isfinite(target).all(1)
    if is_finite.sum() < 4:
        raise ProcessError(f"{take.name}: too few joints are known to find the unit of the file; import it as BVH.")
    source, target = source[is_finite], target[is_finite]
    a, b = source - source.mean(0), target - target.mean(0)
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = (u * signs) @ vt, float((singular * signs).sum() / (a**2).sum())
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def _convert_axes(body: SkeletonMotion, scale: float, rotation: np.ndarray, translation: np.ndarray) -> SkeletonMotion:
    return replace(
        body,
        offsets=scale * body.offsets @ rotation.T,
        ends=scale * body.ends @ rotation.T,
        root=scale * body.root @ rotation.T + translation,
        rotations=rotate_quaternions(body.rotations, rotation),
        translations={j: scale * each @ rotation.T for j, each in body.translations.items()},
    )
