"""Faults put into sound animations, found and mended: how far the joints are off beside interpolating across each fault."""

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mocapfix.bench.injected_turns import Put


def interpolated(root: np.ndarray, local: np.ndarray, put: list[Put]) -> tuple[np.ndarray, np.ndarray]:
    """-> places (T, 3) and local rotations (T, J, 3, 3) with every fault bridged from its last sound frame to its first, joint by
    joint: spherically, and the root's place in a straight line where it is part of the fault."""
    root, local = root.copy(), local.copy()
    for each in put:
        span, ends = np.arange(each.first, each.last + 1), np.array([each.first - 1, each.last + 1])
        for j in each.joints:
            if each.kind != "root off":
                local[span, j] = Slerp(ends, Rotation.from_matrix(local[ends, j]))(span).as_matrix()
        if each.kind == "root off" or len(each.joints) == local.shape[1]:
            share = ((span - ends[0]) / (ends[1] - ends[0]))[:, None]
            root[span] = (1 - share) * root[ends[0]] + share * root[ends[1]]
    return root, local
