"""A composed take as a C3D file, as a motion capture system would have exported it: millimetres, Z up, floats."""

from pathlib import Path

import numpy as np

from mocapfix.synthetic.truth import Truth
from mocapfix.take import Take
from mocapfix.write.new_c3d import new_c3d


def write(path: Path, truth: Truth) -> None:
    """Write the damaged take, its frames numbered from 1.

    Raises WriteError where the folder cannot be written.
    """
    markers = np.where(truth.struck[..., None], np.nan, truth.damaged)
    new_c3d(path, Take(markers, truth.labels, truth.rate))
