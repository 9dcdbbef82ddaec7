"""Captures in all axes and in other units: each must be read upright and in scale, or refused.

The 48 permutations of the axes with signs are applied to the points as a reader returns them, before the unit, the up axis and
the handedness are decided; half of them are left-handed. `clean_in_other_axes` writes such a file and cleans it.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import MocapfixError, ReadError
from mocapfix.io.capture import read_take
from mocapfix.io.conventions import DeclaredConvention, decide_convention
from mocapfix.io.coordinates import InspectedPoints
from mocapfix.model.take import C3dLayout, Take
from mocapfix.options import ReadOptions

AXIS_PERMUTATIONS: tuple[Float[np.ndarray, "3 3"], ...] = tuple(
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
)
UNIT_FACTORS = (1000.0, 100.0, 10.0, 0.1, 0.001, 25.4)
MAX_MARKER_DIFFERENCE_M = 0.001  # of a clean in other axes from the usual one
WRONG = "wrong"


@dataclass(frozen=True)
class ConventionCounts:
    """How often a capture was read upright and in scale, was refused, or was wrong.

    Attributes:
        name: The capture.
        right_handed: Outcomes in 24 axes, once for each axis that a C3D may declare, and for none.
        left_handed: The same of the 24 mirrored axes.
        mirrored: The same of these with --mirror.
        units: Outcomes in other units.
    """

    name: str
    right_handed: Counter[str]
    left_handed: Counter[str]
    mirrored: Counter[str]
    units: Counter[str]


def measure_conventions(paths: Sequence[Path], report_progress: Callable[[str], None] = lambda _: None) -> list[ConventionCounts]:
    """Return the outcomes for captures with labels."""
    counts: list[ConventionCounts] = []
    for path in paths:
        report_progress(path.name)
        counts.append(count_outcomes(read_take(path)))
    return counts


def count_outcomes(take: Take) -> ConventionCounts:
    """Return the outcomes for a capture whose own axes and unit are right."""
    assert take.layout is not None
    rotation, unit_m, name = take.layout.rotation_y_up_file, take.layout.unit_m, take.path.name if take.path else ""
    in_file = take.markers @ rotation
    counts = ConventionCounts(name, Counter(), Counter(), Counter(), Counter())
    for axes in AXIS_PERMUTATIONS:
        is_left_handed = bool(np.linalg.det(axes) < 0)
        points, up = build_inspected_points(take, in_file @ axes.T), axes @ rotation.T @ [0.0, 1.0, 0.0]
        for declared_axis in ("", "X", "Y", "Z") if isinstance(take.layout, C3dLayout) else ("",):
            declared = DeclaredConvention(unit_m, up_axis=declared_axis, up_basis="POINT:Y_SCREEN")
            outcome = judge(points, declared, ReadOptions(), up, is_left_handed, unit_m)
            (counts.left_handed if is_left_handed else counts.right_handed)[outcome] += 1
            if is_left_handed:
                counts.mirrored[judge(points, declared, ReadOptions(mirror=True), up, False, unit_m)] += 1
    for factor in UNIT_FACTORS:
        points, up = build_inspected_points(take, in_file * factor), rotation.T @ [0.0, 1.0, 0.0]
        counts.units[judge(points, DeclaredConvention(unit_m), ReadOptions(), up, False, unit_m / factor)] += 1
    return counts


def build_inspected_points(take: Take, positions_file: Float[np.ndarray, "T M 3"]) -> InspectedPoints:
    """Return other positions of the markers of a take as the points of a file."""

    def convert(
        columns: Int[np.ndarray, " K"], frames: slice | Int[np.ndarray, " F"] = slice(None)
    ) -> Float[np.ndarray, "F K 3"]:
        return positions_file[frames][:, columns]

    return InspectedPoints(take.labels, np.arange(len(take.labels)), take.frame_count, take.rate, convert)


def judge(
    points: InspectedPoints,
    declared: DeclaredConvention,
    options: ReadOptions,
    up_file: Float[np.ndarray, "3"],
    is_left_handed: bool,
    unit_m: float,
) -> str:
    """Return "right", "refused" or "wrong" for a file whose true up direction, handedness and unit are given."""
    try:
        found = decide_convention(Path("take"), points, declared, options)
    except ReadError:
        return "refused"
    is_upright = (found.rotation_y_up_file @ up_file)[1] > 1 - 1e-9
    is_in_scale = abs(found.unit_m / unit_m - 1) < 1e-6
    return "right" if is_upright and is_in_scale and not is_left_handed else WRONG


def clean_in_other_axes(path: Path, count: int, seed: int = 0) -> Counter[str]:
    """Return the outcomes of cleaning a C3D in `count` axes, right- and left-handed in turn, compared with cleaning it as it is.

    A clean is right if its markers are at the heights of the usual one, and if the file is right-handed.
    """
    from mocapfix import pipeline  # reading needs none of its layers

    usual = pipeline.clean(path, prior="none")
    layout, data = usual.input_take.layout, path.read_bytes()
    assert isinstance(layout, C3dLayout)
    outcomes: Counter[str] = Counter()
    order = np.random.default_rng(seed).permutation(len(AXIS_PERMUTATIONS))
    by_hand = sorted((AXIS_PERMUTATIONS[i] for i in order), key=np.linalg.det)  # the left-handed ones first
    for axes in itertools.islice(itertools.chain.from_iterable(zip(by_hand[::-1], by_hand, strict=True)), count):
        changed = bytearray(data)
        words = layout.view_words(changed)
        sources = np.abs(axes).argmax(1)
        signs = axes.sum(1).astype(words.dtype)
        words[..., :3] = words[..., sources] * signs
        with TemporaryDirectory() as folder:
            target = Path(folder) / path.name
            target.write_bytes(changed)
            try:
                result = pipeline.clean(target, prior="none")
            except MocapfixError:
                outcomes["refused"] += 1
                continue
        heights = result.take.markers[..., 1] - usual.take.markers[..., 1]
        is_same = np.linalg.det(axes) > 0 and np.nanquantile(np.abs(heights), 0.99) < MAX_MARKER_DIFFERENCE_M
        outcomes["right" if is_same else WRONG] += 1
    return outcomes
