"""Statistics of sequences: runs in a mask, evenly spaced samples, rows that differ most, and the cheapest path (Viterbi)."""

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.viterbi import compute_cheapest_states


def find_runs(mask: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """Return the runs of True in `mask` as (first, last) indices, both inclusive."""
    padded = np.zeros(len(mask) + 2, bool)
    padded[1:-1] = mask
    edges: list[int] = np.flatnonzero(padded[1:] != padded[:-1]).tolist()
    return [(a, b - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


DENSE_TRAINING_MARGIN_S = 0.6  # beside a gap; within it training frames are dense
TRAINING_STEP_S = 1 / 30  # between training frames within the margin
MAX_TRAINING_FRAMES = 200


def sample_evenly(count: int, max_count: int) -> Int[np.ndarray, " N"]:
    """Return at most `max_count` of the indices 0..count - 1, rising and evenly spaced; all of them if there are no more."""
    return np.unique(np.linspace(0, count - 1, min(count, max_count)).astype(int))


def group_gaps(missing: Bool[np.ndarray, "T J"]) -> dict[tuple[int, int], Int[np.ndarray, " lost"]]:
    """Return, for each gap (first, last), the columns of `missing` (T, J) that have exactly this gap."""
    columns: dict[tuple[int, int], list[int]] = {}
    for j in np.flatnonzero(missing.any(axis=0)):
        for gap in find_runs(missing[:, j]):
            columns.setdefault(gap, []).append(int(j))
    return {gap: np.array(lost) for gap, lost in columns.items()}


def select_training_frames(is_known: Bool[np.ndarray, " T"], first: int, last: int, rate: float) -> Int[np.ndarray, " N"]:
    """Return indices, rising, of the frames to train on for a gap first..last.

    These are the frames `is_known` (T,) within the dense margin beside the gap, one each training step, and others evenly
    spaced, up to the largest number of training frames.
    """
    frames = np.flatnonzero(is_known)
    distance = np.where(frames < first, first - 1 - frames, frames - last - 1)  # frames from the gap's edge
    step = max(1, round(TRAINING_STEP_S * rate))
    in_margin = distance < DENSE_TRAINING_MARGIN_S * rate
    near, far = frames[in_margin & (distance % step == 0)], frames[~in_margin]
    count = min(MAX_TRAINING_FRAMES - len(near), len(far))
    spaced = far[sample_evenly(len(far), count)] if count > 0 else far[:0]
    return np.sort(np.r_[near, spaced])


def find_cheapest_states(
    step_cost: Float[np.ndarray, "steps N N"], state_cost: Float[np.ndarray, "T N"]
) -> Int[np.ndarray, " T"]:
    """Return the state of each frame in the sequence of least total cost (Viterbi 1967).

    step_cost   (T - 1, N, N) cost of the step from each state of a frame to each state of the next
    state_cost  (T, N) cost of each state in each frame
    """
    return compute_cheapest_states(step_cost, state_cost)


def select_farthest_rows(values: Float[np.ndarray, "N D"], count: int) -> list[int]:
    """Return the indices of rows that differ most: the one nearest to the mean, then each that is farthest from those before it.

    count  at least one is returned, and at most N are different
    """
    chosen = [int(np.linalg.norm(values - values.mean(0), axis=1).argmin())]
    nearest = np.full(len(values), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(values - values[chosen[-1]], axis=1))
        nearest[chosen[-1]] = -1.0  # never selected again, even if all other distances are 0
        chosen.append(int(nearest.argmax()))
    return chosen
