"""Shared responses: how each frame's markers and joints change with the unknowns that the frames share.

The pose of each frame adapts to a change of the body (variable projection), so that the sum over the frames gives the curvature
and the gradient of the cost whose poses are solved at every step. `kernels.schur` computes the responses.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.calibrate.parameters import ShapeDeformations
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.schur import eliminate_pose_frames
from mocapfix.kernels.terms import JointLimitTerm, PointTerm, PosePriorTerm, TrackingTerm
from mocapfix.solve.parallel import run_over_frames


class SharedResponses(NamedTuple):
    """Changes of T frames with Q shared unknowns, each frame's pose adapting, in metres per unit.

    The last rows of `marker_response` and `prior_response` are the remaining errors after the pose's own next step, in metres and
    radians.
    """

    cost: Float[np.ndarray, " T"]  # half the sum of squares, all terms included
    marker_weight: Float[np.ndarray, "T K"]  # 1/m^2, robust
    marker_shift: Float[np.ndarray, "T P K 3"]  # of markers, in their joints' axes, for a fixed pose
    marker_response: Float[np.ndarray, "T rows K 3"]  # (T, Q + 1, K, 3) of markers, in their joints' axes
    prior_response: Float[np.ndarray, "T rows F 3"]  # (T, Q + 1, F, 3) radians, of the joints' deviations from the mean pose
    prior_information: Float[np.ndarray, "F 3 3"]  # 1/rad^2, of the prior about the mean pose
    joint_response: Float[np.ndarray, "T Q J 3"]  # of joints, in world axes


def compute_shared_responses(
    tree: KinematicTree,
    terms: tuple[PointTerm, TrackingTerm, PosePriorTerm, JointLimitTerm],
    deformations: ShapeDeformations,
    squared_robust_scale: float,
    root: Float[np.ndarray, "T 3"],
    local: Float[np.ndarray, "T J 3 3"],
    *,
    only_errors: bool = False,
) -> SharedResponses:
    """Return the responses of frames at their solved poses, root in metres and local rotations.

    terms                 those of the pose problem
    squared_robust_scale  in units of the markers' standard deviation
    only_errors           compute of the responses only the last rows, from which `reduce_shared_gradient` takes the gradient
    """
    frames, joints = local.shape[:2]
    dense, markers = deformations.marker_offsets.shape[:2]
    rotating = np.flatnonzero(tree.free)[1:]
    unknowns = dense + 3 * markers + 3 * len(rotating)
    responses = SharedResponses(
        np.empty(frames),
        np.zeros((frames, markers)),
        np.empty((frames, dense, markers, 3)),
        np.empty((frames, unknowns + 1, markers, 3)),
        np.empty((frames, unknowns + 1, len(rotating), 3)),
        terms[2].information[0, rotating],
        np.empty((frames, unknowns, joints, 3)),
    )
    run_over_frames(
        eliminate_pose_frames, frames, tree, terms, deformations, rotating, squared_robust_scale, only_errors, root, local,
        *responses,
    )  # fmt: skip
    return responses


def reduce_shared_curvature(responses: SharedResponses) -> Float[np.ndarray, "Q Q"]:
    """Return the curvature of the cost in the shared unknowns, summed over frames."""
    dense, unknowns = responses.marker_shift.shape[1], responses.marker_response.shape[1] - 1
    curvature = _reduce_rows(responses, slice(0, unknowns), dense)
    curvature[dense:, :dense] = curvature[:dense, dense:].T
    return curvature


def reduce_shared_gradient(responses: SharedResponses) -> Float[np.ndarray, " Q"]:
    """Return the gradient of the cost in the shared unknowns, summed over frames."""
    return _reduce_rows(responses, slice(-1, None), 1)[0]


def _reduce_rows(responses: SharedResponses, rows: slice, deformed_rows: int) -> np.ndarray:
    """Return the products of some rows of the responses with the shifts of the body by each of the Q shared unknowns.

    The products with the deformations are computed for the first rows only: a curvature is symmetric.
    """
    (_, dense, markers), unknowns = responses.marker_shift.shape[:3], responses.marker_response.shape[1] - 1
    own = dense + 3 * markers  # first unknown after the markers' own offsets
    weighted = responses.marker_response[:, rows] * responses.marker_weight[:, None, :, None]
    products = np.zeros((weighted.shape[1], unknowns))
    products[:, dense:own] = weighted.sum(0).reshape(len(products), -1)
    prior = np.einsum("qfa,fab->qfb", responses.prior_response[:, rows].sum(0), responses.prior_information)
    products[:, own:] = -prior.reshape(len(products), -1)
    deformed = weighted[:, :deformed_rows]
    products[:deformed_rows, :dense] = np.tensordot(deformed, responses.marker_shift, axes=([0, 2, 3], [0, 2, 3]))
    return products
