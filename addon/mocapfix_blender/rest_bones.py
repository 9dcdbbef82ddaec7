"""Tails and roll of the bones of an armature: Y along the bone to its child, Z to the front."""

import numpy as np

from .solved_take import SkeletonMotion

MIN_BONE_LENGTH_M = 1e-3
"""Blender removes bones without a length"""
DEFAULT_BONE_LENGTH_M = 0.05
"""of a last bone whose end is not known and that has no parent to take the length from"""
END_LENGTH_SHARE = 0.4
"""length of a last bone whose end is not known, as a share of its parent's"""
MIN_MEAN_SHARE = 0.5
"""A bone with several children points to the mean of their positions if it is at least this share of their mean distance away;
otherwise to the child that carries the most joints."""
FRONT, UP = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def compute_rest_heads(body: SkeletonMotion) -> np.ndarray:
    """Compute the heads (J, 3) of the bones in the rest pose, which stands on the floor at the origin."""
    heads = np.zeros((len(body.names), 3))
    for j, parent in enumerate(body.parents):
        if parent >= 0:
            heads[j] = heads[parent] + body.offsets[j]
    ends = heads + np.nan_to_num(body.ends)
    return heads - [0.0, 0.0, min(heads[:, 2].min(), ends[:, 2].min())]


def compute_tail_offsets(body: SkeletonMotion) -> np.ndarray:
    """Compute the tails (J, 3) of the bones relative to their heads.

    A joint at the place of its parent is skipped: the parent points to what follows, at half the length, so that both can be
    selected.
    """
    children = [np.flatnonzero(body.parents == j) for j in range(len(body.names))]
    sizes = np.ones(len(body.names), int)
    for j in range(len(body.names) - 1, 0, -1):
        sizes[body.parents[j]] += sizes[j]

    def find_next(joint: int) -> list[tuple[np.ndarray, int, bool]]:
        """Return the offset of each next joint elsewhere, the number of joints that follow, and whether joints were skipped."""
        found: list[tuple[np.ndarray, int, bool]] = []
        for child in map(int, children[joint]):
            if np.linalg.norm(body.offsets[child]) > MIN_BONE_LENGTH_M:
                found.append((body.offsets[child], int(sizes[child]), False))
            else:
                found += [(offset, int(sizes[child]), True) for offset, _, _ in find_next(child)]
        return found

    tails = np.full((len(body.names), 3), np.nan)
    for j, parent in enumerate(body.parents):
        following = find_next(j)
        if following:
            offsets = np.array([offset for offset, _, _ in following])
            mean, main = offsets.mean(0), max(range(len(following)), key=lambda k: following[k][1])
            is_spread = np.linalg.norm(mean) < MIN_MEAN_SHARE * np.linalg.norm(offsets, axis=1).mean()
            tails[j] = offsets[main] if is_spread else mean
            if len(following) > 1 and following[main][2]:
                tails[j] *= 0.5
        elif np.linalg.norm(body.ends[j]) > MIN_BONE_LENGTH_M:
            tails[j] = body.ends[j]
        elif parent >= 0:
            tails[j] = END_LENGTH_SHARE * tails[parent]
        if not np.linalg.norm(tails[j]) > MIN_BONE_LENGTH_M:
            tails[j] = DEFAULT_BONE_LENGTH_M * UP
    return tails


def find_roll_directions(tails: np.ndarray) -> np.ndarray:
    """Return the direction (J, 3) to which each bone's Z axis is turned: the front, for bones that point there up."""
    directions = tails / np.linalg.norm(tails, axis=1, keepdims=True)
    return np.where(np.abs(directions @ FRONT)[:, None] > 0.8, UP, FRONT)
