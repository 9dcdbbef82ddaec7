"""Which markers keep their distance to which: those on one segment, learnt from the take itself.

Two markers of one rigid thing keep their distance over the whole take (Ringer & Lasenby 2004, "A procedure for automatically
estimating model parameters in optical motion capture"). Asked is by how much a distance changes within a second: that is deaf
to a marker that moves on its segment once, and hears what joints and skin do.
"""

import numpy as np

LEARNING = 300  # pairs of frames at most, evenly spread, from which distances are learnt
FEWEST = 20  # of these in which both markers must be seen
WITHIN = 1.0  # seconds; half of a take that is shorter than two
USUAL = 0.84  # of the changes are smaller: a normal distribution's standard deviation, about


def looseness(markers: np.ndarray, rate: float) -> np.ndarray:
    """-> (M, M) metres: by how much the distance of two markers usually changes in a second; infinite where hardly known.

    Infinite, too, for a marker and itself.

    markers  (T, M, 3) metres, NaN where not believed; rate in Hz
    """
    frames, count = markers.shape[:2]
    loose = np.full((count, count), np.inf)
    lag = min(round(WITHIN * rate), frames // 2)
    starts = np.unique(np.linspace(0, frames - lag - 1, LEARNING).astype(int)) if lag else np.zeros(0, int)
    before, after = markers[starts], markers[starts + lag]
    for i in range(1, count):
        was, is_now = (np.linalg.norm(some[:, :i] - some[:, i, None], axis=-1) for some in (before, after))
        change = np.sort(np.abs(is_now - was), axis=0)  # NaN comes last
        known = (~np.isnan(change)).sum(0)
        others = np.flatnonzero(known >= min(FEWEST, max(2, len(starts))))
        usual = np.rint(USUAL * (known[others] - 1)).astype(int)
        loose[i, others] = loose[others, i] = change[usual, others]
    return loose
