"""Benchmarks of calibration on known bodies: of one take, and of sessions with several takes of each of several people.

Errors are those of bones, marker offsets and joints. Skin motion displaces the joints even on the true body.

In sessions the motion is recorded by people that no model was trained on. Where a person has too few long recordings, others' are
played on that person's body; recordings shorter than a take are played forwards and backwards. Without recordings the motion is
composed. The takes are cleaned alone, and with the person calibrated from all of them.
"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix import synthetic
from mocapfix.errors import ReadError
from mocapfix.lab import sound_takes
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import BodyModel, Skeleton, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, SolveOptions
from mocapfix.solve import initial_motion, kinematics
from mocapfix.solve.mean_pose import MeanPosePrior, load_joint_limits, load_mean_pose_prior
from mocapfix.subject.calibration import CalibrationFrames, fit_calibration, scale_average_subject
from mocapfix.subject.library import load_marker_set

if TYPE_CHECKING:
    from mocapfix.result import CleaningResult


CALIBRATION_SEEDS = tuple(range(100, 106))
CALIBRATION_TAKE_S = 20.0  # the whole composed motion
CALIBRATION_RATE_HZ = 30.0
MIN_COMPARED_BONE_LENGTH_M = 0.02  # shorter offsets are not compared

CalibrationRow = dict[str, str | float]


def measure_calibration(
    seeds: tuple[int, ...] = CALIBRATION_SEEDS, duration_s: float = CALIBRATION_TAKE_S
) -> list[CalibrationRow]:
    """Return a row for each person and the mean row, with mean errors in mm.

    - `bones_mm`, `offsets_mm`, `joints_mm`, `marked_mm`: of bone lengths, marker offsets, all joints of the solved poses, and
      joints that carry markers
    - `average_...`: the same for the average body, scaled to the size of the person
    - `true_...`: joint errors on the true body
    """
    body, marker_set = load_cmu31_body(), load_marker_set("cmu41")
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    rows: list[CalibrationRow] = []
    for seed in seeds:
        truth = synthetic.compose_take(seed, duration_s, CALIBRATION_RATE_HZ, asymmetric=True)
        markers = np.where(truth.spike_mask[..., None], np.nan, truth.damaged_positions)
        take = Take(markers, truth.labels, CALIBRATION_RATE_HZ)
        average = scale_average_subject(take, marker_set)
        calibrated = fit_calibration(take, marker_set, body, prior).subject
        row: CalibrationRow = {"person": f"seed {seed}"}
        for prefix, subject in (("average_", average), ("", calibrated)):
            errors = compute_calibration_errors(truth, take, subject, body, prior)
            row |= {prefix + key: value for key, value in errors.items()}
        skin_error = compute_mean_joint_errors(truth, take, truth.subject, body, prior)
        row |= {"true_" + key: value for key, value in summarise_joint_errors(skin_error, truth.subject).items()}
        rows.append(row)
    means: CalibrationRow = {key: float(np.mean([float(row[key]) for row in rows])) for key in list(rows[0])[1:]}
    return [*rows, {"person": "mean"} | means]


def compute_calibration_errors(
    truth: synthetic.SyntheticTake, take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior
) -> dict[str, float]:
    """Return the mean errors of a subject in mm: bones, marker offsets, and joints of the poses solved with it."""
    offset_error = np.linalg.norm(subject.marker_offsets - truth.subject.marker_offsets, axis=1).mean()
    return {
        "bones_mm": 1e3 * compute_bone_length_error(subject.skeleton, truth.subject.skeleton),
        "offsets_mm": 1e3 * float(offset_error),
    } | summarise_joint_errors(compute_mean_joint_errors(truth, take, subject, body, prior), subject)


def compute_mean_joint_errors(
    truth: synthetic.SyntheticTake, take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior
) -> Float[np.ndarray, " J"]:
    """Return the mean error of each joint in metres of the poses solved with a subject."""
    start = initial_motion.initialise_motion(take, subject, body, prior)
    limits = load_joint_limits(body.skeleton)
    motion = sound_takes.solve_motion(take, subject, body, prior, limits, start, SolveOptions())
    joint_positions, _ = kinematics.compute_world_poses(subject.skeleton, motion)
    return np.linalg.norm(joint_positions - truth.joint_positions, axis=2).mean(0)


def summarise_joint_errors(joint_error: Float[np.ndarray, " J"], subject: Subject) -> dict[str, float]:
    """Return the mean errors in mm of all joints and of those that carry markers."""
    marked_error = joint_error[np.unique(subject.joints)]
    return {"joints_mm": 1e3 * float(joint_error.mean()), "marked_mm": 1e3 * float(marked_error.mean())}


def compute_bone_length_error(estimated: Skeleton, true: Skeleton) -> float:
    """Return the mean absolute error of bone lengths in metres."""
    lengths = np.linalg.norm(true.offsets, axis=1)
    is_bone = lengths > MIN_COMPARED_BONE_LENGTH_M
    return float(np.abs(np.linalg.norm(estimated.offsets, axis=1) - lengths)[is_bone].mean())


MIN_OWN_RECORDING_S = 4.0  # shorter recordings are not used
COMPOSED_SEGMENT_S = 20.0  # duration of the whole composed motion, from which takes of other motion are cut


class SessionPerson(NamedTuple):
    """A person with the true body, and the takes of that person."""

    name: str
    subject: Subject
    takes: tuple[synthetic.SyntheticTake, ...]


def build_session_people(
    motion_files: list[Path], people: tuple[str, ...], take_count: int, duration_s: float = sound_takes.SOUND_TAKE_DURATION_S
) -> list[SessionPerson]:
    """Return people with `take_count` takes each.

    Args:
        motion_files: Shards of recordings; empty for composed motion.
        people: Names of the recorded subjects, whose own motion is preferred.

    Raises:
        ReadError: If the recordings do not suffice for a single take.
    """
    if not motion_files:
        return [_compose_person(name, number, take_count, duration_s) for number, name in enumerate(people)]
    recorded = [each for path in motion_files for each in sound_takes.read_performed_motions(path)]
    recorded = [each for each in recorded if _compute_length_s(each) >= MIN_OWN_RECORDING_S]
    if not recorded:
        raise ReadError(f"{motion_files[0]}: holds no recording of {MIN_OWN_RECORDING_S:g} s or longer.")
    by_person: dict[str, list[sound_takes.PerformedMotion]] = defaultdict(list)
    for each in sorted(recorded, key=lambda each: -_compute_length_s(each)):
        by_person[each.name.split("_")[0]].append(each)
    return [_record_person(name, number, by_person, take_count, duration_s) for number, name in enumerate(people)]


def _record_person(
    name: str, number: int, by_person: dict[str, list[sound_takes.PerformedMotion]], take_count: int, duration_s: float
) -> SessionPerson:
    """Return one person with that person's own recordings, then those of the others in turn."""
    rng = np.random.default_rng(1000 + number)
    subject = synthetic.draw_subject(rng, asymmetric=True)
    others = [each for other, motions in by_person.items() if other != name for each in motions[:2]]
    turn = number * take_count % max(1, len(others))
    chosen = [*by_person.get(name, []), *others[turn:], *others[:turn]][:take_count]
    motions = [_play_part(each, 0, each.frame_count, duration_s) for each in map(sound_takes.resample_performance, chosen)]
    return SessionPerson(name, subject, tuple(record_take(rng, subject, motion) for motion in motions))


def _compose_person(name: str, number: int, take_count: int, duration_s: float) -> SessionPerson:
    """Return one person whose takes are successive parts of the composed motion."""
    rng = np.random.default_rng(1000 + number)
    subject = synthetic.draw_subject(rng, asymmetric=True)
    whole = synthetic.compose_motion(subject, COMPOSED_SEGMENT_S, sound_takes.SOUND_TAKE_RATE_HZ)
    length, takes = round(duration_s * sound_takes.SOUND_TAKE_RATE_HZ), list[synthetic.SyntheticTake]()
    for take in range(take_count):
        first = round(take * (whole.frame_count - length) / max(1, take_count - 1)) if length < whole.frame_count else 0
        takes.append(record_take(rng, subject, _play_part(whole, first, min(length, whole.frame_count - first), duration_s)))
    return SessionPerson(name, subject, tuple(takes))


def record_take(rng: np.random.Generator, subject: Subject, motion: Motion) -> synthetic.SyntheticTake:
    """Return a take of a motion with the skin's sliding, camera noise and gaps."""
    joints, markers = synthetic.simulate_markers(rng, subject, motion, sound_takes.SOUND_TAKE_RATE_HZ)
    is_arm = np.isin(subject.joints, [subject.skeleton.find_joint(name) for name in synthetic.DAMAGED_ARM_JOINTS])
    missing = synthetic.draw_gaps(rng, motion.frame_count, sound_takes.SOUND_TAKE_RATE_HZ, is_arm)
    damaged = np.where(missing[..., None], np.nan, markers)
    no_spikes = np.zeros_like(missing)
    return synthetic.SyntheticTake(
        motion, subject, joints, markers, damaged, missing, no_spikes, subject.labels, sound_takes.SOUND_TAKE_RATE_HZ
    )


def move_marker(subject: Subject, rng: np.random.Generator, distance_m: float) -> tuple[Subject, int]:
    """Return the subject with one marker moved in a random direction, and the marker."""
    marker, direction = int(rng.integers(len(subject.labels))), rng.normal(size=3)
    offsets = subject.marker_offsets.copy()
    offsets[marker] += distance_m * direction / np.linalg.norm(direction)
    return replace(subject, marker_offsets=offsets), marker


def _play_part(motion: Motion, first: int, frame_count: int, duration_s: float) -> Motion:
    """Return a part of a motion played forwards and backwards until it has the duration."""
    turns = first + np.r_[np.arange(frame_count), np.arange(frame_count - 2, 0, -1)]
    frames = np.resize(turns, round(duration_s * sound_takes.SOUND_TAKE_RATE_HZ))
    return sound_takes.build_known_motion(motion.root_position[frames], np.ascontiguousarray(motion.local_rotations[frames]))


def _compute_length_s(performance: sound_takes.PerformedMotion) -> float:
    return performance.motion.frame_count / performance.rate_hz


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

    The outcomes with marker "" are sessions without a moved marker. Raises ReadError if there is no motion.

    Args:
        motion_folder: Holds the shards of recorded motion; None for composed motion.
    """
    from mocapfix import pipeline
    from mocapfix.subject.person_calibration import calibrate_person
    from mocapfix.surveys import survey_take

    shards = [] if motion_folder is None else [motion_folder / "test.npz"]
    errors, outcomes = list[SessionErrors](), list[MoveOutcome]()
    for number, person in enumerate(build_session_people(shards, people, take_count, duration_s)):
        report_progress(f"{person.name}: {WITH_SESSION}")
        with TemporaryDirectory() as folder:
            paths = [Path(folder) / f"take{t}.c3d" for t in range(take_count)]
            for path, take in zip(paths, person.takes, strict=True):
                synthetic.write_synthetic_take(path, take)
            begin = process_time()
            surveys = [survey_take(path, take_id=path.stem)[0] for path in paths]
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


def _compute_errors(truth: synthetic.SyntheticTake, result: "CleaningResult", person: Subject) -> tuple[float, float, float]:
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
    from mocapfix.subject.person_calibration import calibrate_person
    from mocapfix.surveys import survey_take

    moved_subject, marker = move_marker(person.subject, rng, MOVE_DISTANCE_M)
    first = int(rng.integers(1, len(person.takes)))
    changed = list(surveys)
    for t in range(first, len(person.takes)):
        path = folder / f"take{t}.c3d"
        synthetic.write_synthetic_take(path, record_take(rng, moved_subject, person.takes[t].motion))
        changed[t] = survey_take(path, take_id=path.stem)[0]
    calibration = calibrate_person(changed)
    label = person.subject.labels[marker]
    is_match = [calibration.subject.labels[each.marker] == label for each in calibration.moved]
    return MoveOutcome(person.name, label, any(is_match), len(is_match) - sum(is_match))
