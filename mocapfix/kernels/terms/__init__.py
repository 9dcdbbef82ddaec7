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

from mocapfix.kernels.terms.courses import Courses
from mocapfix.kernels.terms.directions import Directions
from mocapfix.kernels.terms.distances import Distances
from mocapfix.kernels.terms.latent import Latent
from mocapfix.kernels.terms.limits import Limits
from mocapfix.kernels.terms.orientations import Orientations
from mocapfix.kernels.terms.points import Points
from mocapfix.kernels.terms.robust import GEMAN_MCCLURE, HUBER
from mocapfix.kernels.terms.targets import Targets
from mocapfix.kernels.terms.views import Views, normalised
from mocapfix.kernels.terms.whole import Whole

__all__ = [
    "GEMAN_MCCLURE",
    "HUBER",
    "Courses",
    "Directions",
    "Distances",
    "Latent",
    "Limits",
    "Orientations",
    "Points",
    "Targets",
    "Views",
    "Whole",
    "normalised",
    "rows_of",
]


def rows_of(terms: tuple) -> int | None:
    """-> how many rows these terms write, as `solve_frames` and `uncertainties` must be told; None for none."""
    writing = [term for term in terms if isinstance(term, Distances | Whole)]
    return sum(len(term.joints) if isinstance(term, Distances) else 1 for term in writing) if writing else None
