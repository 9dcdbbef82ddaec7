"""Clean a BVH file: here one with a joint that flips for a few frames. Every other number stays as it is."""

from pathlib import Path

import mocapfix
from mocapfix.io.bvh import write_bvh
from mocapfix.synthetic import compose_take

truth, path = compose_take(seed=10, seconds=3.0), Path("animation.bvh")
rotations = truth.motion.local_rotations.copy()
arm = truth.subject.skeleton.names.index("LeftArm")
rotations[100:106, arm] = rotations[100:106, arm] @ [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
truth.motion.local_rotations[:] = rotations
write_bvh(path, truth.subject.skeleton, truth.motion, truth.rate)

result = mocapfix.clean(path, prior="none")
for change in result.changes:
    print(f"frames {change.first}-{change.last}: {change.kind}; {change.method}")
result.write("animation.mocapfix", overwrite=True)
