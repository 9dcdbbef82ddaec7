"""What several stages stand on: kinematics, residual terms, the linear-time sweep (compiled with Numba).

Numba keeps what it compiled beside the package or in the user's home. Where neither can be written (a service, a
container), it goes into the temporary folder: compiled once there, not once a call.
"""

import os
import tempfile
from pathlib import Path

import numba

if not numba.config.CACHE_DIR and not any(os.access(place, os.W_OK) for place in (Path(__file__).parent, Path.home())):  # pyright: ignore
    numba.config.CACHE_DIR = str(Path(tempfile.gettempdir()) / "mocapfix-kernels")  # pyright: ignore
