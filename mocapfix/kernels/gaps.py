"""What is lost together, and the moments from which it is learnt what was lost."""

import numpy as np

from mocapfix.take import runs

BESIDE, STEP = 0.6, 1 / 30  # seconds beside a gap that are learnt from densely, and what lies between two frames learnt from
LEARNT = 200  # frames at most that are learnt from


def together(gone: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
    """-> (first, last): the columns that are gone (T, J) from then till then, neither longer nor shorter."""
    found: dict[tuple[int, int], list[int]] = {}
    for j in np.flatnonzero(gone.any(axis=0)):
        for gap in runs(gone[:, j]):
            found.setdefault(gap, []).append(int(j))
    return {gap: np.array(lost) for gap, lost in found.items()}


def chosen(known: np.ndarray, first: int, last: int, rate: float) -> np.ndarray:
    """-> indices of the frames that a gap is learnt from, rising: of those `known` (T,), all beside it but for such as follow
    too soon on one another, and others as many as may be, evenly spread.
    """
    frames = np.flatnonzero(known)
    beyond = np.where(frames < first, first - 1 - frames, frames - last - 1)  # frames from the edge
    step = max(1, round(STEP * rate))
    beside = beyond < BESIDE * rate
    near, far = frames[beside & (beyond % step == 0)], frames[~beside]
    count = min(LEARNT - len(near), len(far))
    spread = far[np.unique(np.linspace(0, len(far) - 1, count).astype(int))] if count > 0 else far[:0]
    return np.sort(np.r_[near, spread])
