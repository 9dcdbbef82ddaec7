"""The people of a session: written and read, and none without a file."""

from pathlib import Path

import pytest

from mocapfix.batch.records import PersonEntry, SessionPeople, read_people_file, write_people_file
from mocapfix.errors import SceneError


def test_people_are_read_as_they_were_written(tmp_path: Path) -> None:
    jim = PersonEntry(name="J: <é>", takes={"a/b.c3d": "Jim"}, moved_markers=("LFHD moved.",), rejected={"c.c3d": "too tall."})
    people = SessionPeople(people=(jim, PersonEntry(name="null")), notes=("yes",))
    assert write_people_file(tmp_path, people) == tmp_path / "people.yaml"
    assert read_people_file(tmp_path) == people


def test_session_without_the_file_has_no_people(tmp_path: Path) -> None:
    assert read_people_file(tmp_path) is None


def test_wrong_key_is_named(tmp_path: Path) -> None:
    (tmp_path / "people.yaml").write_text("people: [{nam: Jim}]\n", encoding="utf-8")
    with pytest.raises(SceneError, match=r"people\.yaml: people"):
        read_people_file(tmp_path)
