"""Read any supported file as NumPy arrays: metres, Y up, NaN for missing samples."""

from pathlib import Path

import numpy as np

from mocapfix.io.capture import read_capture
from mocapfix.model.animation import Animation
from mocapfix.synthetic import compose_take, write_synthetic_take

path = Path("numpy.c3d")
write_synthetic_take(path, compose_take(seed=6, seconds=2.0))

capture = read_capture(path)
if isinstance(capture, Animation):
    print(f"{capture.name}: an animation of {len(capture.names)} joints")
else:
    missing = np.isnan(capture.markers[..., 0])
    print(f"{capture.name}: {capture.markers.shape} at {capture.rate:g} Hz, {missing.mean():.1%} of the samples are missing")
    worst = int(missing.sum(0).argmax())
    print(f"{capture.labels[worst]} is missing most often: in {missing[:, worst].sum()} frames")
