"""List the faults of a file without changing anything."""

from pathlib import Path

import mocapfix
from mocapfix.synthetic import compose_take, write_synthetic_take

path = Path("inspect.c3d")
write_synthetic_take(path, compose_take(seed=3, seconds=3.0))

for report in mocapfix.inspect(path, prior="none"):
    print(f"{report['take']['file']}: {len(report['faults'])} faults")
    for fault in report["faults"][:10]:
        print(f"  frames {fault['first']}-{fault['last']}  {fault['kind']}: {fault['reason']}")
