"""Fitting a Gaussian to poses: probabilistic principal components (Tipping and Bishop, 1999, Eqs. 7 and 8)."""

import numpy as np

from mocapfix.prior.linear import Linear

FLOOR = np.radians(1.0)  # what stands out by less is noise of the solve that the poses come from


def fit(joints: tuple[str, ...], middle: np.ndarray, vectors: np.ndarray, components: int | None) -> Linear:
    """-> the maximum-likelihood model of poses (N, J, 3), but for a noise of at least FLOOR; its sigma is still the noise.

    components  at most so many; None for all that stand out
    """
    rows = vectors.reshape(len(vectors), -1)
    values, axes = np.linalg.eigh(np.cov(rows.T, bias=True, dtype=float))
    values, axes = values[::-1], axes[:, ::-1]
    kept = int((values > FLOOR**2).sum()) if components is None else components
    noise = max(FLOOR**2, values[kept:].mean() if kept < len(values) else 0.0)
    kept = min(kept, int((values > noise).sum()))
    w = axes[:, :kept] * np.sqrt(values[:kept] - noise)
    mean = rows.mean(0, dtype=float).reshape(len(joints), 3)
    sigma = np.full(len(joints), np.sqrt(noise))
    return Linear(joints, middle, sigma, mean, w.T.reshape(kept, len(joints), 3), float(np.sqrt(noise)))
