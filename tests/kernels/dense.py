"""The oracle: the same problem in plain NumPy, written out in full, its derivatives by finite differences.

A frame's pose changes by x = (root turn, root shift, the free joints' turns), N = 6 + 3 (free joints below the root), all in
world axes, as the sweep's unknowns are.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels.levenberg import Attached, Pull, Tree


class Frame(NamedTuple):
    """One frame's problem: a body, what was seen of it with which information (1/m^2), what it is pulled to, and a pose."""

    tree: Tree
    attached: Attached
    seen: np.ndarray
    weight: np.ndarray
    pull: Pull
    root: np.ndarray
    local: np.ndarray


def tree(rng: np.random.Generator, joints: int) -> Tree:
    """-> a random tree: about every fourth joint is fixed, the root never."""
    parents = np.array([-1, *(rng.integers(j) for j in range(1, joints))])
    free = rng.random(joints) < 0.75
    free[0] = True
    return Tree(parents, rng.normal(0, 0.3, (joints, 3)), free)


def spd(rng: np.random.Generator, count: int, size: int, scale: float = 1.0) -> np.ndarray:
    """-> (count, size, size) random symmetric positive definite matrices."""
    half = rng.normal(size=(count, size, size))
    return scale * (half @ np.swapaxes(half, 1, 2) + 0.1 * np.eye(size))


def rotations(rng: np.random.Generator, count: int, largest: float = 3.0) -> np.ndarray:
    """-> (count, 3, 3) random rotations, each by up to `largest` radians an axis."""
    return Rotation.from_rotvec(rng.uniform(-largest, largest, (count, 3)) / np.sqrt(3)).as_matrix()


def frame(rng: np.random.Generator, joints: int, markers_each: int = 3, noise: float = 0.02) -> Frame:
    """-> a random body whose markers are all seen, `noise` metres off, under a random pull."""
    body = tree(rng, joints)
    attached = Attached(np.repeat(np.arange(joints), markers_each), rng.normal(0, 0.15, (joints * markers_each, 3)))
    root, local = rng.normal(0, 1.0, 3), rotations(rng, joints)
    seen = markers(attached, *forward(body, root, local)) + rng.normal(0, noise, (len(attached.joints), 3))
    pull = Pull(
        rotations(rng, joints, 0.5) @ local,
        spd(rng, joints, 3, 30.0),
        root + rng.normal(0, 0.1, 3),
        np.array(rng.uniform(10, 200)),
    )
    return Frame(body, attached, seen, rng.uniform(1e2, 1e4, len(seen)), pull, root, local)


def forward(tree: Tree, root: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> world positions (J, 3) and rotations (J, 3, 3)."""
    position, rotation = [root], [local[0]]
    for j, p in list(enumerate(tree.parents))[1:]:
        position.append(position[p] + rotation[p] @ tree.offsets[j])
        rotation.append(rotation[p] @ local[j])
    return np.array(position), np.array(rotation)


def markers(attached: Attached, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """-> (K, 3) where the body carries its markers."""
    return position[attached.joints] + np.einsum("kab,kb->ka", rotation[attached.joints], attached.places)


def moved(tree: Tree, root: np.ndarray, local: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> root and local rotations after the change x (N,): each joint turned about world axes, in its parent as it stands."""
    rotation, after = forward(tree, root, local)[1], local.copy()
    after[0] = Rotation.from_rotvec(x[:3]).as_matrix() @ local[0]
    for n, j in enumerate(np.flatnonzero(tree.free[1:]) + 1):
        parent = rotation[tree.parents[j]]
        after[j] = parent.T @ Rotation.from_rotvec(x[6 + 3 * n : 9 + 3 * n]).as_matrix() @ parent @ local[j]
    return root + x[3:6], after


def residuals(problem: Frame) -> np.ndarray:
    """-> every residual over its standard deviation: markers, free joints' pulls, the root's."""
    body, attached, seen, weight, pull, root, local = problem
    away = (markers(attached, *forward(body, root, local)) - seen) * np.sqrt(weight)[:, None]
    turned = Rotation.from_matrix(local @ np.swapaxes(pull.rotations, 1, 2)).as_rotvec()[body.free]
    upper = np.swapaxes(np.linalg.cholesky(pull.information[body.free]), 1, 2)
    shifted = (root - pull.root) * np.sqrt(pull.root_information)
    return np.r_[away.ravel(), np.einsum("jab,jb->ja", upper, turned).ravel(), shifted]


def pose_residuals(problem: Frame) -> Callable[[np.ndarray], np.ndarray]:
    """-> the residuals as a function of the change x (N,) of the pose."""

    def of(x: np.ndarray) -> np.ndarray:
        root, local = moved(problem.tree, problem.root, problem.local, x)
        return residuals(problem._replace(root=root, local=local))

    return of


def unknowns(tree: Tree) -> int:
    """-> N, the length of a pose's change."""
    return 3 + 3 * int(tree.free.sum())


def jacobian(function: Callable[[np.ndarray], np.ndarray], count: int, step: float = 1e-5) -> np.ndarray:
    """-> (..., count) the derivative of function(x) at x = 0, by central differences."""
    return np.stack([(function(step * e) - function(-step * e)) / (2 * step) for e in np.eye(count)], axis=-1)


def body_jacobians(tree: Tree, arm: np.ndarray) -> np.ndarray:
    """-> (J, 6, N) how each body's twist, about the common origin of the joints' places `arm` (J, 3), follows from x."""
    whole = np.zeros((len(arm), 6, unknowns(tree)))
    whole[0, :, :6] = np.eye(6)
    column = 6
    for j, p in list(enumerate(tree.parents))[1:]:
        whole[j] = whole[p]
        if tree.free[j]:
            whole[j, :3, column : column + 3] = np.eye(3)
            whole[j, 3:, column : column + 3] = cross(arm[j])
            column += 3
    return whole


def cross(v: np.ndarray) -> np.ndarray:
    """-> (3, 3) the matrix of the cross product v x."""
    return np.cross(v, np.eye(3)).T


def one(pull: Pull) -> Pull:
    """-> a frame's pull as the pull of a take of one frame."""
    root_information = np.array([float(pull.root_information)])
    return Pull(pull.rotations[None], pull.information[None], pull.root[None], root_information)


def no_pull(joints: int) -> Pull:
    """-> a pull on any frame that pulls nothing."""
    return Pull(np.tile(np.eye(3), (1, joints, 1, 1)), np.zeros((1, joints, 3, 3)), np.zeros((1, 3)), np.zeros(1))
