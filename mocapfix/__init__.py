"""mocapfix cleans optical motion capture: a take in; the same file mended, a BVH, a report and a recording out.

From Python:

    import mocapfix
    result = mocapfix.clean("walk.c3d")  # .take .faults .subject .motion .report; .people where it shows several
    result.write("walk.mocapfix")

The names are imported when they are asked for: what a take needs is half a second of libraries, what --help needs is none.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mocapfix.errors import MocapfixError
    from mocapfix.fill import FillOptions
    from mocapfix.outputs import OutputOptions
    from mocapfix.pipeline import calibrated, clean
    from mocapfix.result import Result
    from mocapfix.take import Take

__all__ = ["FillOptions", "MocapfixError", "OutputOptions", "Result", "Take", "calibrated", "clean"]

HOMES = {
    "FillOptions": "fill",
    "MocapfixError": "errors",
    "OutputOptions": "outputs",
    "Result": "result",
    "Take": "take",
    "calibrated": "pipeline",
    "clean": "pipeline",
}


def __getattr__(name: str) -> object:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{HOMES[name]}"), name)
