"""What goes wrong with markers: hidden for moments, for seconds, a whole arm at once; and seen where they are not."""

import numpy as np

from mocapfix.take import find_runs

DAMAGED_ARM_JOINTS = ("LeftArm", "LeftForeArm", "LeftHand")
ARM_GAP_S = (1.0, 2.5)  # seconds: while it swings
LATE_START_S = 0.5  # seconds until one of the markers is first seen
SHORT_GAP_RATE_HZ = 0.12  # a second and marker, each of 0.03 to 0.2 s
LONG_GAP_RATE_HZ = 0.6  # a second, over all markers, each of 0.5 to 3 s
SPIKE_RATE_HZ = 1.5  # a second, over all markers, each of 8 to 25 ms and 0.03 to 0.3 m


def draw_gaps(rng: np.random.Generator, frames: int, rate: float, is_arm_marker: np.ndarray) -> np.ndarray:
    """-> (T, M) bool: the samples that are missing; `arm` (M,) bool are the markers that are lost together."""
    struck = np.zeros((frames, len(is_arm_marker)), bool)
    seconds = frames / rate
    for count, shortest, longest in ((SHORT_GAP_RATE_HZ * len(is_arm_marker), 0.03, 0.2), (LONG_GAP_RATE_HZ, 0.5, 3.0)):
        for _ in range(rng.poisson(count * seconds)):
            first, marker = rng.integers(frames), rng.integers(len(is_arm_marker))
            length = shortest * (longest / shortest) ** rng.random()
            struck[first : first + max(1, round(length * rate)), marker] = True
    first, end = (round(time * rate) for time in ARM_GAP_S)
    struck[first:end, is_arm_marker] = True
    late = rng.integers(len(is_arm_marker))
    struck[: round(LATE_START_S * rate), late] = True
    return struck


def draw_spikes(rng: np.random.Generator, is_visible: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, M, 3) metres by which the `seen` (T, M) samples are displaced: 0 for nearly all."""
    frames, count = is_visible.shape
    shift = np.zeros((frames, count, 3))
    for _ in range(rng.poisson(SPIKE_RATE_HZ * frames / rate)):
        marker = rng.integers(count)
        stretches = find_runs(is_visible[:, marker])
        if not stretches:
            continue
        first, last = stretches[rng.integers(len(stretches))]
        start = rng.integers(first, last + 1)
        stop = min(last + 1, start + max(1, round(rng.uniform(0.008, 0.025) * rate)))
        way = rng.normal(size=3)
        shift[start:stop, marker] = way / np.linalg.norm(way) * 0.03 * 10 ** rng.random()
    return shift
