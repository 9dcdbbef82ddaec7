"""Sessions with known truth: several takes of each of several people, with gaps, the same body and markers in all of a person's
takes.

The motion is recorded by people that no model was trained on. Where a person has too few long recordings, others' are played on
that person's body; recordings shorter than a take are played forwards and backwards. Without recordings the motion is composed.
"""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix.bench.common_task import build_known_motion
from mocapfix.bench.sound_takes import (
    SOUND_TAKE_DURATION_S,
    SOUND_TAKE_RATE_HZ,
    PerformedMotion,
    read_performed_motions,
    resample_performance,
)
from mocapfix.errors import ReadError
from mocapfix.motion import Motion
from mocapfix.subject import Subject
from mocapfix.synthetic import SyntheticTake
from mocapfix.synthetic.motions import compose_motion
from mocapfix.synthetic.synthetic_takes import DAMAGED_ARM_JOINTS, draw_gaps, draw_subject, simulate_markers

MIN_OWN_RECORDING_S = 4.0
"""Shorter recordings are not used."""
COMPOSED_SEGMENT_S = 20.0
"""Duration of the whole composed motion, from which takes of other motion are cut."""


class SessionPerson(NamedTuple):
    """A person with the true body, and the takes of that person."""

    name: str
    subject: Subject
    takes: tuple[SyntheticTake, ...]


def build_session_people(
    motion_files: list[Path], people: tuple[str, ...], take_count: int, duration_s: float = SOUND_TAKE_DURATION_S
) -> list[SessionPerson]:
    """Return people with `take_count` takes each.

    motion_files  shards of recordings; empty for composed motion
    people        names of the recorded subjects, whose own motion is preferred

    Raises ReadError if the recordings do not suffice for a single take.
    """
    if not motion_files:
        return [_compose_person(name, number, take_count, duration_s) for number, name in enumerate(people)]
    recorded = [each for path in motion_files for each in read_performed_motions(path)]
    recorded = [each for each in recorded if _compute_length_s(each) >= MIN_OWN_RECORDING_S]
    if not recorded:
        raise ReadError(f"{motion_files[0]}: holds no recording of {MIN_OWN_RECORDING_S:g} s or longer.")
    by_person: dict[str, list[PerformedMotion]] = defaultdict(list)
    for each in sorted(recorded, key=lambda each: -_compute_length_s(each)):
        by_person[each.name.split("_")[0]].append(each)
    return [_record_person(name, number, by_person, take_count, duration_s) for number, name in enumerate(people)]


def _record_person(
    name: str, number: int, by_person: dict[str, list[PerformedMotion]], take_count: int, duration_s: float
) -> SessionPerson:
    """Return one person with that person's own recordings, then those of the others in turn."""
    rng = np.random.default_rng(1000 + number)
    subject = draw_subject(rng, asymmetric=True)
    others = [each for other, motions in by_person.items() if other != name for each in motions[:2]]
    turn = number * take_count % max(1, len(others))
    chosen = [*by_person.get(name, []), *others[turn:], *others[:turn]][:take_count]
    motions = [_play_to_duration(resample_performance(each), duration_s) for each in chosen]
    return SessionPerson(name, subject, tuple(record_take(rng, subject, motion) for motion in motions))


def _compose_person(name: str, number: int, take_count: int, duration_s: float) -> SessionPerson:
    """Return one person whose takes are successive parts of the composed motion."""
    rng = np.random.default_rng(1000 + number)
    subject = draw_subject(rng, asymmetric=True)
    whole = compose_motion(subject, COMPOSED_SEGMENT_S, SOUND_TAKE_RATE_HZ)
    length, takes = round(duration_s * SOUND_TAKE_RATE_HZ), list[SyntheticTake]()
    for take in range(take_count):
        first = round(take * (whole.frame_count - length) / max(1, take_count - 1)) if length < whole.frame_count else 0
        part = _play_to_duration(_cut_motion(whole, first, min(length, whole.frame_count - first)), duration_s)
        takes.append(record_take(rng, subject, part))
    return SessionPerson(name, subject, tuple(takes))


def record_take(rng: np.random.Generator, subject: Subject, motion: Motion) -> SyntheticTake:
    """Return a take of a motion with the skin's sliding, camera noise and gaps."""
    joints, markers = simulate_markers(rng, subject, motion, SOUND_TAKE_RATE_HZ)
    is_arm = np.isin(subject.joints, [subject.skeleton.find_joint(name) for name in DAMAGED_ARM_JOINTS])
    missing = draw_gaps(rng, motion.frame_count, SOUND_TAKE_RATE_HZ, is_arm)
    damaged = np.where(missing[..., None], np.nan, markers)
    no_spikes = np.zeros_like(missing)
    return SyntheticTake(motion, subject, joints, markers, damaged, missing, no_spikes, subject.labels, SOUND_TAKE_RATE_HZ)


def move_marker(subject: Subject, rng: np.random.Generator, distance_m: float) -> tuple[Subject, int]:
    """Return the subject with one marker moved in a random direction, and the marker."""
    marker, direction = int(rng.integers(len(subject.labels))), rng.normal(size=3)
    offsets = subject.marker_offsets.copy()
    offsets[marker] += distance_m * direction / np.linalg.norm(direction)
    return replace(subject, marker_offsets=offsets), marker


def _play_to_duration(motion: Motion, duration_s: float) -> Motion:
    """Return a motion played forwards and backwards until it has the duration."""
    frame_count = motion.frame_count
    turns = np.r_[np.arange(frame_count), np.arange(frame_count - 2, 0, -1)]
    frames = np.resize(turns, round(duration_s * SOUND_TAKE_RATE_HZ))
    return build_known_motion(motion.root_position[frames], np.ascontiguousarray(motion.local_rotations[frames]))


def _cut_motion(motion: Motion, first: int, length: int) -> Motion:
    part = slice(first, first + length)
    return build_known_motion(motion.root_position[part], np.ascontiguousarray(motion.local_rotations[part]))


def _compute_length_s(performance: PerformedMotion) -> float:
    return performance.motion.frame_count / performance.rate_hz
