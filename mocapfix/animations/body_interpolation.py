"""What a take itself says of a whole figure that was lost: how it went, at other times, between edges like these.

Every stretch of the take as long as the gap shows what the course around it would have missed there (see `bridged`). Where its
two edges are like the gap's, the gap will have missed the same: a Gaussian process over the stretches, in the circumstances of
their edges, foretells it. Between edges that nothing in the take is like, that is nothing.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.animation import compose_transforms
from mocapfix.animations.rotation_repair import make_quaternions_continuous
from mocapfix.solve import state_features
from mocapfix.stats import constant_offsets
from mocapfix.stats.gaussian_process import StateCovariance, compute_matern_52, fit_gaussian_process

# MERGED: mocapfix.solve.between
MAX_TRAINING_STRETCHES, MIN_TRAINING_STRETCHES = 250, 8  # stretches that are learnt from
GAP_BIAS_KERNEL = StateCovariance(
    time_scale_s=1.0, similarity_rate=0.5, time_power=0.0, recurrence_power=1.6, linear_power=0.0, noise_power=0.05
)
DISPLACEMENT_UNIT_M = 1.0  # metres between the edges: the difference that counts as one


def predict_gap_bias(
    root: np.ndarray,
    local_rotations: np.ndarray,
    world_rotations: np.ndarray,
    is_known: np.ndarray,
    weights: np.ndarray,
    context_frames: np.ndarray,
    first: int,
    last: int,
    rate: float,
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """-> what the course around a gap misses, (n, J, 3) radians in the turned axes and (n, 3) metres in the heading before the
    gap, and the part of its power that stays unknown; None where nothing in the take tells.

    root (T, 3) metres, local and turned (T, J, 3, 3) in the parents' axes and in the world; sound (T,): frames that are known
    weights (n, N) by which the course at a gap's n frames follows from N frames, `near` (N,) the gap's first frame, rising
    """
    count, span = last - first + 1, max(1, round(state_features.VELOCITY_HALF_SPAN_S * rate))
    reach = np.unique(np.r_[context_frames - first, -1 - 2 * span, count + 2 * span, np.arange(-1, count + 1)])
    starts = np.arange(-reach.min(), len(root) - reach.max())
    starts = starts[[bool(is_known[start + reach].all()) for start in starts]]
    if len(starts) < MIN_TRAINING_STRETCHES or not 2 * span < first < len(root) - count - 2 * span:
        return None
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, min(MAX_TRAINING_STRETCHES, len(starts))).astype(int))]
    away = [_measure_gap_bias(world_rotations, root, weights, context_frames - first, start, count) for start in starts]
    known = compute_edge_features(root, local_rotations, np.r_[starts, first], count, span, rate)
    process = fit_gaussian_process(np.array(away), known[:-1], np.zeros(len(starts)), np.zeros(len(starts)), GAP_BIAS_KERNEL)
    expected, left = process.predict(known[-1:], np.zeros(1))
    both = expected.reshape(count, -1, 3)
    return both[:, :-1], both[:, -1], float(left[0] / (GAP_BIAS_KERNEL.recurrence_power + GAP_BIAS_KERNEL.noise_power))


def compute_edge_features(
    root: np.ndarray, local_rotations: np.ndarray, start_frames: np.ndarray, frame_count: int, span: int, rate: float
) -> np.ndarray:
    """-> (S, F) the circumstances at both edges of stretches of `count` frames, and how far and by how much of a turn they lie
    apart, each in units of a difference that counts as one."""
    before, after, told = start_frames - 1 - span, start_frames + frame_count + span, np.arange(1, local_rotations.shape[1])
    back = np.swapaxes(extract_heading(local_rotations[before, 0]), -1, -2)
    way = (back @ (root[after] - root[before])[..., None])[..., 0] / DISPLACEMENT_UNIT_M
    turn = (np.swapaxes(local_rotations[before, 0], -1, -2) @ local_rotations[after, 0]).reshape(len(start_frames), 9) / np.sqrt(
        2
    )
    return np.concatenate(
        [
            *(state_features.compute_joint_state_features(root, local_rotations, told, each, rate) for each in (before, after)),
            way,
            turn,
        ],
        axis=1,
    )


def extract_heading(rotations: np.ndarray) -> np.ndarray:
    """-> (..., 3, 3) the turns about the vertical that bring Z below where rotations (..., 3, 3) bring it."""
    angle = np.arctan2(rotations[..., 0, 2], rotations[..., 2, 2])
    return Rotation.from_euler("y", angle.reshape(-1, 1)).as_matrix().reshape(rotations.shape)


def _measure_gap_bias(
    world_rotations: np.ndarray,
    root: np.ndarray,
    weights: np.ndarray,
    context_offsets: np.ndarray,
    start_frame: int,
    frame_count: int,
) -> np.ndarray:
    """-> (n * (J + 1) * 3,) what the course around a stretch misses."""
    quaternions = Rotation.from_matrix(
        world_rotations[np.r_[start_frame + context_offsets, start_frame : start_frame + frame_count]].reshape(-1, 3, 3)
    ).as_quat()
    quaternions = quaternions.reshape(-1, world_rotations.shape[1], 4)
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    known, true = quaternions[: len(context_offsets)].copy(), quaternions[len(context_offsets) :]
    known[1:] *= np.cumprod(signs[: len(context_offsets) - 1], axis=0)
    guess = np.einsum("gn,njc->gjc", weights, known)
    guess /= np.linalg.norm(guess, axis=-1, keepdims=True)
    off = constant_offsets.multiply_quaternions(guess * [-1, -1, -1, 1], true)
    turn = 2 * off[..., :3] * np.where(off[..., 3:] < 0, -1.0, 1.0)
    place = (root[start_frame : start_frame + frame_count] - weights @ root[start_frame + context_offsets]) @ extract_heading(
        world_rotations[start_frame - 1, 0]
    )
    return np.concatenate([turn.reshape(frame_count, -1), place], axis=1).ravel()


# MERGED: mocapfix.solve.bridged
# A whole figure lost for a while: every segment's turn in the world, and the root's place, go on from both edges.
#
# In the world, for there the parts of a body are steadier than in one another's axes: what the pelvis does the legs undo. Each
# goes its smoothest way, by a Gaussian process in time alone (Matern-5/2) about an unknown middle; what that misses at other
# times between like edges (see `between`) it is given.
INTERPOLATION_TIMESCALE_S, INTERPOLATION_NOISE_VARIANCE = (
    0.45,
    1e-4,
)  # seconds over which a course goes on as it does; variance of a sample, of the course's power
INTERPOLATION_MEAN_VARIANCE = 100.0  # variance of a course's middle, likewise
INTERPOLATION_CONTEXT_S = 0.6  # seconds on either side that are learnt from


def find_context_frames(is_known: np.ndarray, first: int, last: int, rate: float) -> np.ndarray:
    """-> the `sound` (T,) frames near first..last."""
    frames = round(INTERPOLATION_CONTEXT_S * rate)
    near = np.r_[max(0, first - frames) : first, last + 1 : min(len(is_known), last + 1 + frames)]
    return near[is_known[near]]


def compute_interpolation_weights(frames: np.ndarray, first: int, last: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> by how much each of N known frames counts (n, N) for a course over first..last, and what they leave open (n,), in units
    of the course's power."""
    gap = np.arange(first, last + 1)
    among = (
        INTERPOLATION_MEAN_VARIANCE
        + compute_matern_52((frames[:, None] - frames) / rate, INTERPOLATION_TIMESCALE_S)
        + INTERPOLATION_NOISE_VARIANCE * np.eye(len(frames))
    )
    between = INTERPOLATION_MEAN_VARIANCE + compute_matern_52((gap[:, None] - frames) / rate, INTERPOLATION_TIMESCALE_S)
    counts = np.linalg.solve(among, between.T).T
    return counts, np.maximum(INTERPOLATION_MEAN_VARIANCE + 1 - (counts * between).sum(1), INTERPOLATION_NOISE_VARIANCE)


def interpolate_values(
    known: np.ndarray, frames: np.ndarray, first: int, last: int, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> a course (n, C) over first..last, known (N, C) in some frames (N,), and its variance (n,) per number."""
    counts, left = compute_interpolation_weights(frames, first, last, rate)
    among = (
        INTERPOLATION_MEAN_VARIANCE
        + compute_matern_52((frames[:, None] - frames) / rate, INTERPOLATION_TIMESCALE_S)
        + INTERPOLATION_NOISE_VARIANCE * np.eye(len(frames))
    )
    power = float((known * np.linalg.solve(among, known)).sum() / known.size)
    return counts @ known, left * power


def interpolate_rotations(
    rotations: np.ndarray, frames: np.ndarray, first: int, last: int, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> rotations (n, 3, 3) over first..last of one that is known (N, 3, 3) in some frames, and the variance (n,), rad^2."""
    known = 2 * make_quaternions_continuous(Rotation.from_matrix(rotations).as_quat())
    expected, variance = interpolate_values(known, frames, first, last, rate)
    return Rotation.from_quat(expected).as_matrix(), variance * 4 / 3


def interpolate_body(
    parents: np.ndarray, root: np.ndarray, local_rotations: np.ndarray, is_known: np.ndarray, first: int, last: int, rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """-> the root's places (n, 3) and the local rotations (n, J, 3, 3) over first..last, and the variances (n,), m^2, and (n, J),
    rad^2 per axis.

    root (T, 3) metres, local (T, J, 3, 3); sound (T,): frames in which the whole figure is known
    """
    near = find_context_frames(is_known, first, last, rate)
    turned = compose_transforms(parents, np.zeros((*local_rotations.shape[:2], 3)), local_rotations)[1]
    place, of_place = interpolate_values(root[near], near, first, last, rate)
    found, variance = (
        np.empty((last - first + 1, *local_rotations.shape[1:])),
        np.empty((last - first + 1, local_rotations.shape[1])),
    )
    for j in range(local_rotations.shape[1]):
        found[:, j], variance[:, j] = interpolate_rotations(turned[near, j], near, first, last, rate)
    counts = compute_interpolation_weights(near, first, last, rate)[0]
    if told := predict_gap_bias(root, local_rotations, turned, is_known, counts, near, first, last, rate):
        turns, places, left = told
        found = found @ Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(found.shape)
        place = place + places @ extract_heading(turned[first - 1, 0]).T
        of_place, variance = of_place * left, variance * left
    inner = parents >= 0
    found[:, inner] = np.swapaxes(found[:, parents[inner]], -1, -2) @ found[:, inner]
    return place, found, of_place, variance
