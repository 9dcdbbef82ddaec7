"""mocapfix cleans optical motion capture: a capture file is repaired, and a body is solved from it.

    import mocapfix
    result = mocapfix.clean("walk.c3d")
    result.write("walk.mocapfix")

Public names are imported on first use: the numerical libraries take half a second to import, and `--help` needs none of them.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mocapfix.errors import MocapfixError
    from mocapfix.model.take import Take
    from mocapfix.options import CleanOptions, build_clean_options
    from mocapfix.pipeline import clean, inspect, label
    from mocapfix.result import CleaningResult
    from mocapfix.surveys import calibrate_takes

__all__ = [
    "CleanOptions",
    "CleaningResult",
    "MocapfixError",
    "Take",
    "build_clean_options",
    "calibrate_takes",
    "clean",
    "inspect",
    "label",
]

MODULE_OF_NAME = {
    "CleanOptions": "options",
    "CleaningResult": "result",
    "MocapfixError": "errors",
    "Take": "model.take",
    "build_clean_options": "options",
    "calibrate_takes": "surveys",
    "clean": "pipeline",
    "inspect": "pipeline",
    "label": "pipeline",
}


def __getattr__(name: str) -> object:
    if name not in MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{MODULE_OF_NAME[name]}"), name)
