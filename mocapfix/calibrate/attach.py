"""Which segment of a solved body a marker rides on: the one in whose axes it stays stillest, near a place where people wear one.

A marker on skin stays where it is seen from its own segment, while others turn away under it. Near a joint two segments serve
equally well, and in a take where a joint hardly turns so they do everywhere: there the place on the body decides, for markers
are stuck where markers of any known set are.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.marker_set import MarkerSet

KEPT = 0.9  # of a marker's frames: the others may be swaps, ghosts or poses that the solve got wrong
SKIN = 0.005  # metres per axis: so little a marker always strays, on the right segment too
OWN_SAY = 10.0  # poses: so many unlike ones a take has, however many frames
NEAR = 0.07  # metres: standard deviation of how far a marker is stuck from where the known sets have one on that segment
LOOSE = 0.025  # metres per axis: what strays by more from every segment rides on none
FAR = 0.15  # metres: what lies farther off all places for markers is held; unless its label tells the segment, as a wand's does
FEWEST, SHARE = 30, 0.3  # frames in which a marker must be seen, or of a short take the share of them


@dataclass(frozen=True)
class Attachment:
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
    places: np.ndarray
    strays: np.ndarray
    sure: np.ndarray
    second: np.ndarray
    likely: np.ndarray
    reasons: tuple[str, ...]


def attached(
    markers: np.ndarray, position: np.ndarray, rotation: np.ndarray, atlas: "Atlas", names: tuple[str, ...], told: np.ndarray
) -> Attachment:
    """-> the segment each marker rides on.

    markers   (N, M, 3) metres in N unlike frames, NaN where not seen
    position, rotation  (N, J, 3) metres and (N, J, 3, 3): the body's joints in the world
    atlas     where people wear markers on a body of that size
    names     J joints' names
    told      (M, J) what the labels say for each joint, log odds
    """
    candidates, each = np.unique(atlas.joints), np.arange(markers.shape[1])
    places, strays = still(markers, position[:, candidates], rotation[:, candidates])
    apart = np.stack([atlas.distance(int(j), places[c]) for c, j in enumerate(candidates)])
    likely = -1.5 * OWN_SAY * np.log(strays**2 + SKIN**2) - 0.5 * (apart / NEAR) ** 2 + told.T[candidates]
    order = (-np.nan_to_num(likely, nan=-np.inf)).argsort(0, kind="stable")
    best, second = order[0], order[1]
    count = (~np.isnan(markers[..., 0])).sum(0)
    fewest = min(FEWEST, SHARE * len(markers))
    off = np.where(told[each, candidates[best]] > 0, 0.0, apart[best, each])
    segments = [names[j] for j in candidates]
    reasons = [_unseen(int(count[m]), fewest) or _loose(strays[:, m], float(off[m]), best[m], segments) for m in each]
    sure = np.nan_to_num(1 / np.exp(likely - likely[best, each]).sum(0))
    joints = np.where([bool(reason) for reason in reasons], -1, candidates[best])
    return Attachment(
        joints, places[best, each], strays[best, each], sure, candidates[second], likely[best, each], tuple(reasons)
    )


def still(markers: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> where each of M markers is in the axes of each of C joints, the median (C, M, 3), and by how much it strays from there
    (C, M), root mean square per axis over the stillest frames; NaN where it is never seen."""
    each = (position.shape[1], markers.shape[1])
    places, strays = np.full((*each, 3), np.nan), np.full(each, np.nan)
    for m in range(markers.shape[1]):
        seen = ~np.isnan(markers[:, m, 0])
        if not seen.any():
            continue
        own = np.einsum("tcba,tcb->tca", rotation[seen], markers[seen, None, m] - position[seen])
        places[:, m] = np.median(own, axis=0)
        square = np.sort(((own - places[:, m]) ** 2).sum(-1), axis=0)[: max(1, round(KEPT * seen.sum()))]
        strays[:, m] = np.sqrt(square.mean(0) / 3)
    return places, strays


def _unseen(count: int, fewest: float) -> str:
    """-> why a marker that is seen in `count` frames is not judged, "" where it is."""
    if count >= max(fewest, 1):
        return ""
    return f"is seen in {count} of the frames looked at, too few to tell" if count else "is never seen"


def _loose(strays: np.ndarray, apart: float, best: int, names: list[str]) -> str:
    """-> why a marker rides on no segment, "" where it does.

    strays  (C,) metres per axis from C segments of these names, of which the likeliest is `best`
    apart   metres from the nearest place for markers on that one, 0 where the label tells the segment
    """
    if strays[best] > LOOSE:
        least = int(strays.argmin())
        return f"moves by {strays[least] * 1e3:.0f} mm against {names[least]} and by more against every other segment"
    if apart > FAR:
        return f"stays still against {names[best]}, but {apart * 1e3:.0f} mm off the body: it is held, or on a prop"
    return ""


@dataclass(frozen=True)
class Atlas:
    """Where people wear markers: A places in metres in their joints' axes, on a body of some size."""

    joints: np.ndarray
    places: np.ndarray

    def distance(self, joint: int, places: np.ndarray) -> np.ndarray:
        """-> (M,) metres from places (M, 3) in a joint's axes to the nearest one on it."""
        there = self.places[self.joints == joint]
        return np.linalg.norm(places[:, None] - there[None], axis=-1).min(1)

    def grown(self, size: float) -> "Atlas":
        """-> the atlas on a body so many times the size."""
        return Atlas(self.joints, self.places * size)


def atlas(sets: tuple[MarkerSet, ...]) -> Atlas:
    """-> all places of some sets, on the average body."""
    return Atlas(np.concatenate([each.joints for each in sets]), np.concatenate([each.places for each in sets]))
