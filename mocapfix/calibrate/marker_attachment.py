"""Which segment of a solved body a marker rides on: the one in whose axes it stays stillest, near a place where people wear one.

A marker on skin stays where it is seen from its own segment, while others turn away under it. Near a joint two segments serve
equally well, and in a take where a joint hardly turns so they do everywhere: there the place on the body decides, for markers
are stuck where markers of any known set are.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.marker_sets import MarkerSet

KEPT_FRAME_SHARE = 0.9  # of a marker's frames: the others may be swaps, ghosts or poses that the solve got wrong
MIN_SKIN_MOTION_M = 0.005  # metres per axis: so little a marker always strays, on the right segment too
INDEPENDENT_POSE_COUNT = 10.0  # poses: so many unlike ones a take has, however many frames
ATLAS_DISTANCE_SD_M = (
    0.07  # metres: standard deviation of how far a marker is stuck from where the known sets have one on that segment
)
MAX_ATTACHED_SD_M = 0.025  # metres per axis: what strays by more from every segment rides on none
MAX_ATLAS_DISTANCE_M = (
    0.15  # metres: what lies farther off all places for markers is held; unless its label tells the segment, as a wand's does
)
MIN_ATTACHMENT_FRAMES, MIN_ATTACHMENT_FRAME_SHARE = (
    30,
    0.3,
)  # frames in which a marker must be seen, or of a short take the share of them


@dataclass(frozen=True)
class AttachedMarkers:
    """Where each of M markers rides.

    joints  (M,) index of the joint, -1 on none
    places  (M, 3) metres in the joint's axes, of the stillest joint where it rides on none
    strays  (M,) metres per axis: by how much it strays from that place
    sure    (M,) how likely that joint is, of all
    second  (M,) the next likeliest joint
    likely  (M,) log likelihood of the joint, but for a constant; NaN where the marker is never seen
    reasons  M sentences' ends on why a marker rides on none, "" where it rides on one
    """

    joints: np.ndarray
    offsets: np.ndarray
    residual_sd: np.ndarray
    probability: np.ndarray
    second_joints: np.ndarray
    log_likelihood: np.ndarray
    rejection_reasons: tuple[str, ...]


def attach_markers(
    markers: np.ndarray,
    joint_positions: np.ndarray,
    joint_rotations: np.ndarray,
    atlas: "MarkerAtlas",
    joint_names: tuple[str, ...],
    label_log_odds: np.ndarray,
) -> AttachedMarkers:
    """-> the segment each marker rides on.

    markers   (N, M, 3) metres in N unlike frames, NaN where not seen
    position, rotation  (N, J, 3) metres and (N, J, 3, 3): the body's joints in the world
    atlas     where people wear markers on a body of that size
    names     J joints' names
    told      (M, J) what the labels say for each joint, log odds
    """
    candidates, each = np.unique(atlas.joints), np.arange(markers.shape[1])
    places, strays = measure_marker_offsets(markers, joint_positions[:, candidates], joint_rotations[:, candidates])
    apart = np.stack([atlas.compute_distances(int(j), places[c]) for c, j in enumerate(candidates)])
    likely = (
        -1.5 * INDEPENDENT_POSE_COUNT * np.log(strays**2 + MIN_SKIN_MOTION_M**2)
        - 0.5 * (apart / ATLAS_DISTANCE_SD_M) ** 2
        + label_log_odds.T[candidates]
    )
    order = (-np.nan_to_num(likely, nan=-np.inf)).argsort(0, kind="stable")
    best, second = order[0], order[1]
    count = (~np.isnan(markers[..., 0])).sum(0)
    fewest = min(MIN_ATTACHMENT_FRAMES, MIN_ATTACHMENT_FRAME_SHARE * len(markers))
    off = np.where(label_log_odds[each, candidates[best]] > 0, 0.0, apart[best, each])
    segments = [joint_names[j] for j in candidates]
    reasons = [
        _explain_too_few_frames(int(count[m]), fewest) or _explain_no_segment(strays[:, m], float(off[m]), best[m], segments)
        for m in each
    ]
    sure = np.nan_to_num(1 / np.exp(likely - likely[best, each]).sum(0))
    joints = np.where([bool(reason) for reason in reasons], -1, candidates[best])
    return AttachedMarkers(
        joints, places[best, each], strays[best, each], sure, candidates[second], likely[best, each], tuple(reasons)
    )


def measure_marker_offsets(
    markers: np.ndarray, joint_positions: np.ndarray, joint_rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """-> where each of M markers is in the axes of each of C joints, the median (C, M, 3), and by how much it strays from there
    (C, M), root mean square per axis over the stillest frames; NaN where it is never seen."""
    each = (joint_positions.shape[1], markers.shape[1])
    places, strays = np.full((*each, 3), np.nan), np.full(each, np.nan)
    for m in range(markers.shape[1]):
        seen = ~np.isnan(markers[:, m, 0])
        if not seen.any():
            continue
        own = np.einsum("tcba,tcb->tca", joint_rotations[seen], markers[seen, None, m] - joint_positions[seen])
        places[:, m] = np.median(own, axis=0)
        square = np.sort(((own - places[:, m]) ** 2).sum(-1), axis=0)[: max(1, round(KEPT_FRAME_SHARE * seen.sum()))]
        strays[:, m] = np.sqrt(square.mean(0) / 3)
    return places, strays


def _explain_too_few_frames(frame_count: int, min_frames: float) -> str:
    """-> why a marker that is seen in `count` frames is not judged, "" where it is."""
    if frame_count >= max(min_frames, 1):
        return ""
    return f"is seen in {frame_count} of the frames looked at, too few to tell" if frame_count else "is never seen"


def _explain_no_segment(residual_sd: np.ndarray, atlas_distance: float, best: int, joint_names: list[str]) -> str:
    """-> why a marker rides on no segment, "" where it does.

    strays  (C,) metres per axis from C segments of these names, of which the likeliest is `best`
    apart   metres from the nearest place for markers on that one, 0 where the label tells the segment
    """
    if residual_sd[best] > MAX_ATTACHED_SD_M:
        least = int(residual_sd.argmin())
        return f"moves by {residual_sd[least] * 1e3:.0f} mm against {joint_names[least]} and by more against every other segment"
    if atlas_distance > MAX_ATLAS_DISTANCE_M:
        return (
            f"stays still against {joint_names[best]}, but {atlas_distance * 1e3:.0f} mm off the body: it is held, or on a prop"
        )
    return ""


@dataclass(frozen=True)
class MarkerAtlas:
    """Where people wear markers: A places in metres in their joints' axes, on a body of some size."""

    joints: np.ndarray
    offsets: np.ndarray

    def compute_distances(self, joint: int, places: np.ndarray) -> np.ndarray:
        """-> (M,) metres from places (M, 3) in a joint's axes to the nearest one on it."""
        there = self.offsets[self.joints == joint]
        return np.linalg.norm(places[:, None] - there[None], axis=-1).min(1)

    def scale(self, size: float) -> "MarkerAtlas":
        """-> the atlas on a body so many times the size."""
        return MarkerAtlas(self.joints, self.offsets * size)


def build_marker_atlas(marker_sets: tuple[MarkerSet, ...]) -> MarkerAtlas:
    """-> all places of some sets, on the average body."""
    return MarkerAtlas(
        np.concatenate([each.joints for each in marker_sets]), np.concatenate([each.marker_offsets for each in marker_sets])
    )
