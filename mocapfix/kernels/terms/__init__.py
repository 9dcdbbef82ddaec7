"""The terms of the pose solve; the solver takes a tuple of them.

- `observations`: measured positions, directions and orientations of bodies, points in camera images
- `constraints`: tracking of a pose, a prior about a mean pose, joint limits, distances between points, a function of all joints
- `latent_code`: joint rotations decoded from a latent code
- `contract`: the interface of a term, and the robust losses
"""

from mocapfix.kernels.terms.constraints import DistanceTerm, JointLimitTerm, PosePriorTerm, ScalarTerm, TrackingTerm, count_rows
from mocapfix.kernels.terms.contract import GEMAN_MCCLURE, HUBER
from mocapfix.kernels.terms.latent_code import LatentCodeTerm
from mocapfix.kernels.terms.observations import DirectionTerm, OrientationTerm, PointTerm, ReprojectionTerm, normalise_pixels

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
