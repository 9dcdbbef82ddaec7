"""Who is who in a session: by names, checked by the body."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.batch.people import compute_body_difference, group_people
from mocapfix.calibrate.calibration_frames import CalibrationFrames
from mocapfix.marker_sets import load_marker_set
from mocapfix.skeleton import load_cmu31_body


def make_survey(take: str, subject_name: str = "", size: float = 1.0, seed: int = 0) -> CalibrationFrames:
    """Return frames of the average body at a size, in its rest pose, with noise."""
    marker_set, skeleton = load_marker_set("cmu41"), load_cmu31_body().skeleton
    positions = size * (skeleton.rest_positions[marker_set.joints] + marker_set.marker_offsets)
    markers = positions + np.random.default_rng(seed).normal(0, 0.003, (20, *positions.shape))
    rotations = np.tile(np.eye(3), (20, len(skeleton.names), 1, 1))
    return CalibrationFrames(
        take, subject_name, marker_set.name, marker_set.labels, marker_set.joints, marker_set.marker_offsets,
        marker_set.marker_spread, size, np.arange(20) / 10, markers, np.zeros((20, 3)), rotations,
    )  # fmt: skip


def test_prefixes_name_people() -> None:
    people = group_people([make_survey(f"day/{t}.c3d", name, seed=t) for t in range(3) for name in ("Jim", "Ann")])
    assert {person.name: len(person.takes) for person in people} == {"Jim": 3, "Ann": 3}


def test_folders_name_people_without_prefix() -> None:
    people = group_people([make_survey("jim/a.c3d"), make_survey("jim/b.c3d"), make_survey("ann/a.c3d")])
    assert [person.name for person in people] == ["jim", "ann"]


def test_similar_bodies_need_a_name_to_be_joined() -> None:
    def join(name: str) -> list[int]:
        people = group_people(
            [make_survey("a.c3d", name), make_survey("b.c3d", name, size=1.045, seed=1), make_survey("c.c3d", name)]
        )
        assert not any(person.notes for person in people)
        return [len(person.takes) for person in people]

    assert join("Jim") == [3]
    assert join("") == [2, 1]


def test_session_file_names_come_first() -> None:
    people = group_people([make_survey("a.c3d"), make_survey("b.c3d")], {"Jim": ["a.c3d"], "Ann": ["b.c3d"]})
    assert [person.name for person in people] == ["Jim", "Ann"]


def test_other_body_of_the_same_name_is_another_person() -> None:
    first, second = group_people([make_survey("a.c3d", "Jim"), make_survey("b.c3d", "Jim", size=1.15)])
    assert (first.name, second.name) == ("Jim", "Jim-2")
    assert not first.notes
    assert "b.c3d" in second.notes[0]


def test_subjects_of_one_take_are_never_joined() -> None:
    people = group_people([make_survey("a.c3d", "Jim"), make_survey("a.c3d", "JIM")])
    assert len(people) == 2


def test_body_difference_is_the_ratio_of_sizes() -> None:
    difference = compute_body_difference(make_survey("a"), make_survey("b", size=1.1, seed=1))
    assert difference == pytest.approx(np.log(1.1), abs=0.01)
    few = make_survey("c")
    assert compute_body_difference(few, replace(few, markers=np.full_like(few.markers, np.nan))) is None
