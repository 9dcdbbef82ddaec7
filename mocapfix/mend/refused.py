"""Changes that are not to be made, taken back."""

from dataclasses import replace

import numpy as np

from mocapfix.faults import Fault, Fragment
from mocapfix.take import Take


def put_back(after: Take, before: Take, refused: list[Fault]) -> Take:
    """-> the cleaned take with the samples of these faults as they were before, and no other touched."""
    if not refused:
        return after
    mask, count = np.zeros(before.seen.shape, bool), len(before.labels)
    loose = None if after.unlabelled is None else after.unlabelled.markers.copy()
    for fault in refused:
        mask[fault.frames, [m for m in fault.markers if m < count]] = True
        if isinstance(fault, Fragment) and fault.donor < count:
            mask[fault.frames, fault.donor] = True
        elif isinstance(fault, Fragment) and loose is not None and before.unlabelled is not None:
            loose[fault.frames, fault.donor - count] = before.unlabelled.markers[fault.frames, fault.donor - count]
    deviation = None if after.deviation is None else np.where(mask, np.nan, after.deviation)
    return replace(
        after,
        markers=np.where(mask[..., None], before.markers, after.markers),
        source=np.where(mask, before.sources, after.sources),
        deviation=deviation,
        computed=np.where(mask, before.seen & ~before.measured, after.seen & ~after.measured),
        unlabelled=after.unlabelled and after.unlabelled.with_markers(loose if loose is not None else after.unlabelled.markers),
    )
