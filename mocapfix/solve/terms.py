"""The terms of a cost: what poses can be asked to agree with, each half a sum of squares in standard deviations.

- `points`: markers and joints at their places (`PointTerm`), in images (`ReprojectionTerm`), at distances (`DistanceTerm`)
- `segments`: directions of bones (`DirectionTerm`) and orientations in the world (`OrientationTerm`)
- `joints`: smooth trajectories (`TrackingTerm`), the mean pose (`PosePriorTerm`), joint limits (`JointLimitTerm`)
- `whole poses`: a trained model with a latent code (`model_terms.PoseModelTerm`)

Their classes are those of the kernels, which evaluate them; the functions here build those of a body.
"""

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.forward_kinematics import KinematicTree as KinematicTree
from mocapfix.kernels.terms import DirectionTerm as DirectionTerm
from mocapfix.kernels.terms import DistanceTerm as DistanceTerm
from mocapfix.kernels.terms import JointLimitTerm, PointTerm, PosePriorTerm, TrackingTerm
from mocapfix.kernels.terms import OrientationTerm as OrientationTerm
from mocapfix.kernels.terms import ReprojectionTerm as ReprojectionTerm
from mocapfix.kernels.terms import normalise_pixels as normalise_pixels
from mocapfix.options import SolveOptions
from mocapfix.solve.mean_pose import JointLimits, MeanPosePrior


class MarkerAttachment(NamedTuple):
    """The markers' joints and their positions in the joints' axes."""

    joints: Int[np.ndarray, " K"]
    offsets: Float[np.ndarray, "K 3"]  # metres


class ShapeDeformations(NamedTuple):
    """Changes of the body by P shared unknowns, in metres per unit."""

    joint_offsets: Float[np.ndarray, "P J 3"]  # of a joint in its parent's axes
    marker_offsets: Float[np.ndarray, "P K 3"]  # of a marker in its joint's axes


BodyTerms: TypeAlias = tuple[PointTerm, TrackingTerm, PosePriorTerm, JointLimitTerm]
"""The terms of a body's pose; a tuple, since the kernels are compiled for the classes in it."""


def build_marker_term(
    attachment: MarkerAttachment,
    positions: Float[np.ndarray, "T K 3"],
    is_used: Bool[np.ndarray, "T K"],
    sd_m: float | Float[np.ndarray, " K"],
) -> PointTerm:
    """Return markers as a term. Arrays in another order of memory would be other types and compile the solver again."""
    measured = np.ascontiguousarray(np.where(is_used[..., None], positions, 0.0))
    return PointTerm(attachment.joints, attachment.offsets, measured, np.ascontiguousarray(is_used / sd_m**2))


def build_no_tracking(joints: int) -> TrackingTerm:
    """Return a tracking term of weight zero."""
    return TrackingTerm(np.zeros((1, joints, 3, 3)), np.zeros((1, joints)), np.zeros((1, 3)), np.zeros(1))


def build_no_pose_prior(joints: int) -> PosePriorTerm:
    """Return a prior without information."""
    rotations, information = np.zeros((2, 1, joints, 3, 3))
    return PosePriorTerm(rotations, information)


def build_pose_prior_term(prior: MeanPosePrior, huber_scale_sd: float = math.inf) -> PosePriorTerm:
    """Return a prior as a term of every frame; `huber_scale_sd` bounds its force on a joint, in standard deviations."""
    return PosePriorTerm(prior.mean_rotations[None], prior.information[None], huber_scale2=huber_scale_sd**2)


JOINT_LIMIT_SD_RAD = SolveOptions().limit_sd_rad
"""Standard deviation of a joint's excess over its limits, where the options of a take do not apply."""


def build_joint_limit_term(limits: JointLimits, sd_rad: float = JOINT_LIMIT_SD_RAD) -> JointLimitTerm:
    """Return joint limits as soft limits: the standard deviation of an excess is `sd_rad`."""
    return JointLimitTerm(limits.mean_rotations, limits.lower_rad, limits.upper_rad, sd_rad**-2)


def build_no_joint_limits(joints: int) -> JointLimitTerm:
    """Return infinite joint limits."""
    return JointLimitTerm(np.zeros((joints, 3, 3)), np.full((joints, 3), -np.inf), np.full((joints, 3), np.inf), 0.0)


def compute_robust_costs(square: Float[np.ndarray, "*shape"], scale2: float) -> Float[np.ndarray, "*shape"]:
    """Return the costs of points (Geman & McClure 1987), from their squared distances; `scale2` is the squared scale."""
    return 0.5 * square * scale2 / (scale2 + square)


def compute_robust_weights(square: Float[np.ndarray, "*shape"], scale2: float) -> Float[np.ndarray, "*shape"]:
    """Return the factors of the weights of points that correspond to `compute_robust_costs`."""
    return (scale2 / (scale2 + square)) ** 2
