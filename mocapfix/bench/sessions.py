"""Benchmark of sessions: takes of the same people cleaned alone, and with the person calibrated from all of them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from mocapfix import synthetic
from mocapfix.bench.calibration import compute_bone_length_error
from mocapfix.bench.session_takes import SessionPerson, build_session_people, move_marker, record_take
from mocapfix.calibrate.calibration_frames import CalibrationFrames
from mocapfix.options import CleanOptions
from mocapfix.subject import Subject
from mocapfix.synthetic import SyntheticTake

if TYPE_CHECKING:
    from mocapfix.result import CleaningResult

TEST_PEOPLE = ("02", "05", "06", "16", "49", "85")
MOVE_DISTANCE_M = 0.030
MOVES_PER_PERSON = 2
SESSION_TAKES = 6
SESSION_TAKE_S = 20.0
ALONE, WITH_SESSION = "alone", "session"


@dataclass(frozen=True)
class SessionErrors:
    """Mean errors of the takes of one person, in mm, and the processor time of all of them in seconds."""

    person: str
    method: str
    joints_mm: float
    bones_mm: float
    places_mm: float
    cpu_s: float


@dataclass(frozen=True)
class MoveOutcome:
    """How a marker that was moved between two takes was found. `false_alarms` counts all other moves that were reported."""

    person: str
    marker: str
    is_found: bool
    false_alarms: int


def measure_sessions(
    motion_folder: Path | None = None,
    people: tuple[str, ...] = TEST_PEOPLE,
    take_count: int = SESSION_TAKES,
    duration_s: float = SESSION_TAKE_S,
    moves: int = MOVES_PER_PERSON,
    report_progress: Callable[[str], None] = lambda _: None,
) -> tuple[list[SessionErrors], list[MoveOutcome]]:
    """Return the errors of takes cleaned alone and with the session's subject, and the detection of moved markers.

    motion_folder  holds the shards of recorded motion; None for composed motion

    The outcomes with marker "" are sessions without a moved marker. Raises ReadError if there is no motion.
    """
    from mocapfix import pipeline
    from mocapfix.calibrate.person_calibration import calibrate_person

    shards = [] if motion_folder is None else [motion_folder / "test.npz"]
    errors, outcomes = list[SessionErrors](), list[MoveOutcome]()
    for number, person in enumerate(build_session_people(shards, people, take_count, duration_s)):
        report_progress(f"{person.name}: {WITH_SESSION}")
        with TemporaryDirectory() as folder:
            paths = [Path(folder) / f"take{t}.c3d" for t in range(take_count)]
            for path, take in zip(paths, person.takes, strict=True):
                synthetic.write_synthetic_take(path, take)
            begin = process_time()
            surveys = [pipeline.survey_take(path, take_id=path.stem)[0] for path in paths]
            calibration = calibrate_person(surveys)
            subjects = [calibration.take_subjects.get(path.stem, calibration.subject) for path in paths]
            results = [
                pipeline.clean(path, CleanOptions(), subject=subject) for path, subject in zip(paths, subjects, strict=True)
            ]
            errors.append(_average_errors(person, WITH_SESSION, results, process_time() - begin))
            report_progress(f"{person.name}: {ALONE}")
            begin = process_time()
            results = [pipeline.clean(path) for path in paths]
            errors.append(_average_errors(person, ALONE, results, process_time() - begin))
            outcomes.append(MoveOutcome(person.name, "", False, len(calibration.moved)))
            for move in range(moves):
                report_progress(f"{person.name}: moved marker {move + 1}")
                outcomes.append(_move_and_find(person, surveys, np.random.default_rng(100 * number + move), Path(folder)))
    return errors, outcomes


def _average_errors(person: SessionPerson, method: str, results: "list[CleaningResult]", cpu_s: float) -> SessionErrors:
    """Return the mean errors of the results of a person's takes."""
    rows = [_compute_errors(truth, result, person.subject) for truth, result in zip(person.takes, results, strict=True)]
    joints, bones, places = 1e3 * np.mean(rows, axis=0)
    return SessionErrors(person.name, method, float(joints), float(bones), float(places), cpu_s)


def _compute_errors(truth: SyntheticTake, result: "CleaningResult", person: Subject) -> tuple[float, float, float]:
    """Return the errors of joints, bone lengths and marker places of one take in metres."""
    assert result.subject is not None
    assert result.joint_position_world is not None
    joint_m = np.linalg.norm(result.joint_position_world - truth.joint_positions, axis=-1)
    found = [result.subject.labels.index(label) for label in person.labels if label in result.subject.labels]
    known = [person.labels.index(result.subject.labels[k]) for k in found]
    place_m = np.linalg.norm(result.subject.marker_offsets[found] - person.marker_offsets[known], axis=1)
    bone_m = compute_bone_length_error(result.subject.skeleton, person.skeleton)
    return float(np.nanmean(joint_m)), bone_m, float(place_m.mean())


def _move_and_find(
    person: SessionPerson, surveys: list[CalibrationFrames], rng: np.random.Generator, folder: Path
) -> MoveOutcome:
    """Return how a marker is found that lies elsewhere from one of the takes on."""
    from mocapfix import pipeline
    from mocapfix.calibrate.person_calibration import calibrate_person

    moved_subject, marker = move_marker(person.subject, rng, MOVE_DISTANCE_M)
    first = int(rng.integers(1, len(person.takes)))
    changed = list(surveys)
    for t in range(first, len(person.takes)):
        path = folder / f"take{t}.c3d"
        synthetic.write_synthetic_take(path, record_take(rng, moved_subject, person.takes[t].motion))
        changed[t] = pipeline.survey_take(path, take_id=path.stem)[0]
    calibration = calibrate_person(changed)
    label = person.subject.labels[marker]
    is_match = [calibration.subject.labels[each.marker] == label for each in calibration.moved]
    return MoveOutcome(person.name, label, any(is_match), len(is_match) - sum(is_match))
