"""Memory of a repeated detection: what was found for a marker is valid as long as the same samples of it are used.

Between two rounds of detection on a take only the samples that were found faulty are set aside, which concerns few markers. What
a detector computes from a marker's own samples alone is therefore computed once, and again only for these markers.
"""

from collections.abc import Callable, Hashable
from typing import TypeVar

import numpy as np
from jaxtyping import Bool

Result = TypeVar("Result")


class RoundMemory:
    """Results that were computed from the samples of single markers of one take, each with the samples that were used."""

    def __init__(self) -> None:
        self._results: dict[Hashable, tuple[bytes, object]] = {}

    def recall(self, key: Hashable, is_used: Bool[np.ndarray, " T"], compute: Callable[[], Result]) -> Result:
        """Return the result under `key`. It is computed unless it is known from the same samples.

        Args:
            key: Names the computation, the marker and everything else that the result depends on.
            is_used: The samples of the marker that are used.
            compute: Computes the result from these samples. It must not depend on what is not named.
        """
        samples = np.packbits(is_used).tobytes()
        known = self._results.get(key)
        if known is not None and known[0] == samples:
            return known[1]  # pyright: ignore[reportReturnType]  # the key names the computation
        result = compute()
        self._results[key] = samples, result
        return result
