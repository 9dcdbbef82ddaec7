"""Who is who in a session: by names, checked by the body."""

import numpy as np

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.subject.library import load_marker_set
from mocapfix.subject.people import BodyMeasurements, group_people, measure_body


def measure(take: str, subject_name: str = "", size: float = 1.0, seed: int = 0) -> BodyMeasurements:
    """Return the measurements of the average body at a size, from markers with noise."""
    marker_set, skeleton = load_marker_set("cmu41"), load_cmu31_body().skeleton
    positions = size * (skeleton.rest_positions[marker_set.joints] + marker_set.marker_offsets)
    markers = positions + np.random.default_rng(seed).normal(0, 0.003, (20, *positions.shape))
    return measure_body(take, Take(markers, marker_set.labels, 60.0, subject_name=subject_name), marker_set)


def test_prefixes_name_people() -> None:
    people = group_people([measure(f"day/{t}.c3d", name, seed=t) for t in range(3) for name in ("Jim", "Ann")])
    assert {person.name: len(person.takes) for person in people} == {"Jim": 3, "Ann": 3}


def test_prefix_names_the_only_subject_of_a_take_too() -> None:
    marker_set = load_marker_set("cmu41")
    unnamed = measure("both.c3d").distances_m
    labels = tuple(f"Jim:{label}" for label in marker_set.labels)
    markers = load_cmu31_body().skeleton.rest_positions[marker_set.joints] + marker_set.marker_offsets
    alone = measure_body("alone.c3d", Take(markers[None].repeat(5, 0), labels, 60.0), marker_set)
    assert alone.subject_name == ""
    assert alone.distances_m.keys() == unnamed.keys()
    people = group_people([measure("both.c3d", "Ann", seed=1), measure("both.c3d", "Jim", seed=2), alone])
    assert {person.name: [body.take for body in person.takes] for person in people} == {
        "Ann": ["both.c3d"],
        "Jim": ["both.c3d", "alone.c3d"],
    }


def test_folders_name_people_without_prefix() -> None:
    people = group_people([measure("jim/a.c3d"), measure("jim/b.c3d"), measure("ann/a.c3d")])
    assert [person.name for person in people] == ["jim", "ann"]


def test_similar_bodies_need_a_name_to_be_joined() -> None:
    def join(name: str) -> list[int]:
        people = group_people([measure("a.c3d", name), measure("b.c3d", name, size=1.045, seed=1), measure("c.c3d", name)])
        assert not any(person.notes for person in people)
        return [len(person.takes) for person in people]

    assert join("Jim") == [3]
    assert join("") == [2, 1]


def test_session_file_names_come_first() -> None:
    people = group_people([measure("a.c3d"), measure("b.c3d")], {"Jim": ["a.c3d"], "Ann": ["b.c3d"]})
    assert [person.name for person in people] == ["Jim", "Ann"]


def test_other_body_of_the_same_name_is_another_person() -> None:
    first, second = group_people([measure("a.c3d", "Jim"), measure("b.c3d", "Jim", size=1.15)])
    assert (first.name, second.name) == ("Jim", "Jim-2")
    assert not first.notes
    assert "b.c3d" in second.notes[0]


def test_subjects_of_one_take_are_never_joined() -> None:
    people = group_people([measure("a.c3d", "Jim"), measure("a.c3d", "JIM")])
    assert len(people) == 2
