"""The subject files of a calibrated person: one for all takes, and one for each take in which markers lie elsewhere."""

from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from mocapfix.calibrate.person_calibration import PersonCalibration
from mocapfix.calibrate.subject_file import write_subject

SUBJECT_SUFFIX = ".subject.yaml"


@dataclass(frozen=True)
class PersonFiles:
    """Where the subjects of a person are.

    main     the subject file for takes in which the markers have their usual places
    by_take  by id of a take, the file with the places of that take
    """

    main: Path
    by_take: dict[str, Path]


def locate_person_files(folder: Path, name: str, person: PersonCalibration) -> PersonFiles:
    """Return the paths of the subject files of a person with a name, in a folder."""
    by_take = {
        take: folder / f"{name}.{PurePosixPath(take).with_suffix('').as_posix().replace('/', '-')}{SUBJECT_SUFFIX}"
        for take in person.take_subjects
    }
    return PersonFiles(folder / f"{name}{SUBJECT_SUFFIX}", by_take)


def write_person_files(files: PersonFiles, person: PersonCalibration) -> None:
    """Write the subject files of a person, those of single takes with notes on what lies elsewhere. Raises WriteError."""
    write_subject(files.main, person.subject)
    for take, path in files.by_take.items():
        write_subject(path, replace(person.take_subjects[take], notes=person.describe_take(take)))
