"""A Gaussian over the whole marker set, learnt from the take itself, that says where markers not seen are, given those seen.

Gloersen & Federolf 2016 ("Predicting missing marker trajectories in human motion data using marker intercorrelations", PLoS
ONE 11) in its probabilistic form: every frame is laid on a common shape by a rigid motion, and mean and covariance follow by
expectation maximisation over what is missing (Little & Rubin 2002, section 11.2). Beside the markers the Gaussian holds the
up direction, the height and the speed of the body, which tell a crouch and the phase of a stride.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.course import matern
from mocapfix.kernels.rigid import centred, fitted, inside
from mocapfix.take import runs

RARE = 0.05  # a marker seen in a smaller part of the frames tells nothing about the others
SHAPE = 0.002  # metres: how still on the body a marker can be, so that none alone decides the alignment
NOISE = 0.03  # metres: a change of a single feature that means nothing; it keeps the covariance of a short take in bounds
LEVER = 0.3  # metres: by it an angle becomes a length
PACE = 0.1  # seconds: by it a speed becomes a length
ROUNDS = 5  # of expectation maximisation
LEARNING = 1000  # frames at most, evenly spread, from which the Gaussian is learnt
FADE = 0.3  # seconds after which what the Gaussian missed at an edge has lost most of its memory
REACH = 0.1  # seconds on either side of a gap that are listened to
LISTENED = 6  # samples on either side
SHARE = 1e-3  # of the variance: what a single sample beside a gap cannot tell


class Gaussian(NamedTuple):
    """A normal distribution of F features."""

    mean: np.ndarray  # (F,)
    precision: np.ndarray  # (F, F) the covariance's inverse

    def given(self, features: np.ndarray, hidden: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> expected values (N, H) of the `hidden` columns (H,) given all others of `features` (N, F); covariance (H, H)."""
        off = features - self.mean
        off[:, hidden] = 0
        covariance = np.linalg.inv(self.precision[np.ix_(hidden, hidden)])
        return self.mean[hidden] - off @ self.precision[:, hidden] @ covariance, covariance


class Bridge(NamedTuple):
    """How one gap of a marker is tied to the samples beside it."""

    frames: np.ndarray  # (G,) of the gap
    near: np.ndarray  # (N,) frames beside it
    weight: np.ndarray  # (G, N) of what was missed there
    left: np.ndarray  # (G,) the part of the variance that they leave open


def gaussian(markers: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, M, 3) in metres at missing samples, NaN elsewhere, and their standard deviation per axis (T, M).

    At a gap's edges the Gaussian is asked as though everything missing in the gap were missing there too, and the
    difference is carried across, fading in a long gap. NaN for markers hardly ever seen, and in frames with fewer than
    three others.

    markers  (T, M, 3) metres, Y up, NaN where not believed; rate in Hz
    """
    filled, deviation = np.full(markers.shape, np.nan), np.full(markers.shape[:2], np.nan)
    common = np.flatnonzero((~np.isnan(markers[..., 0])).mean(0) > RARE) if len(markers) else np.zeros(0, int)
    if len(common) < 4:
        return filled, deviation
    worn = markers.take(common, axis=1)
    turn, origin, placed = aligned(worn)
    if placed.sum() < 2:
        return filled, deviation
    laid = inside(worn, origin, turn)
    features = np.concatenate([laid.reshape(len(laid), -1), circumstances(turn, origin, rate)], 1)
    missing = np.isnan(worn[..., 0])
    told = ~missing[placed].all(0)
    model, features = completed(features, missing, placed)
    own, sure = bridged(model, features, laid, missing, placed, rate)
    filled[:, common[told]] = (np.einsum("tab,tmb->tma", turn, own) + origin[:, None])[:, told]
    deviation[:, common[told]] = sure[:, told]
    return filled, deviation


def aligned(markers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> turn (T, 3, 3) and origin (T, 3) of the body's axes in the world, and (T,) bool: three or more markers tell them.

    Each marker counts by how still it lies on the common shape: the trunk leads (Theobald & Wuttke 2006, PNAS 103, the
    maximum-likelihood form of Procrustes alignment).
    """
    seen = ~np.isnan(markers[..., 0])
    solid = np.nan_to_num(markers)
    shape, variance = markers[np.argmax(seen.sum(1))], np.ones(markers.shape[1])
    shape = shape - np.nanmean(shape, 0)
    for _ in range(6):
        weight = seen * ~np.isnan(shape[:, 0]) / (SHAPE**2 + variance)
        placed = (weight > 0).sum(1) >= 3
        cross, here, there = centred(solid, np.nan_to_num(shape), weight)
        turn = fitted(cross)
        if not placed.any():
            break
        laid = inside(solid, here - np.einsum("tab,tb->ta", turn, there), turn)
        use = (seen & placed[:, None]).astype(float)
        count = np.where(use.any(0), use.sum(0), np.nan)[:, None]
        shape = np.einsum("tma,tm->ma", laid, use) / count
        laid -= shape
        variance = np.nan_to_num(np.einsum("tma,tma,tm->ma", laid, laid, use) / count).mean(1)
        shape -= np.nanmean(shape, 0)
    return turn, here - np.einsum("tab,tb->ta", turn, there), placed


def circumstances(turn: np.ndarray, origin: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 10) in metres: the body's up direction, height, velocity and turning, all but the height in its own axes."""
    span, frames = max(1, round(PACE / 2 * rate)), np.arange(len(turn))
    a, b = np.maximum(frames - span, 0), np.minimum(frames + span, len(turn) - 1)
    moved = np.einsum("tba,tb->ta", turn, origin[b] - origin[a])
    step = np.swapaxes(turn[a], 1, 2) @ turn[b]
    turned = np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1) / 2
    pace = PACE * rate / np.maximum(b - a, 1)[:, None]
    return np.concatenate([LEVER * turn[:, 1], origin[:, 1:2], moved * pace, LEVER * turned * pace], 1)


def patterns(missing: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """-> for every set of markers that are missing together, their frames and their indices."""
    kinds: dict[bytes, list[int]] = {}
    for t in np.flatnonzero(missing.any(1)):
        kinds.setdefault(missing[t].tobytes(), []).append(int(t))
    return [(np.array(rows), np.flatnonzero(missing[rows[0]])) for rows in kinds.values()]


def columns(markers: np.ndarray) -> np.ndarray:
    """-> the features of these markers."""
    return (3 * markers[:, None] + np.arange(3)).ravel()


def completed(features: np.ndarray, missing: np.ndarray, placed: np.ndarray) -> tuple[Gaussian, np.ndarray]:
    """-> the Gaussian, and the features (T, F) with what was missing as it expects it."""
    learn = np.flatnonzero(placed)
    learn = learn[np.unique(np.linspace(0, len(learn) - 1, LEARNING).astype(int))]
    guess, frames = features.copy(), np.arange(len(features))
    for column in np.flatnonzero(np.isnan(features).any(0)):
        known = placed & ~np.isnan(features[:, column])
        gone = np.isnan(features[:, column])
        guess[gone, column] = np.interp(frames[gone], frames[known], features[known, column]) if known.any() else 0.0
    few, size = patterns(missing[learn]), features.shape[1]
    spread, model = np.zeros((size, size)), Gaussian(np.zeros(size), np.eye(size))
    for _ in range(ROUNDS):
        sample = guess[learn]
        off = sample - sample.mean(0)
        covariance = off.T @ off / len(learn) + spread + NOISE**2 * np.eye(size)
        model = Gaussian(sample.mean(0), np.linalg.inv(covariance))
        spread = np.zeros_like(spread)
        for rows, gone in few:
            hidden = columns(gone)
            guess[np.ix_(learn[rows], hidden)], left = model.given(sample[rows], hidden)
            spread[np.ix_(hidden, hidden)] += left * (len(rows) / len(learn))
    for rows, gone in patterns(missing):
        guess[np.ix_(rows, columns(gone))] = model.given(guess[rows], columns(gone))[0]
    return model, guess


def bridged(model, features, laid, missing, placed, rate) -> tuple[np.ndarray, np.ndarray]:
    """-> places (T, M, 3) of the missing in the body's axes, tied to the edges of their gaps, and deviation (T, M)."""
    own, deviation = np.full(laid.shape, np.nan), np.full(missing.shape, np.nan)
    bridges, gap_of = gaps(missing, placed, rate)
    for rows, gone in patterns(missing & placed[:, None]):
        pieces = [(i, m, bridges[g]) for i, m in enumerate(gone) for g in np.unique(gap_of[rows, m])]
        asked = np.unique(np.concatenate([rows, *(bridge.near for _, _, bridge in pieces)]))
        expected, covariance = model.given(features[asked], columns(gone))
        expected = expected.reshape(len(asked), -1, 3)
        variance = np.diag(covariance).reshape(-1, 3).mean(1)
        for i, m, bridge in pieces:
            mine = np.intersect1d(rows, bridge.frames, assume_unique=True)
            within = mine - bridge.frames[0]
            missed = laid[bridge.near, m] - expected[np.searchsorted(asked, bridge.near), i]
            own[mine, m] = expected[np.searchsorted(asked, mine), i] + bridge.weight[within] @ missed
            deviation[mine, m] = np.sqrt(variance[i] * bridge.left[within])
    return own, deviation


def gaps(missing: np.ndarray, placed: np.ndarray, rate: float) -> tuple[list[Bridge], np.ndarray]:
    """-> every gap's bridge, and (T, M) the index of the gap a missing sample lies in."""
    steps = max(1, round(REACH * rate))
    pick = np.unique(np.linspace(0, steps - 1, min(LISTENED, steps)).astype(int))
    bridges, gap_of = [], np.full(missing.shape, -1)
    for m in range(missing.shape[1]):
        for first, last in runs(missing[:, m]):
            near = np.r_[first - 1 - pick, last + 1 + pick]
            near = near[(near >= 0) & (near < len(missing))]
            near, frames = near[~missing[near, m] & placed[near]], np.arange(first, last + 1)
            among = matern((near[:, None] - near[None]) / rate, FADE) + SHARE * np.eye(len(near))
            between = matern((frames[:, None] - near[None]) / rate, FADE)
            weight = np.linalg.solve(among, between.T).T
            gap_of[first : last + 1, m] = len(bridges)
            bridges.append(Bridge(frames, near, weight, np.maximum(1 - (weight * between).sum(1), SHARE)))
    return bridges, gap_of
