"""Clean a composed take as a user would: written to a file, read and cleaned."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import mocapfix
from mocapfix import synthetic
from mocapfix.options import CleanOptions
from mocapfix.synthetic import SyntheticTake

if TYPE_CHECKING:
    from mocapfix.result import CleaningResult

DEFAULT_BENCH_OPTIONS = CleanOptions()


def clean_composed_take(truth: SyntheticTake, options: CleanOptions = DEFAULT_BENCH_OPTIONS) -> "CleaningResult":
    """Return the result of the pipeline for a composed take, which is written to a file and read."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "take.c3d"
        synthetic.write_synthetic_take(path, truth)
        return mocapfix.clean(path, options)
