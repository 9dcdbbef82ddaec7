"""The terms of the pose solve, one file each; the solver is given a tuple of them.

points        places of markers and joints
directions    directions of bones
orientations  orientations of bodies
views         points seen by cameras
targets       joint rotations to be near to, about some axes more than about others: a mean pose
courses       joint rotations and a root to be near to: a course through time, a start
limits        how far joints turn
latent        joint rotations that a decoder makes of a code
distances     distances between points, also of different bodies
whole         any one number that depends on all joints
"""

from mocapfix.kernels.terms.contract import GEMAN_MCCLURE, HUBER
from mocapfix.kernels.terms.coupling import DistanceTerm, ScalarTerm
from mocapfix.kernels.terms.joint_rotations import JointLimitTerm, PosePriorTerm, TrackingTerm
from mocapfix.kernels.terms.latent_code import LatentCodeTerm
from mocapfix.kernels.terms.orientations import DirectionTerm, OrientationTerm
from mocapfix.kernels.terms.points import PointTerm
from mocapfix.kernels.terms.reprojection import ReprojectionTerm, normalise_pixels

__all__ = [
    "DirectionTerm",
    "DistanceTerm",
    "GEMAN_MCCLURE",
    "HUBER",
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


def count_rows(terms: tuple) -> int | None:
    """-> how many rows these terms write, as `solve_frames` and `uncertainties` must be told; None for none."""
    writing = [term for term in terms if isinstance(term, DistanceTerm | ScalarTerm)]
    return sum(len(term.joints) if isinstance(term, DistanceTerm) else 1 for term in writing) if writing else None
