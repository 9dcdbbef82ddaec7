"""Cleaning a take again from the review."""

import json
from pathlib import Path

from mocapfix.review.review_session import build_clean_command
from mocapfix.review.take_files import find_cleaned_takes


def test_preview_is_cleaned_in_full(folder: Path):
    path = folder / "walk.report.json"
    report = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**report, "arguments": [*report["arguments"], "--fast"]}), encoding="utf-8")
    (take,) = find_cleaned_takes(folder)
    assert take.options.initialise.is_fast
    command = build_clean_command(take, [take], ["gltf"], [])
    assert "--fast" not in command
    assert command[-5:] == ["--changes", "walk.changes.yaml", "--out", ".", "--overwrite"]
