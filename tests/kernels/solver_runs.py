"""The kernels applied to the frames of the reference implementation."""

import numpy as np

from mocapfix.kernels.compilation import compile_kernel
from mocapfix.kernels.covariance import compute_uncertainty_frames
from mocapfix.kernels.forward_kinematics import KinematicTree, compute_forward_kinematics
from mocapfix.kernels.levenberg_marquardt import INITIAL_DAMPING_RATIO, solve_frames
from mocapfix.kernels.normal_equations import NormalEquations, SolveWorkspace, allocate_workspace, linearise_terms
from mocapfix.kernels.terms import count_rows
from mocapfix.solve import parallel
from mocapfix.solve.parallel import run_over_frames
from tests.kernels.dense_oracle import Frame

linearise = compile_kernel(linearise_terms)


def build_workspace(frame: Frame, scale2: float = np.inf, t: int = 0) -> tuple[float, SolveWorkspace]:
    """Return cost, and the workspace with the model of the frame's terms at its pose."""
    work = allocate_workspace(len(frame.local), len(frame.shared), count_rows(frame.terms))
    work.pose.root[:], work.pose.local[:], work.pose.shared[:] = frame.root, frame.local, frame.shared
    compute_forward_kinematics(frame.tree, work.pose)
    return linearise(frame.tree, frame.terms, t, float(scale2), work.pose, work.equations), work


def build_equations(frame: Frame, scale2: float = np.inf, t: int = 0) -> tuple[float, NormalEquations]:
    """Return cost, and the model."""
    cost, work = build_workspace(frame, scale2, t)
    return cost, work.equations


def solve_frames_from(frame: Frame, scales2: np.ndarray, frames: int = 1, most: int = 50, start=None):
    """Return root (T, 3), local (T, J, 3, 3), shared (T, P), status (T,) and iterations (T,) from the frame's pose or a start."""
    root, local, shared = (np.stack([each] * frames) for each in start or frame[2:])
    ends = solve_in_order(
        parallel.order_independently(np.arange(frames), len(frame.local)),
        frame.tree,
        frame.terms,
        scales2,
        root,
        local,
        shared,
        most,
    )
    return root, local, shared, *ends


def solve_in_order(
    order: parallel.SolveOrder, tree: KinematicTree, terms: tuple, scales2: np.ndarray, root, local, shared, most: int = 50
):
    """Solve poses in place, in an order. Return status (T,) and iterations (T,), -1 for frames that are not in the order."""
    status, iterations = np.full(len(root), -1), np.full(len(root), -1)
    run_over_frames(
        solve_frames, len(order.chain_starts) - 1, tree, terms, order, scales2, INITIAL_DAMPING_RATIO, most, count_rows(terms),
        root, local, shared, status, iterations,
    )  # fmt: skip
    return status, iterations


def compute_uncertainty(frame: Frame, scale2: float, root=None, local=None, shared=None):
    """Return standard deviations of markers (T, K) and joints (T, J), variances of joints' rotations (T, J) and of the root's
    position (T,), at the frame's pose or at others.
    """
    given = zip(frame[2:], (root, local, shared), strict=True)
    root, local, shared = (one[None] if many is None else many for one, many in given)
    frames, joints = local.shape[:2]
    each, markers = (frames, joints), len(frame.terms[0].joints)
    out = np.empty((frames, markers)), np.empty(each), np.empty(each), np.empty(frames)
    run_over_frames(
        compute_uncertainty_frames,
        frames,
        frame.tree,
        frame.terms,
        float(scale2),
        count_rows(frame.terms),
        root,
        local,
        shared,
        *out,
    )
    return out
