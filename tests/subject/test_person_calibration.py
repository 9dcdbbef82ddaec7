"""A person calibrated from several takes, and what differs between them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError, TakeError
from mocapfix.lab.calibration import build_session_people
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.subject.calibration import (
    CalibrationFrames,
    read_calibration_frames,
    select_calibration_frames,
    write_calibration_frames,
)
from mocapfix.subject.library import load_marker_set
from mocapfix.subject.person_calibration import (
    MovedMarker,
    PersonCalibration,
    calibrate_person,
    is_confirmed_move,
    join_marker_sets,
)
from mocapfix.synthetic import SyntheticTake

BODY, MARKER_SET = load_cmu31_body(), load_marker_set("cmu41")
PRIOR = load_mean_pose_prior("mean-pose", BODY.skeleton)
PERSON = build_session_people([], ("Ann",), 4, 4.0)[0]


def survey(truth: SyntheticTake, name: str, moved: dict[str, np.ndarray] | None = None) -> CalibrationFrames:
    """Return the calibration frames of a take, in which markers lie elsewhere by these vectors in their joints' axes."""
    markers = truth.damaged_positions.copy()
    _, rotation = compute_world_poses(truth.subject.skeleton, truth.motion)
    for label, shift in (moved or {}).items():
        k = truth.labels.index(label)
        markers[:, k] += rotation[:, truth.subject.joints[k]] @ shift
    return select_calibration_frames(name, Take(markers, truth.labels, truth.rate), MARKER_SET, BODY, PRIOR)


@pytest.fixture(scope="module")
def surveys() -> list[CalibrationFrames]:
    return [survey(take, f"take{t}") for t, take in enumerate(PERSON.takes)]


@pytest.fixture(scope="module")
def person(surveys: list[CalibrationFrames]) -> PersonCalibration:
    return calibrate_person(surveys)


def compute_place_error(subject: Subject) -> float:
    return float(np.linalg.norm(subject.marker_offsets - PERSON.subject.marker_offsets, axis=1).mean())


def test_several_takes_place_markers_better_than_one(surveys: list[CalibrationFrames], person: PersonCalibration) -> None:
    alone = [compute_place_error(calibrate_person([each]).subject) for each in surveys]
    assert compute_place_error(person.subject) < 0.9 * np.mean(alone)


def test_nothing_differs_between_takes_of_one_session(person: PersonCalibration) -> None:
    assert not person.moved
    assert not person.rejected
    assert not person.take_subjects
    assert sorted(person.takes) == ["take0", "take1", "take2", "take3"]


def test_moved_marker_is_found_and_has_a_place_of_its_own(surveys: list[CalibrationFrames]) -> None:
    shift = np.array([0.0, 0.04, 0.0])
    changed = [*surveys[:3], survey(PERSON.takes[3], "take3", {"LTHI": shift})]
    person = calibrate_person(changed)
    (moved,) = person.moved
    k = person.subject.labels.index("LTHI")
    assert moved.marker == k
    assert [person.takes[take] for take in moved.takes] == ["take3"]
    assert moved.distance_m == pytest.approx(0.04, abs=0.01)
    own = person.take_subjects["take3"].marker_offsets[k] - person.subject.marker_offsets[k]
    np.testing.assert_allclose(own, shift, atol=0.01)
    assert "LTHI" in person.describe_moves()[0]
    (note,) = person.describe_take("take3")
    assert note.startswith("Marker LTHI lies ")
    assert not person.describe_take("take0")


def test_markers_attached_again_have_places_for_each_session(surveys: list[CalibrationFrames]) -> None:
    rng = np.random.default_rng(1)
    shifts = {label: rng.normal(0, 0.015, 3) for label in MARKER_SET.labels}
    second = [survey(PERSON.takes[t], f"take{t}", shifts) for t in (2, 3)]
    person = calibrate_person([*surveys[:2], *second], ["day1", "day1", "day2", "day2"])
    assert {person.sessions[f"take{t}"] for t in (0, 1)} != {person.sessions[f"take{t}"] for t in (2, 3)}


def test_range_of_motion_takes_come_first(surveys: list[CalibrationFrames]) -> None:
    person = calibrate_person([surveys[0], replace(surveys[1], take="static ROM")])
    assert person.takes[0] == "static ROM"


def test_takes_may_show_different_markers_of_one_set(surveys: list[CalibrationFrames]) -> None:
    fewer = replace(
        surveys[0],
        labels=surveys[0].labels[1:],
        joints=surveys[0].joints[1:],
        marker_offsets=surveys[0].marker_offsets[1:],
        marker_spread=surveys[0].marker_spread[1:],
        markers=surveys[0].markers[:, 1:],
    )
    joined = join_marker_sets([fewer, surveys[1]])
    assert joined[0].labels == joined[1].labels == MARKER_SET.labels
    assert np.isnan(joined[0].markers[:, 0]).all()


def test_other_marker_sets_are_refused(surveys: list[CalibrationFrames]) -> None:
    with pytest.raises(TakeError, match="different marker sets"):
        calibrate_person([surveys[0], replace(surveys[1], marker_set="other")])


def test_frames_survive_their_file(tmp_path: Path, surveys: list[CalibrationFrames]) -> None:
    write_calibration_frames(tmp_path / "a.npz", surveys[0])
    read = read_calibration_frames(tmp_path / "a.npz")
    assert (read.take, read.labels, read.subject_name) == (surveys[0].take, surveys[0].labels, surveys[0].subject_name)
    np.testing.assert_allclose(read.markers, surveys[0].markers, atol=1e-6)


@pytest.mark.parametrize("spoil", [lambda path: path.write_bytes(b""), lambda path: path.write_bytes(b"PK\x03\x04 no archive")])
def test_damaged_archive_is_one_sentence(tmp_path: Path, spoil: Callable[[Path], None]) -> None:
    spoil(tmp_path / "a.npz")
    with pytest.raises(ReadError, match="calibration frames"):
        read_calibration_frames(tmp_path / "a.npz")


def test_move_is_confirmed_by_the_places_after_calibration() -> None:
    offsets = np.zeros((4, 2, 3))
    offsets[2:, 0] = [0.02, 0.0, 0.0]
    offsets[3, 1] = [0.0, 0.012, 0.0]
    assert is_confirmed_move(MovedMarker(0, (2, 3), 0.02), offsets)
    assert not is_confirmed_move(MovedMarker(1, (3,), 0.017), offsets)
