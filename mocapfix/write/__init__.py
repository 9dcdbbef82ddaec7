"""Writers: changed copies of source files, takes and motions as new files, and the list of output formats.

`patch_*` functions write a copy of the source file in which only the changed samples differ. `write_*` functions write new files,
whatever the take was read from.
"""

from mocapfix.write.asf_amc import write_asf_amc
from mocapfix.write.bvh import write_bvh, write_rig_bvh
from mocapfix.write.c3d import write_c3d
from mocapfix.write.gltf import write_gltf
from mocapfix.write.npz import write_npz
from mocapfix.write.patches import patch_animation, patch_c3d, patch_table
from mocapfix.write.text_tables import write_csv, write_trc

__all__ = [
    "patch_animation",
    "patch_c3d",
    "patch_table",
    "write_asf_amc",
    "write_bvh",
    "write_c3d",
    "write_csv",
    "write_gltf",
    "write_npz",
    "write_rig_bvh",
    "write_trc",
]
