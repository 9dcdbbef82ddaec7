"""mocapfix cleans optical motion capture: C3D in; a mended C3D, a BVH, a report and a recording out."""
