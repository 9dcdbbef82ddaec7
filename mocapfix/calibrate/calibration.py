"""Which frames to calibrate from: well seen and unlike each other."""

from dataclasses import replace

import numpy as np

from mocapfix.calibrate import refinement
from mocapfix.errors import TakeError
from mocapfix.marker_sets import MarkerSet
from mocapfix.motion import Motion
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel, Skeleton
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.take import Take

# MERGED: mocapfix.calibrate.frames
MAX_CANDIDATE_FRAMES = 600  # frames looked at, evenly over the take: solving them all takes a fraction of a second
MAX_CALIBRATION_FRAMES = 150


def select_candidate_frames(markers: np.ndarray) -> np.ndarray:
    """-> indices of up to CANDIDATES frames, evenly over the take, of those that show the most markers.

    markers (T, K, 3), NaN where not believed. Well seen is within a tenth of the markers that the best frames show.
    """
    count = (~np.isnan(markers[..., 0])).sum(1)
    enough = np.flatnonzero(count >= 0.9 * np.percentile(count, 90))
    return enough[np.unique(np.linspace(0, len(enough) - 1, min(len(enough), MAX_CANDIDATE_FRAMES)).astype(int))]


def select_varied_poses(local_rotations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """-> indices of up to CHOSEN of the poses `rotations` (N, J, 3, 3): half the most unlike, half at random.

    The unlike ones by farthest-point selection in the chordal distance over the joints below the root.
    """
    flat = local_rotations[:, 1:].reshape(len(local_rotations), -1)
    if len(flat) <= MAX_CALIBRATION_FRAMES:
        return np.arange(len(flat))
    chosen = [int(np.linalg.norm(flat - flat.mean(0), axis=1).argmin())]
    nearest = np.full(len(flat), np.inf)
    while len(chosen) < MAX_CALIBRATION_FRAMES // 2:
        nearest = np.minimum(nearest, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
        nearest[chosen[-1]] = -1.0  # not again, though no other be any farther
        chosen.append(int(nearest.argmax()))
    rest = np.setdiff1d(np.arange(len(flat)), chosen)
    return np.sort(np.r_[chosen, rng.choice(rest, MAX_CALIBRATION_FRAMES - len(chosen), replace=False)])


# MERGED: mocapfix.calibrate.places
# New places for markers that were moved: where they lie on the body that the other markers show.
MIN_MOVED_MARKER_FRAMES = 10  # frames in which a place must be seen


def add_moved_markers(
    subject: Subject, motion: Motion, markers: np.ndarray, marker_indices: np.ndarray
) -> tuple[Subject, np.ndarray]:
    """-> the subject with one more marker for each new place, and which of the E were seen long enough to have one.

    A place is the median, in the joint's axes, of where the marker is seen; its spread stays its marker's.

    markers  (T, E, 3) metres, NaN where the marker is not at its new place
    which    (E,) the subject's marker that is there
    """
    position, rotation = kinematics.compute_world_poses(subject.skeleton, motion)
    enough = (~np.isnan(markers[..., 0])).sum(0) >= MIN_MOVED_MARKER_FRAMES
    marker_indices, joints = marker_indices[enough], subject.joints[marker_indices[enough]]
    apart = markers[:, enough] - position[:, joints]
    places = np.nanmedian(np.einsum("tkba,tkb->tka", rotation[:, joints], apart), axis=0).reshape(-1, 3)
    grown = replace(
        subject,
        labels=(*subject.labels, *(subject.labels[k] for k in marker_indices)),
        joints=np.r_[subject.joints, joints],
        marker_offsets=np.r_[subject.marker_offsets, places],
        marker_spread=np.r_[subject.marker_spread, subject.marker_spread[marker_indices]],
        marker_sd=np.r_[subject.marker_sd, subject.marker_sd[marker_indices]],
    )
    return grown, enough


# MERGED: mocapfix.calibrate.size
# How large the subject is, before anything else is known of them.
MIN_PAIR_DISTANCE_M = 0.12  # metres: nearer pairs say more of where the markers were stuck than of the body's size
MIN_SIZE_RATIO, MAX_SIZE_RATIO = 0.3, 1.6  # of the average body: a baby, and more than anybody
MAX_DISTANCE_VARIATION = 0.03  # a distance that varies by more than this share, over the take, spans a joint that bends


def estimate_body_size_ratio(skeleton: Skeleton, marker_set: MarkerSet, markers: np.ndarray) -> float:
    """-> the subject's size over the average body's, from distances that stay the same while the subject moves.

    Candidates are pairs of markers on one joint or on a joint and its parent (a knee and an ankle marker). The median
    over pairs, each pair's median over frames, within SMALLEST and LARGEST; 1 where no pair tells.

    markers  (T, K, 3) metres, NaN where not believed
    """
    nominal = compute_rest_marker_positions(skeleton, marker_set)
    ratios, weights = [], []
    for a in range(len(nominal)):
        for b in range(a):
            i, j = marker_set.joints[a], marker_set.joints[b]
            expected = np.linalg.norm(nominal[a] - nominal[b])
            if expected < MIN_PAIR_DISTANCE_M or not (i == j or skeleton.parents[i] == j or skeleton.parents[j] == i):
                continue
            distance = np.linalg.norm(markers[:, a] - markers[:, b], axis=-1)
            distance = distance[~np.isnan(distance)]
            if len(distance) < 10:
                continue
            middle = np.median(distance)
            if np.median(np.abs(distance - middle)) <= MAX_DISTANCE_VARIATION * middle:  # markers all at one point, too
                ratios.append(middle / expected)
                weights.append(expected)
    if not ratios:
        return 1.0
    order = np.argsort(ratios)
    halfway = np.searchsorted(np.cumsum(np.array(weights)[order]), 0.5 * np.sum(weights))
    return float(np.clip(np.array(ratios)[order][halfway], MIN_SIZE_RATIO, MAX_SIZE_RATIO))


def compute_rest_marker_positions(skeleton: Skeleton, marker_set: MarkerSet) -> np.ndarray:
    """-> (K, 3) metres: the markers in the rest pose."""
    return skeleton.rest_positions[marker_set.joints] + marker_set.marker_offsets


# MERGED: mocapfix.calibrate
# Calibration: this person's bones and marker places, from the take alone.
def calibrate_subject(take: Take, marker_set: MarkerSet, body: BodyModel, prior: MeanPosePrior) -> Subject:
    """-> bone lengths and marker places that, with each frame's own pose, explain the take best.

    worn  the take's markers in the marker set's order (K of them), NaN where not seen or not believed

    Raises TakeError where no frame shows three markers or more, or the markers lie as on no body that there is.
    """
    start, markers = scale_average_subject(take, marker_set, body), take.markers
    looked = select_candidate_frames(markers)
    motion = refinement.pose_frames(start, body, prior, markers[looked])
    chosen = select_varied_poses(motion.local_rotations, np.random.default_rng(0))
    found = refinement.refine_subject(start, body, prior, markers[looked[chosen]], motion.select_frames(chosen))
    check_size_ratio(take, found.skeleton.total_length_m / body.skeleton.total_length_m)
    return found


def scale_average_subject(take: Take, marker_set: MarkerSet, body: BodyModel) -> Subject:
    """-> the average body at the size that the take tells, from where `subject` sets out; raises as it does."""
    if not ((~np.isnan(take.markers[..., 0])).sum(1) >= 3).any():
        raise TakeError(f"{take.name}: no frame shows three markers of the body; there is nothing to calibrate from.")
    ratio = estimate_body_size_ratio(body.skeleton, marker_set, take.markers)
    check_size_ratio(take, ratio)
    places = marker_set.marker_offsets * ratio
    whole = scale_skeleton(body.skeleton, ratio)
    return Subject(whole, marker_set.name, marker_set.labels, marker_set.joints, places, marker_set.marker_spread)


def check_size_ratio(take: Take, ratio: float) -> None:
    """Raise TakeError where nobody is so many times the size of the average body."""
    if not MIN_SIZE_RATIO < ratio < MAX_SIZE_RATIO:
        apart = "near together" if ratio < 1 else "far apart"
        raise TakeError(f"{take.name}: the markers lie too {apart} for a person's; are the file's unit and the labels right?")


def scale_skeleton(skeleton: Skeleton, factor: float) -> Skeleton:
    """-> the skeleton with every length times `factor`."""
    return replace(skeleton, offsets=skeleton.offsets * factor, ends=skeleton.ends * factor)
