"""Sound takes whose truth is known, for faults to be put into.

Composed ones need nothing but mocapfix. Performed ones are recordings of people whom no model was trained on, at the rate at
which stages record. Either way somebody is drawn whose bones are crooked, whose skin slides and whom cameras see noisily.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from mocapfix import synthetic
from mocapfix.bench.limb import Performance, motion, performed
from mocapfix.errors import ReadError, SceneError
from mocapfix.motion import Motion
from mocapfix.synthetic import Truth
from mocapfix.synthetic.truth import person, worn

RATE, SECONDS = 120.0, 20.0  # of a take; of a recording that is longer, the beginning
SHORTEST = 8.0  # seconds: of what is shorter no take is made


def sound(data: Path | None, count: int) -> Iterator[tuple[str, Truth]]:
    """Yield `count` takes by name: composed, or performed where `data` holds the motion, as many as there are.

    Raises SceneError where less than one is asked for, ReadError where `data` holds no test.npz of motion long enough.
    """
    if count < 1:
        raise SceneError(f"There must be at least one take to put faults into, not {count}.")
    if data is None:
        for seed in range(count):
            yield f"seed {seed}", undamaged(synthetic.take(seed, SECONDS, RATE, crooked=True))
        return
    chosen = of_everybody(list(performed(data / "test.npz")), count)
    if not chosen:
        raise ReadError(f"{data / 'test.npz'}: holds no recording of {SHORTEST:g} s or longer.")
    for number, performance in enumerate(chosen):
        yield performance.name, acted(performance, np.random.default_rng(number))


def undamaged(truth: Truth) -> Truth:
    """-> the take as it would be had nothing gone wrong."""
    nothing = np.zeros_like(truth.struck)
    return replace(truth, damaged=truth.markers, struck=nothing, moved=nothing)


def of_everybody(performances: list[Performance], count: int) -> list[Performance]:
    """-> `count` recordings that are long enough: everybody's longest first, then everybody's second."""
    ranked: list[tuple[int, Performance]] = []
    for _, each in groupby(performances, lambda performance: performance.name.split("_")[0]):
        theirs = sorted(each, key=lambda performance: -_seconds(performance))
        ranked += [(rank, one) for rank, one in enumerate(theirs) if _seconds(one) >= SHORTEST]
    return [one for _, one in sorted(ranked, key=lambda pair: pair[0])][:count]


def acted(performance: Performance, rng: np.random.Generator) -> Truth:
    """-> the recording as a take of a drawn person who does the same."""
    subject, moves = person(rng, crooked=True), faster(performance)
    joints, markers = worn(rng, subject, moves, RATE)
    nothing = np.zeros(markers.shape[:2], bool)
    return Truth(moves, subject, joints, markers, markers, nothing, nothing, subject.labels, RATE)


def faster(performance: Performance) -> Motion:
    """-> the first SECONDS of its motion at RATE: splines through its frames, of rotations as of places, with no kinks."""
    count = min(performance.motion.frames, round(SECONDS * performance.rate))
    was = np.arange(count) / performance.rate
    now = np.arange(round(was[-1] * RATE) + 1) / RATE
    turns = performance.motion.rotations[:count]
    between = [RotationSpline(was, Rotation.from_matrix(turns[:, j]))(now).as_matrix() for j in range(turns.shape[1])]
    return motion(make_interp_spline(was, performance.motion.root[:count])(now), np.ascontiguousarray(np.stack(between, 1)))


def _seconds(performance: Performance) -> float:
    return performance.motion.frames / performance.rate
