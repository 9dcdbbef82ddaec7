"""mocapfix cleans optical motion capture: C3D in; a mended C3D, a BVH, a report and a recording out.

From Python:

    import mocapfix
    result = mocapfix.clean("walk.c3d")  # .take .faults .subject .motion .report
    result.write("walk.mocapfix")
"""

from mocapfix.errors import MocapfixError
from mocapfix.fill import FillOptions
from mocapfix.pipeline import calibrated, clean
from mocapfix.result import Result
from mocapfix.take import Take

__all__ = ["FillOptions", "MocapfixError", "Result", "Take", "calibrated", "clean"]
