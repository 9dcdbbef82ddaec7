"""What a frame's pose may be, and the course through the frames that is likeliest.

One image does not tell whether a knee comes towards the camera or goes away, nor always which way somebody faces. So each
frame is solved from the middle pose turned to several headings; of what comes out, each frame takes one so that the cost of
the poses and of the way from each to the next is least (Viterbi, 1967).
"""

import numpy as np
from scipy.spatial.transform import Rotation

HEADING_COUNT = 6
JOINT_SPEED_SD_M_S = 1.0  # metres a second: how fast a joint goes, seen from the root (standard deviation per axis)
POSE_DOF = 12  # of how many independent numbers a step between poses is: the joints do not move one by one


def rotate_to_headings(mean_pose: np.ndarray) -> np.ndarray:
    """-> (H, J, 3, 3) local rotations: the middle pose (J, 3, 3), facing the camera and round in equal steps."""
    poses = np.tile(mean_pose, (HEADING_COUNT, 1, 1, 1))
    poses[:, 0] = (
        Rotation.from_euler("y", 2 * np.pi / HEADING_COUNT * np.arange(HEADING_COUNT)[:, None]).as_matrix() @ mean_pose[0]
    )
    return poses


def compute_transition_costs(joints: np.ndarray, rate: float) -> np.ndarray:
    """-> (T - 1, H, H) what it costs to go from each guess of a frame to each of the next.

    joints  (T, H, J, 3) metres
    """
    seen = joints - joints[:, :, :1]
    square = ((seen[:-1, :, None] - seen[1:, None]) ** 2).sum(-1).mean(-1)
    return 0.5 * POSE_DOF / 3 * square / (JOINT_SPEED_SD_M_S / rate) ** 2


def find_cheapest_path(cost: np.ndarray, step: np.ndarray) -> np.ndarray:
    """-> (T,) which guess each frame takes, so that the sum of costs (T, H) and of steps (T - 1, H, H) is least."""
    total, came = cost[0], np.zeros(cost.shape, int)
    for t in range(1, len(cost)):
        way = total[:, None] + step[t - 1]
        came[t] = way.argmin(axis=0)
        total = way.min(axis=0) + cost[t]
    path = np.empty(len(cost), int)
    path[-1] = total.argmin()
    for t in range(len(cost) - 1, 0, -1):
        path[t - 1] = came[t, path[t]]
    return path
