"""Compare accuracy and speed with the committed baseline, scenes/bench/baseline.json.

A baseline has for each quantity its value, how many per cent worse it may become, and which direction is better. Speeds are
relative to scipy on the same machine in the same run, so that they can be compared between machines.
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import RootModel, ValidationError

from mocapfix.bench.demo import compute_fill_errors
from mocapfix.bench.solver_speed import measure_in_fresh_process
from mocapfix.bench.uncertainty import clean_composed_take, gather_fill_errors, gather_joint_errors, summarise_error_groups
from mocapfix.errors import SceneError
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.files.yaml_models import StrictModel
from mocapfix.synthetic.synthetic_takes import compose_take

BASELINE_SEEDS = (0, 1, 2)
ACCURACY_TOLERANCE_PERCENT = 2.0
"""Results are the same on the same versions of the libraries; other versions change the last digits."""
SPEED_TOLERANCE_PERCENT = 35.0
"""Ratios of speeds on shared machines vary by about a quarter."""


class BaselineEntry(StrictModel):
    """The committed value of one quantity."""

    value: float
    tolerance_percent: float
    is_higher_better: bool


@dataclass(frozen=True)
class BaselineComparison:
    """One quantity now and in the baseline.

    change_percent  positive if it became worse
    is_worse        whether it became worse by more than its tolerance
    """

    name: str
    value: float
    baseline: float
    change_percent: float
    tolerance_percent: float

    @property
    def is_worse(self) -> bool:
        return self.change_percent > self.tolerance_percent


def get_baseline_path() -> Path:
    """Return the path of the committed baseline."""
    return find_shipped_folder("scenes") / "bench" / "baseline.json"


def measure_baseline(report_progress: Callable[[str], None]) -> dict[str, BaselineEntry]:
    """Measure every quantity of the baseline. Takes about a minute."""
    entries: dict[str, BaselineEntry] = {}

    def add(name: str, value: float, tolerance_percent: float, is_higher_better: bool = False) -> None:
        entries[name] = BaselineEntry(
            value=round(value, 4), tolerance_percent=tolerance_percent, is_higher_better=is_higher_better
        )

    joints: list[Any] = []
    fills: list[Any] = []
    duration_s = 0.0
    for seed in BASELINE_SEEDS:
        report_progress(f"take {seed}")
        truth = compose_take(seed=seed)
        clean_composed_take(truth)  # the first clean in a process compiles and loads the kernels
        start = time.perf_counter()
        result = clean_composed_take(truth)
        duration_s += time.perf_counter() - start
        joints.append(gather_joint_errors(truth, result))
        fills.append(gather_fill_errors(truth, result))
        if seed == 0:
            for damage, error_mm in compute_fill_errors(truth, result)["mocapfix"].items():
                add(f"demo: {damage}, mm", error_mm, ACCURACY_TOLERANCE_PERCENT)
    for name, groups in (("joints", joints), ("filled markers", fills)):
        summary = summarise_error_groups(groups)
        add(f"{name}: error, mm", summary["error_mm"], ACCURACY_TOLERANCE_PERCENT)
        add(f"{name}: within two predicted SD", summary["within_2_sigma"], ACCURACY_TOLERANCE_PERCENT, True)
    report_progress("solver")
    solver = measure_in_fresh_process(True)
    for name in ("clean", "noisy"):
        add(f"solver, {name}: joint error, mm", solver["joint_error_mm"][name], ACCURACY_TOLERANCE_PERCENT)
        add(f"solver, {name}: speed relative to scipy", solver["over_scipy"][name], SPEED_TOLERANCE_PERCENT, True)
    scipy_frames = duration_s / len(BASELINE_SEEDS) * solver["scipy_fps"]["noisy"]
    add("whole clean of 10 s: time in frames of scipy", scipy_frames, SPEED_TOLERANCE_PERCENT)
    return entries


def compare_with_baseline(measured: dict[str, BaselineEntry], baseline: dict[str, BaselineEntry]) -> list[BaselineComparison]:
    """Compare measured quantities with the baseline. Quantities that only one of them has are left out."""
    rows: list[BaselineComparison] = []
    for name, entry in baseline.items():
        if name in measured and entry.value:
            change = 100 * (measured[name].value - entry.value) / entry.value
            worse = -change if entry.is_higher_better else change
            rows.append(BaselineComparison(name, measured[name].value, entry.value, worse, entry.tolerance_percent))
    return rows


def read_baseline(path: Path) -> dict[str, BaselineEntry]:
    """Read a baseline. Raises SceneError if the file cannot be read or has another form."""
    try:
        return RootModel[dict[str, BaselineEntry]].model_validate_json(path.read_bytes()).root
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(str(part) for part in problem["loc"]) or "the file"
        raise SceneError(f"{path}: {place}: {problem['msg']}; write a new one with --update.") from error


def write_baseline(path: Path, entries: dict[str, BaselineEntry]) -> None:
    """Write a baseline."""
    text = json.dumps({name: entry.model_dump() for name, entry in entries.items()}, indent=1)
    with replace_atomically(path) as part:
        Path(part).write_text(text + "\n", encoding="utf-8")
