"""Filling from the rest of the body: what the take shows of the missing markers at moments alike, and at those around.

A Gaussian over the whole marker set, given the markers seen (Gloersen & Federolf 2016, "Predicting missing marker trajectories
in human motion data using marker intercorrelations", PLoS ONE 11), as a process over the take's moments, which knows time and
what comes again, too (see `kernels.process`). Places are those in the axes that the whole marker set makes, trunk first. How
sure it is, it has tried: stretches as long as the gap are struck out elsewhere, and what it misses there it will miss here.

The numbers of the likeness make the smallest error on lost limbs of captures and of CMU's training subjects.
"""

import numpy as np

from mocapfix.kernels.gaps import chosen, together
from mocapfix.kernels.process import Likeness, Process, learnt
from mocapfix.kernels.rigid import inside
from mocapfix.kernels.trunk import aligned

WORTH = 0.01  # metres: a gap that is known better all through is no matter for so wide a view
TELLS = 0.03  # metres: what another way has filled so surely tells of others as though it were seen
RARE = 0.05  # a marker seen in a smaller part of the frames is hardly known
FEWEST, ASKED = 8, 4  # moments to learn from, and markers told, without which there is nothing to go by
ENOUGH = 0.5  # of the moments that show what is lost: with fewer left to learn from, a marker told is no help
PIECE = 0.1  # seconds: no shorter piece of a gap is asked by itself
EACH = 36  # markers that say together what the units below are made for
MOMENT = 0.067  # seconds before and after, over which speeds are measured
PLACED, MOVING = 0.9, 20.0  # metres, metres a second: the differences that count as one, all markers taken together
UPRIGHT, HEIGHT = 0.5, 0.5  # likewise of the up vector; metres
SPEED, SPIN = 5.0, 20.0  # metres a second, radians a second, of the trunk
LIKENESS = Likeness(smooth=0.25, like=1.2, time=0.02, again=2.0, together=1.2, noise=3e-5)
TREMBLE = 0.001  # metres: what a single sample cannot tell


def recalled(markers: np.ndarray, others: np.ndarray, sure: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, M, 3) in metres at missing samples, NaN elsewhere, and their standard deviation per axis (T, M).

    NaN where other ways know enough, and where too little is seen all through a gap.

    markers  (T, M, 3) metres, Y up, NaN where not believed; rate in Hz
    others   (T, M, 3) what other ways say of the missing samples, and `sure` (T, M) their deviation, NaN where they say nothing
    """
    seen = ~np.isnan(markers[..., 0])
    filled, deviation = np.full(markers.shape, np.nan), np.full(seen.shape, np.nan)
    common = seen.sum(0) > RARE * len(seen)
    gaps = {gap: poor for gap, lost in together(~seen & common).items() if len(poor := unsure(sure, *gap, lost))}
    if not gaps:
        return filled, deviation
    known = common & (seen | (sure < TELLS))
    turn, origin, placed = aligned(np.where(known[..., None], np.where(seen[..., None], markers, others), np.nan))
    own = inside(np.where(seen[..., None], markers, others), origin, turn)
    asked = list(gaps.items())
    while asked:
        (first, last), lost = asked.pop()
        shown = placed & seen[:, lost].all(1)
        told = heard(known[shown], np.setdiff1d(np.flatnonzero(known[first : last + 1].all(0)), lost))
        learn = chosen(shown & known[:, told].all(1), first, last, rate)
        gap = np.flatnonzero(placed[first : last + 1]) + first
        if len(told) < ASKED and last - first > PIECE * rate:  # too many are lost at some time of a long gap
            half = (first + last) // 2
            asked += [((first, half), lost), ((half + 1, last), lost)]
            continue
        if len(learn) < FEWEST or len(told) < ASKED or not len(gap):
            continue
        course = process(own, told, lost, turn, origin, learn, rate)
        place, left = course.expected(circumstances(own[:, told], turn, origin, gap, rate), gap / rate)
        power = np.fmax(course.missed((last - first + 1) / rate), course.power).reshape(-1, 3).mean(1)
        at = np.ix_(gap, lost)
        filled[at] = np.einsum("tab,tmb->tma", turn[gap], place.reshape(len(gap), -1, 3)) + origin[gap, None]
        deviation[at] = np.sqrt(left[:, None] * power + TREMBLE**2)
    return filled, deviation


def unsure(sure: np.ndarray, first: int, last: int, lost: np.ndarray) -> np.ndarray:
    """-> of the markers `lost` over first..last, those that are not known well enough (T, M) all through."""
    return lost[~(sure[first : last + 1, lost] < WORTH).all(0)]


def heard(known: np.ndarray, told: np.ndarray) -> np.ndarray:
    """-> as many of the markers `told` as are known (N, M) all together in ENOUGH of the frames, those known most often first."""
    often = told[np.argsort(-known[:, told].sum(0), kind="stable")]
    together = np.logical_and.accumulate(known[:, often], axis=1).sum(0)
    return np.sort(often[together >= ENOUGH * len(known)])


def process(
    own: np.ndarray, told: np.ndarray, lost: np.ndarray, turn: np.ndarray, origin: np.ndarray, learn: np.ndarray, rate: float
) -> Process:
    """-> the courses of the `lost` markers in the body's axes (T, M, 3), by the circumstances that those `told` make."""
    places = own[np.ix_(learn, lost)].reshape(len(learn), -1)
    noise = np.full(len(learn), TREMBLE**2)
    return learnt(places, circumstances(own[:, told], turn, origin, learn, rate), learn / rate, noise, LIKENESS)


def circumstances(told: np.ndarray, turn: np.ndarray, origin: np.ndarray, frames: np.ndarray, rate: float) -> np.ndarray:
    """-> (N, F) the circumstances of the body at N `frames`, each in units of a difference that counts as one.

    told (T, K, 3) metres, in the body's axes; these as turn (T, 3, 3) and origin (T, 3) in the world
    """
    span, last = max(1, round(MOMENT * rate)), len(told) - 1
    before, after = np.maximum(frames - span, 0), np.minimum(frames + span, last)
    seconds = ((after - before) / rate + (last == 0))[:, None]
    step = np.swapaxes(turn[before], 1, 2) @ turn[after]
    spin = np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1) / 2
    speed = np.einsum("tba,tb->ta", turn[frames], origin[after] - origin[before])
    share = np.sqrt(EACH / told.shape[1])
    placed = told[frames].reshape(len(frames), -1) * (share / PLACED)
    moving = np.nan_to_num(told[after] - told[before]).reshape(len(frames), -1) * (share / MOVING) / seconds  # 0 where not known
    hips = [turn[frames, 1] / UPRIGHT, origin[frames, 1:2] / HEIGHT, speed / seconds / SPEED, spin / seconds / SPIN]
    return np.concatenate([placed, moving, *hips], axis=1)
