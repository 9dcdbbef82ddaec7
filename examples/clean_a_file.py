"""Clean one file with the default options and write all outputs.

The example composes a take with gaps and spikes first; give your own file instead: `python clean_a_file.py walk.c3d`.
"""

import sys
from pathlib import Path

import mocapfix
from mocapfix.synthetic import compose_take, write_synthetic_take

if len(sys.argv) > 1:
    path = Path(sys.argv[1])
else:
    path = Path("example.c3d")
    write_synthetic_take(path, compose_take(seed=1, seconds=3.0))

result = mocapfix.clean(path)
outputs = result.write(path.with_suffix(".mocapfix"), overwrite=True)

fill = result.subject_report["fill"]
print(f"{fill['missing_before']} samples were missing, {fill['filled']} were filled, {fill['left_empty']} stay empty.")
for kind, output in outputs.items():
    print(f"{kind:>14}  {output}")
