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
from mocapfix.bench.lost_limbs import PerformedMotion, build_known_motion, read_performed_motions
from mocapfix.errors import ReadError, SceneError
from mocapfix.motion import Motion
from mocapfix.synthetic import SyntheticTake
from mocapfix.synthetic.synthetic_takes import draw_subject, simulate_markers

SOUND_TAKE_RATE_HZ, SOUND_TAKE_DURATION_S = 120.0, 20.0  # of a take; of a recording that is longer, the beginning
MIN_RECORDING_S = 8.0  # seconds: of what is shorter no take is made


def iterate_sound_takes(motion_folder: Path | None, take_count: int) -> Iterator[tuple[str, SyntheticTake]]:
    """Yield `count` takes by name: composed, or performed where `data` holds the motion, as many as there are.

    Raises SceneError where less than one is asked for, ReadError where `data` holds no test.npz of motion long enough.
    """
    if take_count < 1:
        raise SceneError(f"There must be at least one take to put faults into, not {take_count}.")
    if motion_folder is None:
        for seed in range(take_count):
            yield (
                f"seed {seed}",
                remove_damage(synthetic.compose_take(seed, SOUND_TAKE_DURATION_S, SOUND_TAKE_RATE_HZ, asymmetric=True)),
            )
        return
    chosen = choose_performances(list(read_performed_motions(motion_folder / "test.npz")), take_count)
    if not chosen:
        raise ReadError(f"{motion_folder / 'test.npz'}: holds no recording of {MIN_RECORDING_S:g} s or longer.")
    for number, performance in enumerate(chosen):
        yield performance.name, perform_take(performance, np.random.default_rng(number))


def remove_damage(truth: SyntheticTake) -> SyntheticTake:
    """-> the take as it would be had nothing gone wrong."""
    nothing = np.zeros_like(truth.missing_mask)
    return replace(truth, damaged_positions=truth.marker_positions, missing_mask=nothing, spike_mask=nothing)


def choose_performances(performances: list[PerformedMotion], take_count: int) -> list[PerformedMotion]:
    """-> `count` recordings that are long enough: everybody's longest first, then everybody's second."""
    ranked: list[tuple[int, PerformedMotion]] = []
    for _, each in groupby(performances, lambda performance: performance.name.split("_")[0]):
        theirs = sorted(each, key=lambda performance: -_compute_duration_s(performance))
        ranked += [(rank, one) for rank, one in enumerate(theirs) if _compute_duration_s(one) >= MIN_RECORDING_S]
    return [one for _, one in sorted(ranked, key=lambda pair: pair[0])][:take_count]


def perform_take(performance: PerformedMotion, rng: np.random.Generator) -> SyntheticTake:
    """-> the recording as a take of a drawn person who does the same."""
    subject, moves = draw_subject(rng, asymmetric=True), resample_performance(performance)
    joints, markers = simulate_markers(rng, subject, moves, SOUND_TAKE_RATE_HZ)
    nothing = np.zeros(markers.shape[:2], bool)
    return SyntheticTake(moves, subject, joints, markers, markers, nothing, nothing, subject.labels, SOUND_TAKE_RATE_HZ)


def resample_performance(performance: PerformedMotion) -> Motion:
    """-> the first SECONDS of its motion at RATE: splines through its frames, of rotations as of places, with no kinks."""
    count = min(performance.motion.frame_count, round(SOUND_TAKE_DURATION_S * performance.rate_hz))
    was = np.arange(count) / performance.rate_hz
    now = np.arange(round(was[-1] * SOUND_TAKE_RATE_HZ) + 1) / SOUND_TAKE_RATE_HZ
    turns = performance.motion.local_rotations[:count]
    between = [RotationSpline(was, Rotation.from_matrix(turns[:, j]))(now).as_matrix() for j in range(turns.shape[1])]
    return build_known_motion(
        make_interp_spline(was, performance.motion.root_position[:count])(now), np.ascontiguousarray(np.stack(between, 1))
    )


def _compute_duration_s(performance: PerformedMotion) -> float:
    return performance.motion.frame_count / performance.rate_hz
