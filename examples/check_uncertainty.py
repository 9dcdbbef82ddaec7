"""Use the predicted standard deviation of every filled sample."""

from pathlib import Path

import numpy as np

import mocapfix
from mocapfix.synthetic import compose_take, write_synthetic_take

path = Path("uncertainty.c3d")
write_synthetic_take(path, compose_take(seed=8, seconds=3.0))
result = mocapfix.clean(path, prior="none")

sd_m = result.take.sample_sd  # (T, M) metres per axis, NaN for samples that were not filled
assert sd_m is not None
for m in np.argsort(-np.nan_to_num(sd_m).max(0))[:5]:
    frame = int(np.nanargmax(sd_m[:, m]))
    number = result.take.first_frame + frame
    print(f"{result.take.labels[m]}: least certain in frame {number}, {sd_m[frame, m] * 1e3:.1f} mm")
