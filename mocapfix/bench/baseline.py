"""The committed baseline, scenes/bench/baseline.json, and the comparison with it.

A baseline has for each quantity its value, by how much it may become worse, and which direction is better. The quantities are
measured by `baseline_measurements`.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

from pydantic import RootModel, ValidationError

from mocapfix.errors import SceneError
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.files.yaml_models import StrictModel


class BaselineEntry(StrictModel):
    """The committed value of one quantity.

    The quantity may become worse by `tolerance_percent` of the value, or by `tolerance` if that is more.
    """

    value: float
    tolerance_percent: float
    tolerance: float = 0.0
    is_higher_better: bool

    @property
    def allowed_change(self) -> float:
        """By how much the quantity may become worse."""
        return max(abs(self.value) * self.tolerance_percent / 100, self.tolerance)


@dataclass(frozen=True)
class BaselineComparison:
    """One quantity now and in the baseline.

    value           NaN if it was not measured
    change          positive if it became worse
    allowed_change  by how much it may become worse
    """

    name: str
    value: float
    baseline: float
    change: float
    allowed_change: float

    @property
    def change_percent(self) -> float:
        """The change in per cent of the baseline; infinite if that is zero and there is a change."""
        if self.baseline:
            return 100 * self.change / abs(self.baseline)
        return math.copysign(math.inf, self.change) if self.change else 0.0

    @property
    def is_worse(self) -> bool:
        """Whether the quantity became worse by more than it may, or was not measured."""
        return math.isnan(self.value) or self.change > self.allowed_change

    def to_json(self) -> dict[str, str | float | bool | None]:
        """Return all of it; None where JSON has no number."""
        numbers = {
            "value": self.value,
            "baseline": self.baseline,
            "change": self.change,
            "change_percent": self.change_percent,
            "allowed_change": self.allowed_change,
        }
        finite = {key: number if math.isfinite(number) else None for key, number in numbers.items()}
        return {"name": self.name, **finite, "is_worse": self.is_worse}


Entries = dict[str, BaselineEntry]


def get_baseline_path() -> Path:
    """Return the path of the committed baseline."""
    return find_shipped_folder("scenes") / "bench" / "baseline.json"


def compare_with_baseline(measured: Entries, baseline: Entries) -> list[BaselineComparison]:
    """Compare the quantities of the baseline with measured ones. Quantities that the baseline does not have are left out."""
    rows: list[BaselineComparison] = []
    for name, entry in baseline.items():
        value = measured[name].value if name in measured else math.nan
        change = entry.value - value if entry.is_higher_better else value - entry.value
        rows.append(BaselineComparison(name, value, entry.value, change, entry.allowed_change))
    return rows


def read_baseline(path: Path) -> Entries:
    """Read a baseline. Raises SceneError if the file cannot be read or has another form."""
    try:
        return RootModel[Entries].model_validate_json(path.read_bytes()).root
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror or error}).") from error
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(str(part) for part in problem["loc"]) or "the file"
        raise SceneError(f"{path}: {place}: {problem['msg']}; write a new one with --update.") from error


def write_baseline(path: Path, entries: Entries) -> None:
    """Write a baseline."""
    text = json.dumps({name: entry.model_dump() for name, entry in entries.items()}, indent=1)
    with replace_atomically(path) as part:
        Path(part).write_text(text + "\n", encoding="utf-8")
