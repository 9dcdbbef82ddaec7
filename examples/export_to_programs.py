"""Write the solved skeleton for other programs: a BVH for Blender, glTF and NPZ, at 30 frames a second."""

from pathlib import Path

import mocapfix
from mocapfix.options import OutputOptions
from mocapfix.synthetic import compose_take, write_synthetic_take

path = Path("export.c3d")
write_synthetic_take(path, compose_take(seed=11, seconds=2.0))

result = mocapfix.clean(path, prior="none")
options = OutputOptions(extra_formats=("gltf", "npz"), rigs=("blender",), output_rate_hz=30.0)
for output in result.write("export.mocapfix", overwrite=True, options=options).values():
    print(output)
