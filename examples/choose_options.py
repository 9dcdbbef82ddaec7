"""Set options: single ones by name, or all of them as one object that can be stored and reused."""

from pathlib import Path

import mocapfix
from mocapfix.options import FillOptions, PriorOptions
from mocapfix.synthetic import compose_take, write_synthetic_take

path = Path("options.c3d")
write_synthetic_take(path, compose_take(seed=2, seconds=3.0))

# By name: leave gaps longer than half a second empty, and use no trained prior.
short_gaps = mocapfix.clean(path, max_gap_s=0.5, prior="none")

# As an object: leave a sample empty if its predicted standard deviation exceeds 30 mm.
options = mocapfix.CleanOptions(prior=PriorOptions(prior="none"), fill=FillOptions(max_sd_m=0.030))
certain_only = mocapfix.clean(path, options)

for name, result in (("max_gap_s=0.5", short_gaps), ("max_sd_m=0.030", certain_only)):
    print(f"{name}: {result.subject_report['fill']['left_empty']} samples stay empty")
