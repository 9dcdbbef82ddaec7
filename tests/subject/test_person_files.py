"""The subject files of a person of several takes."""

from dataclasses import replace
from pathlib import Path

from mocapfix.options import SubjectOptions
from mocapfix.subject.library import load_requested_subject, read_subject
from mocapfix.subject.people import locate_person_files, write_person_files
from mocapfix.subject.person_calibration import MovedMarker, PersonCalibration
from mocapfix.synthetic import compose_take


def test_file_of_a_take_has_its_places_and_a_note_for_its_report(tmp_path: Path) -> None:
    subject = compose_take(seconds=0.1).subject
    offsets = subject.marker_offsets.copy()
    offsets[4] += 0.03
    person = PersonCalibration(
        subject,
        {"day1/walk.c3d": replace(subject, marker_offsets=offsets)},
        {"day1/rom.c3d": 0, "day1/walk.c3d": 0},
        (MovedMarker(4, (1,), 0.052),),
        ("day1/rom.c3d", "day1/walk.c3d"),
    )
    files = locate_person_files(tmp_path, "Ann", person)
    assert files.by_take == {"day1/walk.c3d": tmp_path / "Ann.day1-walk.subject.yaml"}
    write_person_files(files, person)
    own = read_subject(files.by_take["day1/walk.c3d"])
    assert abs(own.marker_offsets - offsets).max() < 1e-6
    (note,) = load_requested_subject(SubjectOptions(subject=files.by_take["day1/walk.c3d"])).notes
    assert note.startswith(f"Marker {subject.labels[4]} lies 52 mm from its place")
    assert not read_subject(files.main).notes
