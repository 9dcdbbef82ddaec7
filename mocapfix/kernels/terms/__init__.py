"""The terms of the pose solve; the solver takes a tuple of them.

points           measured positions of markers and joints
orientations     measured directions of bones and orientations of bodies
reprojection     points in camera images
joint_rotations  tracking of a pose, a prior about a mean pose, joint limits
latent_code      joint rotations decoded from a latent code
coupling         distances between points, also of different bodies, and a scalar function of all joints
contract         the interface of a term, and the robust losses
"""

from mocapfix.kernels.terms.contract import GEMAN_MCCLURE, HUBER
from mocapfix.kernels.terms.coupling import DistanceTerm, ScalarTerm, count_rows
from mocapfix.kernels.terms.joint_rotations import JointLimitTerm, PosePriorTerm, TrackingTerm
from mocapfix.kernels.terms.latent_code import LatentCodeTerm
from mocapfix.kernels.terms.orientations import DirectionTerm, OrientationTerm
from mocapfix.kernels.terms.points import PointTerm, ReprojectionTerm, normalise_pixels

__all__ = [
    "GEMAN_MCCLURE",
    "HUBER",
    "DirectionTerm",
    "DistanceTerm",
    "JointLimitTerm",
    "LatentCodeTerm",
    "OrientationTerm",
    "PointTerm",
    "PosePriorTerm",
    "ReprojectionTerm",
    "ScalarTerm",
    "TrackingTerm",
    "count_rows",
    "normalise_pixels",
]
