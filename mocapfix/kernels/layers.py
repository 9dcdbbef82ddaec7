"""A small network of fully connected layers, frame by frame, compiled, in single precision.

A library for matrix products has threads of its own, which wait for ours and ours for them: that costs several times as much.
"""

import numpy as np
from numba import njit

ZERO = np.float32(0)


@njit(cache=True, nogil=True)
def layer_frames(weights, offsets, inputs, outputs, first, stop):
    """Write outputs (T, M) that L layers make of inputs (T, N) in the frames first..stop - 1.

    weights, offsets  L matrices, inputs by outputs, and L vectors; between layers what is negative becomes 0
    """
    widest, last = 0, len(weights) - 1
    for k in range(last):
        widest = max(widest, len(offsets[k]))
    rows = np.empty((len(weights), widest), np.float32)
    for t in range(first, stop):
        row = inputs[t]
        for k in range(last):
            _layer(weights[k], offsets[k], row, rows[k], True)
            row = rows[k]
        _layer(weights[last], offsets[last], row, outputs[t], False)


@njit(cache=True, fastmath=True)
def _layer(weights, offsets, row, out, bent):
    inputs, outputs = weights.shape
    for o in range(outputs):
        out[o] = offsets[o]
    for i in range(inputs):
        value = row[i]
        if value != ZERO:  # half of them are
            for o in range(outputs):
                out[o] += value * weights[i, o]
    if bent:
        for o in range(outputs):
            out[o] = max(out[o], ZERO)
