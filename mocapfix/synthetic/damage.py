"""What goes wrong with markers: hidden for moments, for seconds, a whole arm at once; and seen where they are not."""

import numpy as np

from mocapfix.take import runs

ARM = ("LeftArm", "LeftForeArm", "LeftHand")
ARM_LOST = (1.0, 2.5)  # seconds: while it swings
LATE = 0.5  # seconds until one of the markers is first seen
SHORT_GAPS = 0.12  # a second and marker, each of 0.03 to 0.2 s
LONG_GAPS = 0.6  # a second, over all markers, each of 0.5 to 3 s
SPIKES = 1.5  # a second, over all markers, each of 8 to 25 ms and 0.03 to 0.3 m


def gaps(rng: np.random.Generator, frames: int, rate: float, arm: np.ndarray) -> np.ndarray:
    """-> (T, M) bool: the samples that are missing; `arm` (M,) bool are the markers that are lost together."""
    struck = np.zeros((frames, len(arm)), bool)
    seconds = frames / rate
    for count, shortest, longest in ((SHORT_GAPS * len(arm), 0.03, 0.2), (LONG_GAPS, 0.5, 3.0)):
        for _ in range(rng.poisson(count * seconds)):
            first, marker = rng.integers(frames), rng.integers(len(arm))
            length = shortest * (longest / shortest) ** rng.random()
            struck[first : first + max(1, round(length * rate)), marker] = True
    first, end = (round(time * rate) for time in ARM_LOST)
    struck[first:end, arm] = True
    late = rng.integers(len(arm))
    struck[: round(LATE * rate), late] = True
    return struck


def spikes(rng: np.random.Generator, seen: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, M, 3) metres by which the `seen` (T, M) samples are displaced: 0 for nearly all."""
    frames, count = seen.shape
    shift = np.zeros((frames, count, 3))
    for _ in range(rng.poisson(SPIKES * frames / rate)):
        marker = rng.integers(count)
        stretches = runs(seen[:, marker])
        if not stretches:
            continue
        first, last = stretches[rng.integers(len(stretches))]
        start = rng.integers(first, last + 1)
        stop = min(last + 1, start + max(1, round(rng.uniform(0.008, 0.025) * rate)))
        way = rng.normal(size=3)
        shift[start:stop, marker] = way / np.linalg.norm(way) * 0.03 * 10 ** rng.random()
    return shift
