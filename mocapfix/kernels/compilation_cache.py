"""The folder in which Numba caches compiled kernels.

By default Numba writes its cache beside the package or in the user's home. If neither is writable (a service, a container),
the cache goes into the temporary folder, so that kernels are compiled once per machine instead of once per call.
"""

import os
import tempfile
from pathlib import Path

import numba

SOLVER_CACHE_PATTERN = "levenberg_marquardt.solve_frames-*.nbi"  # Numba's index file of the longest compilation


def configure_cache_folder() -> None:
    """Redirect Numba's cache to the temporary folder if its default folders are not writable."""
    folders = (Path(__file__).parent, Path.home())
    if not numba.config.CACHE_DIR and not any(os.access(folder, os.W_OK) for folder in folders):  # pyright: ignore
        numba.config.CACHE_DIR = str(Path(tempfile.gettempdir()) / "mocapfix-kernels")  # pyright: ignore


def is_solver_compiled() -> bool:
    """Return whether the compiled pose solver is in this machine's cache."""
    from mocapfix.kernels.levenberg_marquardt import solve_frames

    cache_path = solve_frames.stats.cache_path
    return cache_path is not None and any(Path(cache_path).glob(SOLVER_CACHE_PATTERN))
