"""Which coordinates of a file are a place, and which say that there is none."""

import numpy as np

NOWHERE = 9_000_000  # file units; Cortex writes 9999999 for an occluded marker
NINES = 9999  # file units; three times the same from there on is no place: -9999.99


def there(xyz: np.ndarray) -> np.ndarray:
    """-> (T, P) bool: is each point of `xyz` (T, P, 3) in file units a place? Neither NaN, nor all 0, nor all nines."""
    x, y, z = np.moveaxis(xyz, -1, 0)
    alike = (x == y) & (y == z)
    near = (np.abs(x) < NOWHERE) & (np.abs(y) < NOWHERE) & (np.abs(z) < NOWHERE)
    return near & ~(alike & ((x == 0) | (np.abs(x) >= NINES)))
