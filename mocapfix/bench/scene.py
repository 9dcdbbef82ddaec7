"""One frame with everything SCOPE measures on a body: 3-D keypoints, 2-D keypoints, part orientations, and shape parameters.

SCOPE (section 3.3, Eqs. 1-7): a joint lies in its parent's axes at S_j beta + l_j. All is linearised about beta = 0.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.pose import Pose, Tree, forward
from mocapfix.kernels.terms import Courses, Directions, Points, Views

DAMPING = 1e-9  # what both directions add to every unknown's curvature, so that none is open


class Scene(NamedTuple):
    """A body in a pose, its world joints written, and what is measured of it."""

    tree: Tree
    points: Points
    views: Views
    directions: Directions
    pull: Courses
    pose: Pose

    @property
    def terms(self) -> tuple[Points, Views, Directions, Courses]:
        return self.points, self.views, self.directions, self.pull

    @property
    def numbers(self) -> int:
        """How many numbers are measured: rows of a Jacobian."""
        return 3 * len(self.points.joints) + 2 * len(self.views.joints) + 3 * len(self.directions.joints)


def placed(tree: Tree, root: np.ndarray, local: np.ndarray) -> Pose:
    """-> the pose root (3,), local (J, 3, 3), its joints where it puts them."""
    pose = Pose(root, local, np.zeros(len(tree.shape)), np.empty((len(local), 3)), np.empty(local.shape))
    forward(tree, pose)
    return pose


def no_views() -> Views:
    """-> what no camera sees."""
    none = np.zeros(0, int)
    return Views(
        none, np.zeros((0, 3)), none, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, bool), np.zeros((1, 0, 2)),
        np.zeros((1, 0)),
    )  # fmt: skip


def no_directions() -> Directions:
    """-> no bone's direction."""
    return Directions(np.zeros(0, int), np.zeros((0, 3)), np.zeros((1, 0, 3)), np.zeros((1, 0)))
