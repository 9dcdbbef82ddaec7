"""A reference implementation: the same problem in plain NumPy, its derivatives by finite differences.

A frame's pose changes by x = (root turn, root shift, the free joints' turns, P shared unknowns), all turns and shifts in
world axes, as the sweep's unknowns are: N = 3 + 3 (free joints, the root among them) + P numbers.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.normal_equations import NormalEquations
from mocapfix.kernels.terms import (
    HUBER,
    DirectionTerm,
    DistanceTerm,
    JointLimitTerm,
    LatentCodeTerm,
    OrientationTerm,
    PointTerm,
    PosePriorTerm,
    ReprojectionTerm,
    ScalarTerm,
    TrackingTerm,
)


class Frame(NamedTuple):
    """One frame's problem: a body, the terms on it (frame 0 of each), and a pose."""

    tree: KinematicTree
    terms: tuple
    root: np.ndarray  # (3,)
    local: np.ndarray  # (J, 3, 3)
    shared: np.ndarray  # (P,)


class World(NamedTuple):
    """A pose and its forward kinematics."""

    tree: KinematicTree
    local: np.ndarray
    shared: np.ndarray
    position: np.ndarray  # (J, 3)
    rotation: np.ndarray  # (J, 3, 3)


def compute_world(tree: KinematicTree, root: np.ndarray, local: np.ndarray, shared: np.ndarray | None = None) -> World:
    """Return the forward kinematics of a pose; `shared` may be omitted if the shape is known."""
    shared = np.zeros(0) if shared is None else shared
    position, rotation = [root], [local[0]]
    for j, p in list(enumerate(tree.parents))[1:]:
        position.append(position[p] + rotation[p] @ tree.offsets[j])
        rotation.append(rotation[p] @ local[j])
    return World(tree, local, shared, np.array(position), np.array(rotation))


def compute_point_positions(joints: np.ndarray, places: np.ndarray, at: World) -> np.ndarray:
    """Return world positions (K, 3) of points of the body."""
    return at.position[joints] + np.einsum("kab,kb->ka", at.rotation[joints], places)


def compute_rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Return (K, 3) rotation vectors of (K, 3, 3)."""
    return Rotation.from_matrix(rotations).as_rotvec().reshape(-1, 3)


def compute_deviations(middle: np.ndarray, at: World) -> np.ndarray:
    """Return (J, 3) rotation vectors from `middle` (J, 3, 3) to the joints, 0 where a joint is not free."""
    return compute_rotation_vectors(at.local @ np.swapaxes(middle, 1, 2)) * at.tree.free[:, None]


def compute_tilt(at: World) -> np.ndarray:
    """Return (3,) the rotation vector of the root's turn without its heading, by swing and twist."""
    _, y, _, w = Rotation.from_matrix(at.local[0]).as_quat()
    return (Rotation.from_rotvec([0, 2 * np.arctan2(y, w), 0]).inv() * Rotation.from_matrix(at.local[0])).as_rotvec()


def whiten(information: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return (J, 3) residuals (J, 3) over their standard deviations; information (J, 3, 3) symmetric."""
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0))[:, None] @ np.swapaxes(vectors, 1, 2)
    return np.einsum("jab,jb->ja", root, residual)


# each kind's residuals, (n, d) over their standard deviations: n of them, d numbers each, which are robust together


def compute_point_residuals(term: PointTerm, at: World) -> np.ndarray:
    return compute_point_positions(term.joints, term.offsets, at) - term.measured[0]


def compute_direction_residuals(term: DirectionTerm, at: World) -> np.ndarray:
    return np.einsum("kab,kb->ka", at.rotation[term.joints], term.bone_axes) - term.measured[0]


def compute_orientation_residuals(term: OrientationTerm, at: World) -> np.ndarray:
    return compute_rotation_vectors(at.rotation[term.joints] @ np.swapaxes(term.measured[0], 1, 2))


def compute_reprojection_residuals(term: ReprojectionTerm, at: World) -> np.ndarray:
    point = compute_point_positions(term.joints, term.offsets, at)
    before = np.einsum("kab,kb->ka", term.rotation[term.cameras], point) + term.translation[term.cameras]
    flat = before[:, :2] / np.where(term.perspective[term.cameras], before[:, 2], 1.0)[:, None]
    return flat - term.measured[0]


def compute_tracking_residuals(term: TrackingTerm, at: World) -> np.ndarray:
    turned = np.sqrt(term.weight[0])[:, None] * compute_deviations(term.rotations[0], at)
    return np.r_[turned, [np.sqrt(term.root_weight[0]) * (at.position[0] - term.root[0])]]


def compute_pose_prior_residuals(term: PosePriorTerm, at: World) -> np.ndarray:
    wanted = term.mean_vectors * at.tree.free[:, None] if len(term.mean_vectors) else 0.0
    return whiten(term.information[0], compute_deviations(term.rotations[0], at) - wanted)


def compute_joint_limit_residuals(term: JointLimitTerm, at: World) -> np.ndarray:
    vector = compute_deviations(term.reference, at)
    excess = vector - np.clip(vector, term.low, term.high)
    return np.sqrt(term.weight) * excess[1:] * at.tree.free[1:, None]


def compute_latent_code_residuals(term: LatentCodeTerm, at: World) -> np.ndarray:
    code, row = at.shared[: term.code.shape[1]], term.linearisation[0]
    step = code - term.code[row]
    decoded = term.decoded[row] + term.jacobian[row] @ step
    away = (np.r_[compute_tilt(at)[None], compute_deviations(term.reference, at)[1:]] - decoded) * at.tree.free[:, None]
    return np.r_[whiten(term.information, away).ravel(), code, np.sqrt(term.code_weight[row]) * step][:, None]


def compute_distance_residuals(term: DistanceTerm, at: World) -> np.ndarray:
    ends = [compute_point_positions(term.joints[:, e], term.offsets[:, e], at) for e in (0, 1)]
    away = np.linalg.norm(ends[1] - ends[0], axis=1) - term.length[0]
    return (np.sqrt(term.weight[0]) * away)[:, None]


def compute_scalar_residuals(term: ScalarTerm, at: World) -> np.ndarray:
    total = term.value[0] + (term.gradient[0] * compute_deviations(term.reference[0], at)).sum()
    return np.sqrt(term.weight[0]) * np.array([[total]])


RESIDUALS: dict[type, Callable[..., np.ndarray]] = {
    PointTerm: compute_point_residuals,
    TrackingTerm: compute_tracking_residuals,
    PosePriorTerm: compute_pose_prior_residuals,
    DirectionTerm: compute_direction_residuals,
    OrientationTerm: compute_orientation_residuals,
    ReprojectionTerm: compute_reprojection_residuals,
    JointLimitTerm: compute_joint_limit_residuals,
    LatentCodeTerm: compute_latent_code_residuals,
    DistanceTerm: compute_distance_residuals,
    ScalarTerm: compute_scalar_residuals,
}
ROBUST_TERMS = (PointTerm, DirectionTerm, OrientationTerm, ReprojectionTerm)


def compute_residual(term, at: World) -> np.ndarray:
    """Return (n, d) a term's residuals over their standard deviations, without those of weight zero."""
    if not isinstance(term, ROBUST_TERMS):
        return RESIDUALS[type(term)](term, at)
    weighted = term.weight[0] > 0
    with np.errstate(invalid="ignore"):
        return (RESIDUALS[type(term)](term, at) * np.sqrt(term.weight[0])[:, None])[weighted]


def compute_loss(kind: int, square: np.ndarray, scale2: float) -> tuple[np.ndarray, np.ndarray]:
    """Return cost and weight of squared residuals, as Geman & McClure (1987) and Huber (1964) print them."""
    if scale2 == np.inf:
        return square / 2, np.ones_like(square)
    if kind == HUBER:
        s, c = np.sqrt(square), np.sqrt(scale2)
        return np.where(s <= c, s**2 / 2, c * s - c**2 / 2), np.minimum(1.0, c / np.maximum(s, 1e-300))
    return scale2 * square / (scale2 + square) / 2, (scale2 / (scale2 + square)) ** 2


def apply_change(frame: Frame, x: np.ndarray) -> Frame:
    """Return the frame after the change x (N,): each joint turned about world axes, in its parent as it stands."""
    tree, rotation, after = frame.tree, compute_world(*frame[:1], *frame[2:]).rotation, frame.local.copy()
    after[0] = Rotation.from_rotvec(x[:3]).as_matrix() @ frame.local[0]
    for n, j in enumerate(np.flatnonzero(tree.free[1:]) + 1):
        parent = rotation[tree.parents[j]]
        after[j] = parent.T @ Rotation.from_rotvec(x[6 + 3 * n : 9 + 3 * n]).as_matrix() @ parent @ frame.local[j]
    return frame._replace(root=frame.root + x[3:6], local=after, shared=frame.shared + x[len(x) - len(frame.shared) :])


def count_unknowns(frame: Frame) -> int:
    """Return N, the length of a pose's change."""
    return 3 + 3 * int(frame.tree.free.sum()) + len(frame.shared)


def compute_jacobian(function: Callable[[np.ndarray], np.ndarray], count: int, step: float = 1e-5) -> np.ndarray:
    """Return (..., count) the derivative of function(x) at x = 0, by central differences."""
    return np.stack([(function(step * e) - function(-step * e)) / (2 * step) for e in np.eye(count)], axis=-1)


def compute_cost(frame: Frame, scale2: float = np.inf) -> float:
    """Return half the sum of squares, robust where a term is."""
    return compute_quadratic(frame, scale2, slopes=False)[0]


def compute_quadratic(frame: Frame, scale2: float = np.inf, slopes: bool = True) -> tuple[float, np.ndarray, np.ndarray]:
    """Return cost, J'Wr (N,) and J'WJ (N, N) of all terms, J by differences, W the robust weights."""
    count, total = count_unknowns(frame), 0.0
    gradient, curvature = np.zeros(count), np.zeros((count, count))
    for term in frame.terms:

        def of(x, term=term):
            after = apply_change(frame, x)
            return compute_residual(term, compute_world(*after[:1], *after[2:]))

        r = of(np.zeros(count))
        scale = scale2 if isinstance(term, ROBUST_TERMS) else np.inf
        part, weight = compute_loss(getattr(term, "loss", 0), (r**2).sum(1), scale)
        total += part.sum()
        if slopes and r.size:
            slope = compute_jacobian(of, count)
            gradient += np.einsum("ndx,n,nd->x", slope, weight, r)
            curvature += np.einsum("ndx,n,ndy->xy", slope, weight, slope)
    return float(total), gradient, curvature


def build_cross_matrix(v: np.ndarray) -> np.ndarray:
    """Return (3, 3) the matrix of the cross product v x."""
    return np.cross(v, np.eye(3)).T


def compute_twist_maps(tree: KinematicTree, system: NormalEquations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how bodies' twists (J, 6, N), joints' own turns (J, 3, N) and the shared unknowns (P, N) follow from x."""
    joints, shared = len(tree.parents), len(system.g_shared)
    count = 3 + 3 * int(tree.free.sum()) + shared
    twist, turn = np.zeros((joints, 6, count)), np.zeros((joints, 3, count))
    twist[0, :, :6], column = np.eye(6), 6
    for j, p in list(enumerate(tree.parents))[1:]:
        twist[j] = twist[p]
        if tree.free[j]:
            turn[j, :, column : column + 3] = np.eye(3)
            twist[j, :3] += turn[j]
            twist[j, 3:] += build_cross_matrix(system.lever_arm[j]) @ turn[j]
            column += 3
    return twist, turn, np.eye(count)[count - shared :]


def compute_row_map(tree: KinematicTree, system: NormalEquations) -> np.ndarray:
    """Return (M, N) the system's rows on x."""
    twist, turn, _ = compute_twist_maps(tree, system)
    return np.einsum("mja,jan->mn", system.row_twist, twist) + np.einsum("mja,jan->mn", system.row_joint, turn)


def assemble_equations(tree: KinematicTree, system: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
    """Return gradient (N,) and curvature (N, N) of a system as one whole quadratic in x."""
    twist, turn, shared = compute_twist_maps(tree, system)
    among = np.tril(system.h_shared) + np.tril(system.h_shared, -1).T
    own = np.concatenate([twist[:1, :3], turn[1:]])  # the root's own turn is part of its twist
    crossed = np.einsum("jan,jap->np", own, system.h_joint_shared) @ shared
    rows = compute_row_map(tree, system)
    bodies, joints = np.swapaxes(twist, 1, 2) @ system.h @ twist, np.swapaxes(turn, 1, 2) @ system.h_joint @ turn
    curvature = bodies.sum(0) + joints.sum(0) + shared.T @ among @ shared + crossed + crossed.T + rows.T @ rows
    gradient = np.einsum("jan,ja->n", twist, system.g) + np.einsum("jan,ja->n", turn, system.g_joint)
    return gradient + shared.T @ system.g_shared + rows.T @ system.row_residual, curvature
