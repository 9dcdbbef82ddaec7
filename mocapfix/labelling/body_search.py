"""The search for a body in single frames of unlabelled points: poses whose markers lie where the points are.

A body is placed in many headings and arm positions. Points and markers are assigned one-to-one, and the pose is solved with this
assignment, in turns (iterative closest points; Besl & McKay 1992), with a gate that narrows. The most likely poses are kept.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.labelling.posed_body import PosedBody, scale_subject
from mocapfix.labelling.tracklet_assignment import assign_points
from mocapfix.solve.kinematics import Poses

TRIED_HEADING_COUNT = 12
"""Headings in which a body is placed."""
ARM_RAISES = (0.0, 0.5, 1.0)
"""Arm positions in which a body is placed: 0 hanging, 1 as in a T-pose."""
SEARCH_GATES_M = (0.4, 0.1)
"""Distance at which a marker counts as not found, in the first and in the last round."""
SEARCH_ROUNDS = 12
"""Rounds of assignment and solve."""
PRUNING_ROUND = 5
"""Round after which only the best poses are continued."""
MAX_CONTINUED_POSES = 12
"""Poses that are continued."""
SEARCH_ITERATIONS = 4
"""Solver iterations in a round."""
SEARCH_MARKER_SD_M = 0.04
"""Standard deviation of a person's markers about those of the average body."""


class FoundBody(NamedTuple):
    """A pose in one frame: the marker (V,) of each of its points, -1 for none, and the cost."""

    markers: Int[np.ndarray, " V"]
    cost: float


def search_body(positions: Float[np.ndarray, "V 3"], body: PosedBody) -> list[FoundBody]:
    """Return the poses found for the points of one frame, in metres, by rising cost. Poses with the same assignment are one."""
    poses = place_bodies(positions, body)
    found: list[FoundBody] = []
    for number, gate in enumerate(np.geomspace(*SEARCH_GATES_M, SEARCH_ROUNDS)):
        predicted = body.predict(poses)
        squared = ((positions[:, None] - predicted[:, None]) ** 2).sum(-1)
        assigned = [assign_points(each, float(gate)) for each in squared]
        found = [FoundBody(*each) for each in assigned]
        if number == PRUNING_ROUND:
            kept = np.argsort([each.cost for each in found], kind="stable")[:MAX_CONTINUED_POSES]
            poses, found = (poses[0][kept], poses[1][kept]), [found[h] for h in kept]
        markers = _arrange_found(positions, found, predicted.shape[1])
        body.solve(poses, markers, SEARCH_MARKER_SD_M, (float(gate),), SEARCH_ITERATIONS)
    markers = _arrange_found(positions, found, len(body.subject.joints))
    costs = body.compute_costs(poses, markers, SEARCH_MARKER_SD_M, SEARCH_GATES_M[1])
    missing_cost = 0.5 * (SEARCH_GATES_M[1] / SEARCH_MARKER_SD_M) ** 2
    possible = min(len(positions), len(body.subject.joints))
    totals = [
        float(cost + missing_cost * (possible - (each.markers >= 0).sum())) for cost, each in zip(costs, found, strict=True)
    ]
    best: dict[bytes, FoundBody] = {}
    for h in np.argsort(totals, kind="stable"):
        best.setdefault(found[h].markers.tobytes(), FoundBody(found[h].markers, totals[h]))
    return list(best.values())


def place_bodies(positions: Float[np.ndarray, "V 3"], body: PosedBody) -> Poses:
    """Return poses (H) of a body that stands where the points are, in all headings and arm positions."""
    headings = Rotation.from_euler("y", np.linspace(0, 2 * np.pi, TRIED_HEADING_COUNT, endpoint=False)[:, None]).as_matrix()
    raised = [raise_arms_to(body, share) for share in ARM_RAISES]
    local_rotations = np.concatenate([np.tile(pose, (TRIED_HEADING_COUNT, 1, 1, 1)) for pose in raised])
    local_rotations[:, 0] = np.tile(headings, (len(raised), 1, 1)) @ local_rotations[:, 0]
    predicted = body.predict((np.zeros((len(local_rotations), 3)), local_rotations))
    root_position = np.median(positions, axis=0) - np.median(predicted, axis=1)
    return root_position, local_rotations


def raise_arms_to(body: PosedBody, share: float) -> Float[np.ndarray, "J 3 3"]:
    """Return the mean pose with the arms between hanging (share 0) and a T-pose (share 1)."""
    raised, skeleton = body.prior.mean_rotations.copy(), body.subject.skeleton
    for side in ("Left", "Right"):
        for bone in ("Shoulder", "Arm", "ForeArm"):
            j = skeleton.find_joint(side + bone)
            raised[j] = Rotation.from_rotvec((1 - share) * Rotation.from_matrix(raised[j]).as_rotvec()).as_matrix()
    return raised


def fit_height(body: PosedBody, height_m: float) -> PosedBody:
    """Return a body whose markers in the mean pose have this height, in metres."""
    mean_pose = np.zeros((1, 3)), body.prior.mean_rotations[None].copy()
    return body.change_subject(scale_subject(body.subject, height_m / float(np.ptp(body.predict(mean_pose)[0, :, 1]))))


def _arrange_found(positions: Float[np.ndarray, "V 3"], found: list[FoundBody], marker_count: int) -> Float[np.ndarray, "H K 3"]:
    markers = np.full((len(found), marker_count, 3), np.nan)
    for h, each in enumerate(found):
        is_assigned: Bool[np.ndarray, " V"] = each.markers >= 0
        markers[h, each.markers[is_assigned]] = positions[is_assigned]
    return markers
