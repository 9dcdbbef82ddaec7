"""Which markers keep their distance to which: those on one segment, learnt from the take itself.

Two markers of one rigid thing keep their distance over the whole take (Ringer & Lasenby 2004, "A procedure for automatically
estimating model parameters in optical motion capture"); the nearer a distance is to constant, the nearer the two are to rigid.
"""

import numpy as np

LEARNING = 300  # frames at most, evenly spread, from which distances are learnt
FEWEST = 20  # of these in which both markers must be seen


def looseness(markers: np.ndarray) -> np.ndarray:
    """-> (M, M) metres: by how much the distance of two markers varies over the take; infinite where hardly known, and to itself.

    Half of what lies between the 16th and the 84th percentile: a normal distribution's standard deviation, deaf to a few
    wrong samples.

    markers  (T, M, 3) metres, NaN where not believed
    """
    frames = np.unique(np.linspace(0, len(markers) - 1, LEARNING).astype(int)) if len(markers) else np.zeros(0, int)
    some, count = markers[frames], markers.shape[1]
    loose = np.full((count, count), np.inf)
    for i in range(1, count):
        distance = np.linalg.norm(some[:, :i] - some[:, i, None], axis=-1)
        known = np.flatnonzero((~np.isnan(distance)).sum(0) >= min(FEWEST, len(frames)))
        ordered = np.sort(distance[:, known], axis=0)  # NaN comes last
        seen = (~np.isnan(ordered)).sum(0) - 1
        low, high = (ordered[np.rint(share * seen).astype(int), np.arange(len(known))] for share in (0.16, 0.84))
        loose[i, known] = loose[known, i] = (high - low) / 2
    return loose
