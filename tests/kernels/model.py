"""The kernels' own work on a frame as the oracle draws it."""

import numpy as np

from mocapfix.kernels import plan
from mocapfix.kernels.levenberg import TAU, solve_frames
from mocapfix.kernels.pose import Tree, forward
from mocapfix.kernels.system import System, linearise
from mocapfix.kernels.terms import rows_of
from mocapfix.kernels.threads import over_frames
from mocapfix.kernels.uncertainty import uncertainties
from mocapfix.kernels.workspace import Workspace, workspace
from tests.kernels.dense import Frame


def worked(frame: Frame, scale2: float = np.inf, t: int = 0) -> tuple[float, Workspace]:
    """-> cost, and the workspace with the model of the frame's terms at its pose."""
    work = workspace(len(frame.local), len(frame.shared), rows_of(frame.terms))
    work.pose.root[:], work.pose.local[:], work.pose.shared[:] = frame.root, frame.local, frame.shared
    forward(frame.tree, work.pose)
    return linearise(frame.tree, frame.terms, t, float(scale2), work.pose, work.system), work


def linearised(frame: Frame, scale2: float = np.inf, t: int = 0) -> tuple[float, System]:
    """-> cost, and the model."""
    cost, work = worked(frame, scale2, t)
    return cost, work.system


def solved(frame: Frame, scales2: np.ndarray, frames: int = 1, most: int = 50, start=None):
    """-> root (T, 3), local (T, J, 3, 3), shared (T, P), status (T,), iterations (T,) from the frame's pose or another start."""
    root, local, shared = (np.stack([each] * frames) for each in start or frame[2:])
    ends = followed(plan.alone(frames, len(frame.local)), frame.tree, frame.terms, scales2, root, local, shared, most)
    return root, local, shared, *ends


def followed(order: plan.Plan, tree: Tree, terms: tuple, scales2: np.ndarray, root, local, shared, most: int = 50):
    """Solve poses in place, as a plan says. -> status (T,), iterations (T,), -1 for frames that are not in the plan"""
    status, iterations = np.full(len(root), -1), np.full(len(root), -1)
    over_frames(
        solve_frames, len(order.chains) - 1, tree, terms, order, scales2, TAU, most, rows_of(terms), root, local, shared,
        status, iterations,
    )  # fmt: skip
    return status, iterations


def foretold(frame: Frame, scale2: float, root=None, local=None, shared=None):
    """-> standard deviation of markers (T, K) and of joints' places (T, J), variance of joints' turns (T, J) and of the root's
    place (T,), at the frame's pose or at others.
    """
    given = zip(frame[2:], (root, local, shared), strict=True)
    root, local, shared = (one[None] if many is None else many for one, many in given)
    frames, joints = local.shape[:2]
    each, markers = (frames, joints), len(frame.terms[0].joints)
    out = np.empty((frames, markers)), np.empty(each), np.empty(each), np.empty(frames)
    over_frames(uncertainties, frames, frame.tree, frame.terms, float(scale2), rows_of(frame.terms), root, local, shared, *out)
    return out
