"""Settings of hypothesis, and the fixtures of all tests: takes with known truth that are cleaned once, and the command line."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# Annotated types and array shapes are checked while the tests run, in the folders where every test passes with them; this costs
# little. MOCAPFIX_CHECK_TYPES=0 switches it off.
PACKAGE = Path(__file__).parent.parent / "mocapfix"
CHECKED_FOLDERS = ("contacts", "fill", "keypoints", "model", "report", "stats", "synthetic")
TYPE_CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"  # accepts an int as a float
if os.environ.get("MOCAPFIX_CHECK_TYPES") != "0":
    modules = [
        path.relative_to(PACKAGE.parent) for folder in CHECKED_FOLDERS for path in sorted((PACKAGE / folder).glob("[!_]*.py"))
    ]
    install_import_hook([".".join(module.with_suffix("").parts) for module in modules], TYPE_CHECKER)

from mocapfix import pipeline
from mocapfix.cli import app
from mocapfix.io.patches import patch_c3d
from mocapfix.pipeline import CleaningResult
from mocapfix.subject import library
from mocapfix.synthetic import SyntheticTake, compose_take, write_synthetic_take
from tests import faulty_take
from tests.c3d_files import c3d_bytes
from tests.faulty_take import AXIS_PARAMETERS, FaultyTake

# Few examples, no deadline (the first call of a kernel compiles it), and in CI the same examples every time.
settings.register_profile("mocapfix", deadline=None, max_examples=30, derandomize="CI" in os.environ)
settings.load_profile("mocapfix")

FIRST_FRAME = 301
"""the first frame number of the brief take"""


@dataclass(frozen=True)
class CleanedTake:
    """A synthetic take, its file, the result of cleaning it and the output files."""

    truth: SyntheticTake
    path: Path
    result: CleaningResult
    outputs: dict[str, Path]


@dataclass(frozen=True)
class BriefTake:
    """One second of the same person with frame numbers from FIRST_FRAME, for tests that need a take that is cleaned quickly.

    RELB is missing in the frames with indices 40 to 59 and LKNE in 70 to 89, and STRN has a spike of 0.2 m in 20.
    """

    path: Path
    subject: Path
    markers: np.ndarray
    labels: tuple[str, ...]


def damage_single_markers(truth: SyntheticTake) -> SyntheticTake:
    """Return a take with other damage: 8 gaps of 1 to 1.5 s, up to 60 short gaps, and spikes.

    Every gap is one of a single marker and ends before the take does.
    """
    rng, (frame_count, marker_count), rate = np.random.default_rng(3), truth.missing_mask.shape, truth.rate
    missing, shift = np.zeros((frame_count, marker_count), bool), np.zeros((frame_count, marker_count, 3))
    for marker in rng.permutation(marker_count)[:8]:
        length = round(rate * rng.uniform(1.0, 1.5))
        first = rng.integers(40, frame_count - length - 40)
        missing[first : first + length, marker] = True
    for _ in range(60):
        marker, length = rng.integers(marker_count), round(rate * rng.uniform(0.05, 0.3))
        first = rng.integers(30, frame_count - length - 30)
        if not missing[first - 20 : first + length + 20, marker].any():
            missing[first : first + length, marker] = True
    for marker in rng.permutation(marker_count)[:15]:
        first, direction = rng.integers(20, frame_count - 20), rng.normal(size=3)
        if not missing[first - 6 : first + 9, marker].any():
            shift[first : first + rng.integers(1, 4), marker] = direction / np.linalg.norm(direction) * rng.uniform(0.04, 0.3)
    damaged = np.where(missing[..., None], np.nan, truth.marker_positions + shift)
    return replace(truth, missing_mask=missing, damaged_positions=damaged, spike_mask=(shift != 0).any(axis=2))


@pytest.fixture(scope="session")
def cleaned(tmp_path_factory) -> CleanedTake:
    """Return a take of 6 s with gaps and spikes, cleaned."""
    folder = tmp_path_factory.mktemp("cleaned")
    truth, path = damage_single_markers(compose_take(seed=3, seconds=6.0)), folder / "walk.c3d"
    write_synthetic_take(path, truth)
    result = pipeline.clean(path)
    return CleanedTake(truth, path, result, result.write(folder / "walk.mocapfix"))


@pytest.fixture(scope="session")
def brief(cleaned, tmp_path_factory) -> BriefTake:
    """Return a take of 1 s of the person of `cleaned`, and the subject file of that person."""
    folder = tmp_path_factory.mktemp("brief")
    markers, labels = cleaned.truth.marker_positions[:120].copy(), cleaned.truth.labels
    markers[40:60, labels.index("RELB")] = np.nan
    markers[70:90, labels.index("LKNE")] = np.nan
    markers[20, labels.index("STRN")] += [0.2, 0.0, 0.0]
    path = folder / "brief.c3d"
    path.write_bytes(build_c3d(markers, labels, first=FIRST_FRAME))
    library.write_subject(folder / "known.yaml", cleaned.result.subject)
    return BriefTake(path, folder / "known.yaml", markers, labels)


@pytest.fixture(scope="session")
def faulty(tmp_path_factory) -> FaultyTake:
    """Return a take of 3 s with one fault of every kind that a reviewer decides on, cleaned."""
    folder = tmp_path_factory.mktemp("faulty")
    truth, path, output = compose_take(seed=3, seconds=3.0), folder / "faulty.c3d", folder / "cleaned.c3d"
    faulty_take.write_faulty_take(path, truth)
    result = pipeline.clean(path, subject=truth.subject)
    assert patch_c3d(output, result.input_take, result.take) == []
    return FaultyTake(path, truth.subject, truth.marker_positions, result, output)


def build_c3d(markers: np.ndarray, labels: Sequence[str], first: int = 1, rate: float = 120.0) -> bytes:
    """Return a C3D in millimetres, Z up, of markers (T, M, 3) in metres, Y up, NaN where missing. It names no cameras."""
    missing = np.isnan(markers[..., 0])
    counts = np.where(missing[..., None], 0.0, markers[..., [2, 0, 1]] * 1000)
    return c3d_bytes(counts, labels, np.where(missing, -1, 5), first=first, extra=AXIS_PARAMETERS | {"POINT:RATE": rate})


@pytest.fixture
def mocapfix(capsys):
    """Return a function that runs a command and returns its exit status, standard output and standard error."""

    def run(*arguments):
        with pytest.raises(SystemExit) as exit_info:
            app.run_command_line([str(each) for each in arguments])
        captured = capsys.readouterr()
        return exit_info.value.code, captured.out, captured.err

    return run
