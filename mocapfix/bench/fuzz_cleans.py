"""Fuzzing of whole cleans: strange takes and animations are cleaned with random options and written.

A clean must end in outputs that can be read again, or in one sentence.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory

import numpy as np

from mocapfix.bench.fuzz_process import FuzzLimits
from mocapfix.bench.strange_takes import STRANGE_RATES_HZ, STRANGENESSES, Strange, compose_strange_take
from mocapfix.files.option_choices import EXTRA_FORMAT_NAMES, RIG_NAMES
from mocapfix.options import build_clean_options
from mocapfix.read.capture import read_capture
from mocapfix.skeleton import load_cmu31_body
from mocapfix.synthetic.motions import compose_motion
from mocapfix.synthetic.synthetic_takes import draw_subject
from mocapfix.take import Take
from mocapfix.write import write_bvh, write_c3d, write_csv, write_trc

CLEAN_FUZZ_LIMITS = FuzzLimits(slow_s=10.0, timeout_s=90.0)
ANIMATION_SHARE = 0.12
"""of the cases that are BVH files"""
MAX_STRANGENESSES = 3
"""of one take"""
OPTION_SHARE = 0.35
"""of the cases that are cleaned with other options than the default"""
RANDOM_OPTIONS: tuple[dict[str, object], ...] = (
    {"is_fast": True}, {"prior": "none"}, {"init_method": "registration"}, {"init_method": "previous"},
    {"prior_scope": "every-frame"}, {"known_sets_only": True}, {"marker_set": "cmu41"}, {"max_gap_s": 0.1},
    {"update_computed": True}, {"up_axis": "X"}, {"extra_formats": EXTRA_FORMAT_NAMES, "rigs": RIG_NAMES, "output_rate_hz": 24.0},
)  # fmt: skip
WRITERS = {"c3d": write_c3d, "trc": write_trc, "csv": write_csv}
WRITER_SHARES = (0.8, 0.1, 0.1)
ANIMATION_RATES_HZ = (30.0, 120.0)
ANIMATION_DURATION_S = 2.0
ANIMATION_FRAME_COUNTS = (1, 2, 3, 5, 30, 60)
STRANGE_FACTORS = (0.0, 0.01, 10.0, 1e3, -1.0)
STRANGE_CHANNEL_SDS = (0.1, 5.0, 90.0)
"""standard deviations of noise in degrees, and in centimetres of the root"""


@dataclass(frozen=True)
class CleanCase:
    """A file, and the options with which it is cleaned."""

    name: str
    data: bytes
    options: Mapping[str, object]

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.data)

    def save(self, folder: Path) -> None:
        """Write the file and the options."""
        (folder / self.name).write_bytes(self.data)
        (folder / "options.txt").write_text(f"{dict(self.options)}\n", encoding="utf-8")

    def run(self, folder: Path) -> str:
        """Clean the file, write all outputs and read the cleaned file again."""
        from mocapfix import pipeline  # as late as possible: it imports nearly everything

        path, output = folder / self.name, folder / "out"
        rmtree(output, ignore_errors=True)
        path.write_bytes(self.data)
        options = build_clean_options(**self.options)
        result = pipeline.clean(path, options)
        result.write(output, options=options.output)
        cleaned = read_capture(output / path.name)
        assert path.read_bytes() == self.data, "the input was changed"
        assert not isinstance(cleaned, Take) or not np.isinf(cleaned.markers).any(), "an output is infinite"
        return "body" if any(each.motion for each in result.subject_results or (result,)) else "no body"


def build_clean_case(seed: int) -> CleanCase:
    """Return the case of a seed."""
    rng = np.random.default_rng(seed)
    options = dict(RANDOM_OPTIONS[rng.integers(len(RANDOM_OPTIONS))]) if rng.random() < OPTION_SHARE else {}
    with TemporaryDirectory() as folder:
        is_animation = rng.random() < ANIMATION_SHARE
        suffix = "bvh" if is_animation else str(rng.choice(list(WRITERS), p=WRITER_SHARES))
        path = Path(folder) / f"strange-{seed}.{suffix}"
        if is_animation:
            path.write_bytes(compose_strange_animation(rng))
        else:
            take = draw_strange_take(rng)
            WRITERS[suffix](path, Take(take.markers, tuple(take.labels), take.rate))
        return CleanCase(path.name, path.read_bytes(), options)


def draw_strange_take(rng: np.random.Generator) -> Strange:
    """Return a take to which one to three strange things happened."""
    chosen = rng.permutation(len(STRANGENESSES))[: int(rng.integers(1, MAX_STRANGENESSES + 1))]
    return compose_strange_take(rng, tuple(STRANGENESSES[each] for each in chosen))


def compose_strange_animation(rng: np.random.Generator) -> bytes:
    """Return a BVH to whose channels, rate or joint names one to three strange things happened."""
    header, channels = _compose_animation(float(rng.choice(ANIMATION_RATES_HZ)))
    channels = channels[: int(rng.choice(ANIMATION_FRAME_COUNTS))].copy()
    hierarchy, frame_time = header.split("MOTION")[0], header.split()[-1]
    for kind in rng.permutation(9)[: int(rng.integers(1, MAX_STRANGENESSES + 1))]:
        columns = np.flatnonzero(rng.random(channels.shape[1]) < rng.choice([0.05, 0.5, 1.0]))
        frames = np.flatnonzero(rng.random(len(channels)) < rng.choice([0.02, 0.5, 1.0]))
        block = np.ix_(frames, columns)
        match kind:
            case 0:
                frame_time = repr(float(1 / rng.choice(STRANGE_RATES_HZ)))
            case 1:
                channels[block] = np.nan
            case 2:
                channels[block] += rng.normal(0, rng.choice(STRANGE_CHANNEL_SDS), (len(frames), len(columns)))
            case 3:
                channels[block] = 0.0
            case 4:
                channels[block] *= rng.choice(STRANGE_FACTORS)
            case 5:
                channels[:, columns] = channels[:1, columns]
            case 6:
                channels = channels[rng.permutation(len(channels))]
            case 7:
                hierarchy = re.sub(r"(JOINT|ROOT) \w+", lambda found: f"{found[1]} J{found.start()}", hierarchy)
            case _:
                factor = float(rng.choice(STRANGE_FACTORS))
                hierarchy = re.sub(r"-?\d+\.\d+", lambda found, factor=factor: f"{factor * float(found[0]):.6f}", hierarchy)
    rows = "\n".join(" ".join(f"{value:.4f}" for value in row) for row in channels.tolist())
    return f"{hierarchy}MOTION\nFrames: {len(channels)}\nFrame Time: {frame_time}\n{rows}\n".encode()


@cache
def _compose_animation(rate: float) -> tuple[str, np.ndarray]:
    """Return the text of a BVH before its rows of channels, and these."""
    subject = draw_subject(np.random.default_rng(0), asymmetric=False)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "animation.bvh"
        write_bvh(path, load_cmu31_body().skeleton, compose_motion(subject, ANIMATION_DURATION_S, rate), rate)
        lines = path.read_text(encoding="ascii").splitlines()
    first = next(index for index, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    return "\n".join(lines[:first]), np.array([[float(value) for value in line.split()] for line in lines[first:] if line])
