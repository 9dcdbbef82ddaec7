"""Writing what cleaning a take gives.

c3d, table   a copy of the input, C3D or text, with the mended samples in it and nothing else changed
new_c3d, trc, csv   a take as a new file of that kind, whatever it was read from
bvh          a motion
"""

from mocapfix.write.bvh import bvh
from mocapfix.write.c3d import c3d
from mocapfix.write.csv import csv
from mocapfix.write.new_c3d import new_c3d
from mocapfix.write.table import table
from mocapfix.write.trc import trc

__all__ = ["bvh", "c3d", "csv", "new_c3d", "table", "trc"]
