"""Changes that are not to be made, taken back."""

from dataclasses import replace

import numpy as np

from mocapfix.take import Take


def put_back(after: Take, before: Take, where: np.ndarray) -> Take:
    """-> the cleaned take with the samples `where` (T, M) as they were before, and no other touched."""
    return replace(
        after,
        markers=np.where(where[..., None], before.markers, after.markers),
        source=np.where(where, before.sources, after.sources),
        deviation=None if after.deviation is None else np.where(where, np.nan, after.deviation),
        computed=np.where(where, before.seen & ~before.measured, after.seen & ~after.measured),
    )
