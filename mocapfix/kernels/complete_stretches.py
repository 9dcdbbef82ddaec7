"""Search for stretches of a signal in which all required frames are visible."""

import numpy as np

from mocapfix.kernels.compilation_cache import compile_kernel


@compile_kernel
def find_complete_stretches(is_visible, frame_offsets, step):
    """Return the frames, of every `step`th, for which all frames at the given offsets (N,) are visible (T,)."""
    starts, count = np.empty(len(is_visible), np.int64), 0
    for start in range(-frame_offsets.min(), len(is_visible) - frame_offsets.max(), step):
        is_complete = True
        for offset in frame_offsets:
            if not is_visible[start + offset]:
                is_complete = False
                break
        if is_complete:
            starts[count] = start
            count += 1
    return starts[:count]
