"""Writing what cleaning gives.

c3d, table, patched  a copy of the input, C3D, text or animation, with what was mended in it and nothing else changed
new_c3d, trc, csv    a take as a new file of that kind, whatever it was read from
bvh, bvh_for, gltf, asf_amc   a motion;  npz  all that is known, for programs
"""

from mocapfix.write.amc import asf_amc
from mocapfix.write.bvh import bvh, bvh_for
from mocapfix.write.c3d import c3d
from mocapfix.write.csv import csv
from mocapfix.write.gltf import gltf
from mocapfix.write.new_c3d import new_c3d
from mocapfix.write.npz import npz
from mocapfix.write.patched import patched
from mocapfix.write.table import table
from mocapfix.write.trc import trc

__all__ = ["asf_amc", "bvh", "bvh_for", "c3d", "csv", "gltf", "new_c3d", "npz", "patched", "table", "trc"]
