"""How hypothesis draws, and one take with known truth that is cleaned once and that all tests look at."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from mocapfix import pipeline, synthetic, write
from mocapfix.calibrate import subject_file
from mocapfix.cli import app
from mocapfix.pipeline import CleaningResult
from mocapfix.synthetic import SyntheticTake
from tests import muddled as muddling
from tests.c3d_files import c3d_bytes
from tests.muddled import FEET_UP, Muddled

# few examples, no deadline (the first call of a kernel compiles it), the same ones every time in CI
settings.register_profile("mocapfix", deadline=None, max_examples=30, derandomize="CI" in os.environ)
settings.load_profile("mocapfix")

FIRST = 301  # the file's number of the brief take's first frame


@dataclass(frozen=True)
class Cleaned:
    """A composed take, its file, and what came of it."""

    truth: SyntheticTake
    path: Path
    result: CleaningResult
    outputs: dict[str, Path]


@dataclass(frozen=True)
class Brief:
    """One second of the same person, frames numbered from FIRST: for whatever needs a take that is cleaned soon.

    RELB is missing in indices 40-59 and LKNE in 70-89, and STRN jumps by 0.2 m in 20.
    """

    path: Path
    subject: Path
    markers: np.ndarray
    labels: tuple[str, ...]


def struck_by_hand(truth: SyntheticTake) -> SyntheticTake:
    """The take with other damage: single markers' gaps only, all of them inside; 8 of 1 to 1.5 s, 60 short ones, spikes."""
    rng, (frames, count), rate = np.random.default_rng(3), truth.missing_mask.shape, truth.rate
    struck, shift = np.zeros((frames, count), bool), np.zeros((frames, count, 3))
    for marker in rng.permutation(count)[:8]:
        length = round(rate * rng.uniform(1.0, 1.5))
        first = rng.integers(40, frames - length - 40)
        struck[first : first + length, marker] = True
    for _ in range(60):
        marker, length = rng.integers(count), round(rate * rng.uniform(0.05, 0.3))
        first = rng.integers(30, frames - length - 30)
        if not struck[first - 20 : first + length + 20, marker].any():
            struck[first : first + length, marker] = True
    for marker in rng.permutation(count)[:15]:
        first, way = rng.integers(20, frames - 20), rng.normal(size=3)
        if not struck[first - 6 : first + 9, marker].any():
            shift[first : first + rng.integers(1, 4), marker] = way / np.linalg.norm(way) * rng.uniform(0.04, 0.3)
    damaged = np.where(struck[..., None], np.nan, truth.marker_positions + shift)
    return replace(truth, missing_mask=struck, damaged_positions=damaged, spike_mask=(shift != 0).any(axis=2))


@pytest.fixture(scope="session")
def cleaned(tmp_path_factory) -> Cleaned:
    folder = tmp_path_factory.mktemp("cleaned")
    truth, path = struck_by_hand(synthetic.compose_take(seed=3, seconds=6.0)), folder / "somebody.c3d"
    synthetic.write_synthetic_take(path, truth)
    result = pipeline.clean(path)
    return Cleaned(truth, path, result, result.write(folder / "somebody.mocapfix"))


@pytest.fixture(scope="session")
def brief(cleaned, tmp_path_factory) -> Brief:
    folder = tmp_path_factory.mktemp("brief")
    markers, labels = cleaned.truth.marker_positions[:120].copy(), cleaned.truth.labels
    markers[40:60, labels.index("RELB")] = np.nan
    markers[70:90, labels.index("LKNE")] = np.nan
    markers[20, labels.index("STRN")] += [0.2, 0.0, 0.0]
    path = folder / "brief.c3d"
    path.write_bytes(as_c3d(markers, labels, first=FIRST))
    subject_file.write_subject(folder / "known.yaml", cleaned.result.subject)
    return Brief(path, folder / "known.yaml", markers, labels)


@pytest.fixture(scope="session")
def muddled(tmp_path_factory) -> Muddled:
    folder = tmp_path_factory.mktemp("muddled")
    truth, path, output = synthetic.compose_take(seed=3, seconds=3.0), folder / "muddled.c3d", folder / "cleaned.c3d"
    muddling.write(path, truth)
    result = pipeline.clean(path, subject=truth.subject)
    assert write.patch_c3d(output, result.input_take, result.take) == []
    return Muddled(path, truth.subject, truth.marker_positions, result, output)


def as_c3d(markers: np.ndarray, labels, first: int = 1, rate: float = 120.0) -> bytes:
    """-> a C3D in millimetres, Z up, of markers (T, M, 3) in metres, Y up, NaN where missing; without cameras."""
    missing = np.isnan(markers[..., 0])
    counts = np.where(missing[..., None], 0.0, markers[..., [2, 0, 1]] * 1000)
    return c3d_bytes(counts, labels, np.where(missing, -1, 5), first=first, extra=FEET_UP | {"POINT:RATE": rate})


@pytest.fixture
def mocapfix(capsys):
    """-> run a command: exit status, standard output, standard error"""

    def run(*arguments):
        with pytest.raises(SystemExit) as left:
            app.run_command_line([str(each) for each in arguments])
        said = capsys.readouterr()
        return left.value.code, said.out, said.err

    return run
