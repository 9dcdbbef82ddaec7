"""The search for limbs whose labels were lost: where all trajectories of an arm break at once, nothing shows where it went.

In a frame with unlabelled trajectories and markers without one, the limb is placed in the poses that it has in other frames of
the take. Points and markers are assigned and the pose is solved in turns, as in `body_search`, with all other labels kept.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.labelling.posed_body import POSING_ITERATIONS, POSING_MARKER_SD_M, PropagatedLabels
from mocapfix.labelling.sampled_points import SampledPoints
from mocapfix.labelling.tracklet_assignment import assign_points
from mocapfix.skeleton import BODY_SECTIONS
from mocapfix.solve.kinematics import Poses
from mocapfix.stats.sequences import sample_evenly

MIN_LOST_MARKERS = 2
"""Markers without a trajectory, and unlabelled trajectories, with which a limb is searched for."""
MAX_LIMB_POSES = 24
"""Poses of other frames that are tried."""
LIMB_GATES_M = (0.35, 0.08)
"""Distance at which a marker counts as not found, in the first and in the last round."""
LIMB_SEARCH_ROUNDS = 8
"""Rounds of assignment and solve."""


def find_limb_frame(sampled: SampledPoints, labels: PropagatedLabels, is_lost: Bool[np.ndarray, " N"]) -> int:
    """Return the frame with the most markers that may be among its unlabelled trajectories, -1 if there is none."""
    lost = np.append(is_lost, False)[sampled.tracklets].sum(1)
    marker_count = len(np.unique(labels.markers[labels.markers >= 0]))
    missing = marker_count - (np.append(labels.markers, -1)[sampled.tracklets] >= 0).sum(1)
    possible = np.where(labels.is_posed, np.minimum(lost, missing), 0)
    return int(possible.argmax()) if possible.max(initial=0) >= MIN_LOST_MARKERS else -1


def search_limb(
    sampled: SampledPoints, labels: PropagatedLabels, frame: int, is_candidate: Bool[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """Return the markers of the tracklets with those that the best pose of the lost limbs gives in one frame."""
    tracklets, body = sampled.tracklets[frame], labels.body
    own = np.append(labels.markers, -1)[tracklets]
    missing = np.setdiff1d(np.unique(labels.markers[labels.markers >= 0]), own)
    free = np.flatnonzero((tracklets >= 0) & (own < 0) & np.append(is_candidate, False)[tracklets])
    poses = place_limbs(sampled, labels, frame, missing)
    markers = np.tile(
        sampled.select_frames(np.array([frame])).arrange_markers(labels.markers, len(body.subject.joints)), (len(poses[0]), 1, 1)
    )
    assigned = np.full((len(poses[0]), len(free)), -1)
    for gate in np.geomspace(*LIMB_GATES_M, LIMB_SEARCH_ROUNDS):
        predicted = body.predict(poses)[:, missing]
        markers[:, missing] = np.nan
        for h, positions in enumerate(predicted):
            squared = ((sampled.positions[frame, free][:, None] - positions) ** 2).sum(-1)
            assigned[h] = assign_points(squared, float(gate))[0]
            is_found = assigned[h] >= 0
            markers[h, missing[assigned[h, is_found]]] = sampled.positions[frame, free[is_found]]
        body.solve(poses, markers, POSING_MARKER_SD_M, (float(gate),), POSING_ITERATIONS)
    costs = body.compute_costs(poses, markers, POSING_MARKER_SD_M, LIMB_GATES_M[1])
    missing_cost = 0.5 * (LIMB_GATES_M[1] / POSING_MARKER_SD_M) ** 2
    best = int(np.argmin(costs - missing_cost * (assigned >= 0).sum(1)))
    found = labels.markers.copy()
    is_found = assigned[best] >= 0
    found[tracklets[free[is_found]]] = missing[assigned[best, is_found]]
    return found


def place_limbs(sampled: SampledPoints, labels: PropagatedLabels, frame: int, missing: Int[np.ndarray, " L"]) -> Poses:
    """Return poses of a frame in which the limbs of the missing markers have the poses of other frames."""
    names = labels.body.subject.skeleton.names
    lost = {names[labels.body.subject.joints[marker]] for marker in missing}
    joints = [names.index(name) for section in BODY_SECTIONS.values() if lost.intersection(section) for name in section]
    joints = [joint for joint in joints if joint > 0]
    shown: Float[np.ndarray, " S"] = np.isin(np.append(labels.markers, -1)[sampled.tracklets], missing).sum(1).astype(float)
    donors = np.flatnonzero(labels.is_posed & (shown == shown[labels.is_posed].max()))
    donors = donors[sample_evenly(len(donors), MAX_LIMB_POSES)]
    root, local = np.tile(labels.poses[0][frame], (len(donors), 1)), np.tile(labels.poses[1][frame], (len(donors), 1, 1, 1))
    local[:, joints] = labels.poses[1][donors][:, joints]
    return root, local
