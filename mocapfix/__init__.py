"""mocapfix cleans optical motion capture: a take in; the same file mended, a BVH, a report and a recording out.

From Python:

    import mocapfix
    result = mocapfix.pipeline.clean("walk.c3d")  # .take .faults .subject .motion .report; .people where it shows several
    result.write("walk.mocapfix")

The names are imported when they are asked for: what a take needs is half a second of libraries, what --help needs is none.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mocapfix.errors import MocapfixError
    from mocapfix.fill.gap_filling import FillOptions
    from mocapfix.pipeline import calibrate, clean, inspect
    from mocapfix.result import CleaningResult
    from mocapfix.take import Take
    from mocapfix.write.output_options import OutputOptions

__all__ = ["CleaningResult", "FillOptions", "MocapfixError", "OutputOptions", "Take", "calibrate", "clean", "inspect"]

MODULE_OF_NAME = {
    "CleaningResult": "result",
    "FillOptions": "fill.gap_filling",
    "MocapfixError": "errors",
    "OutputOptions": "write.output_options",
    "Take": "take",
    "calibrate": "pipeline",
    "clean": "pipeline",
    "inspect": "pipeline",
}


def __getattr__(name: str) -> object:
    if name not in MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{MODULE_OF_NAME[name]}"), name)
