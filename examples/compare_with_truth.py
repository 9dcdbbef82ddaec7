"""Measure the fill error on a synthetic take, whose true marker positions are known, beside linear interpolation."""

from pathlib import Path

import numpy as np

import mocapfix
from mocapfix.synthetic import compose_take, write_synthetic_take

truth, path = compose_take(seed=7, seconds=4.0), Path("truth.c3d")
write_synthetic_take(path, truth)
result = mocapfix.clean(path)

linear = truth.damaged_positions.copy()
frames = np.arange(len(linear))
for m in range(linear.shape[1]):
    visible = ~truth.missing_mask[:, m]
    for axis in range(3):
        linear[~visible, m, axis] = np.interp(frames[~visible], frames[visible], linear[visible, m, axis])

for name, markers in (("linear", linear), ("mocapfix", result.take.markers)):
    error_m = np.linalg.norm((markers - truth.marker_positions)[truth.missing_mask], axis=-1)
    print(f"{name:>9}: root mean square error {np.sqrt(np.nanmean(error_m**2)) * 1e3:.1f} mm")
