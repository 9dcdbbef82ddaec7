"""Damage to synthetic markers: short and long gaps, an arm lost as a whole, a late start, and spikes."""

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.stats.runs import find_runs

DAMAGED_ARM_JOINTS = ("LeftArm", "LeftForeArm", "LeftHand")
ARM_GAP_S = (1.0, 2.5)  # while the arm swings
LATE_START_S = 0.5  # until one of the markers is first visible
SHORT_GAP_RATE_HZ = 0.12  # gaps a second and marker
SHORT_GAP_DURATION_S = (0.03, 0.2)
LONG_GAP_RATE_HZ = 0.6  # gaps a second, over all markers
LONG_GAP_DURATION_S = (0.5, 3.0)
SPIKE_RATE_HZ = 1.5  # spikes a second, over all markers
SPIKE_DURATION_S = (0.008, 0.025)
MIN_SPIKE_M = 0.03  # a spike's displacement is up to ten times this


def draw_gaps(
    rng: np.random.Generator, frames: int, rate: float, is_arm_marker: Bool[np.ndarray, " M"]
) -> Bool[np.ndarray, "T M"]:
    """Return a mask of the missing samples; the arm's markers are lost together."""
    missing = np.zeros((frames, len(is_arm_marker)), bool)
    seconds = frames / rate
    short_gaps = (SHORT_GAP_RATE_HZ * len(is_arm_marker), *SHORT_GAP_DURATION_S)
    for gap_rate_hz, shortest_s, longest_s in (short_gaps, (LONG_GAP_RATE_HZ, *LONG_GAP_DURATION_S)):
        for _ in range(rng.poisson(gap_rate_hz * seconds)):
            first, marker = rng.integers(frames), rng.integers(len(is_arm_marker))
            duration_s = shortest_s * (longest_s / shortest_s) ** rng.random()
            missing[first : first + max(1, round(duration_s * rate)), marker] = True
    first, end = (round(time_s * rate) for time_s in ARM_GAP_S)
    missing[first:end, is_arm_marker] = True
    late_marker = rng.integers(len(is_arm_marker))
    missing[: round(LATE_START_S * rate), late_marker] = True
    return missing


def draw_spikes(rng: np.random.Generator, is_visible: Bool[np.ndarray, "T M"], rate: float) -> Float[np.ndarray, "T M 3"]:
    """Return displacements in metres of the visible samples: 0 for nearly all."""
    frames, count = is_visible.shape
    shift = np.zeros((frames, count, 3))
    for _ in range(rng.poisson(SPIKE_RATE_HZ * frames / rate)):
        marker = rng.integers(count)
        visible_runs = find_runs(is_visible[:, marker])
        if not visible_runs:
            continue
        first, last = visible_runs[rng.integers(len(visible_runs))]
        start = rng.integers(first, last + 1)
        stop = min(last + 1, start + max(1, round(rng.uniform(*SPIKE_DURATION_S) * rate)))
        direction = rng.normal(size=3)
        shift[start:stop, marker] = direction / np.linalg.norm(direction) * MIN_SPIKE_M * 10 ** rng.random()
    return shift
