"""Reject one change and clean again: its samples stay as they were, everything else is the same."""

from pathlib import Path

import yaml

import mocapfix
from mocapfix.synthetic import compose_take, write_synthetic_take

path, folder = Path("review.c3d"), Path("review.mocapfix")
write_synthetic_take(path, compose_take(seed=5, seconds=3.0))
outputs = mocapfix.clean(path, prior="none").write(folder, overwrite=True)

changes_path = outputs["changes.yaml"]
review = yaml.safe_load(changes_path.read_text(encoding="utf-8"))
rejected = review["changes"][0]
rejected["decision"] = "reject"  # or "keep": leave the samples as they are and use them in the solve
changes_path.write_text(yaml.safe_dump(review, sort_keys=False), encoding="utf-8")

again = mocapfix.clean(path, prior="none", review_files=[changes_path])
print(f"rejected {rejected['id']}: {[c.decision for c in again.changes if c.id == rejected['id']]}")
