"""Calibrate a person once, from a take in which every joint moves, and use the subject for their other takes."""

from pathlib import Path

import mocapfix
from mocapfix.subject.library import write_subject
from mocapfix.synthetic import compose_take, write_synthetic_take

range_of_motion, walk = Path("rom.c3d"), Path("walk.c3d")
write_synthetic_take(range_of_motion, compose_take(seed=4, seconds=5.0))
write_synthetic_take(walk, compose_take(seed=4, seconds=2.0))

subject = mocapfix.calibrate_takes([range_of_motion])
write_subject("subject.yaml", subject)  # readable and editable

# marker_offsets (K, 3) are in metres, in the rest axes of the joint that carries the marker.
for label, joint, offset in list(zip(subject.labels, subject.joints, subject.marker_offsets, strict=True))[:5]:
    x, y, z = offset * 1e3
    print(f"{label} is on {subject.skeleton.names[joint]} at {x:.0f}, {y:.0f}, {z:.0f} mm")

result = mocapfix.clean(walk, subject="subject.yaml", prior="none")
solve = result.subject_report["solve"]
if solve is not None:  # None without a body
    print(f"mean marker residual: {solve['marker_residual_mm']['mean']} mm")
