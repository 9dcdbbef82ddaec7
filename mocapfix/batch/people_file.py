"""The people of a session, people.yaml in the folder of a batch: who they are, their takes, and the markers that moved."""

from pathlib import Path

from pydantic import Field

from mocapfix.files.output_files import replace_atomically
from mocapfix.files.yaml_models import StrictModel, dump_yaml, read_yaml_model

PEOPLE_FILE_NAME = "people.yaml"


class PersonEntry(StrictModel):
    """One person of a session. Paths are relative to the folder of the batch.

    basis          from what it is known which takes are this person's, in words such as "subject prefix" or "body"
    takes          by id of a take, the name of the subject in it; "" if it has only one
    subject_file   calibrated from all takes
    take_files     by id of a take, the subject file with which it was cleaned, where marker places differ
    moved_markers  a sentence for each marker that moved between takes
    rejected       by id of a take, why it is not this person's although the names agree
    """

    name: str
    basis: str = ""
    takes: dict[str, str] = Field(default_factory=dict)
    subject_file: str = ""
    take_files: dict[str, str] = Field(default_factory=dict)
    moved_markers: tuple[str, ...] = ()
    rejected: dict[str, str] = Field(default_factory=dict)


class SessionPeople(StrictModel):
    """All people of a session, and sentences on how takes were assigned to them."""

    people: tuple[PersonEntry, ...] = ()
    notes: tuple[str, ...] = ()


def write_people_file(output_folder: Path, people: SessionPeople) -> Path:
    """Write people.yaml into the folder of a batch and return its path. Raises WriteError."""
    path = output_folder / PEOPLE_FILE_NAME
    with replace_atomically(path) as part:
        part.write_text(dump_yaml(people.model_dump(mode="json")), encoding="utf-8")
    return path


def read_people_file(output_folder: Path) -> SessionPeople | None:
    """Return the people of a batch, None if the session has no such file. Raises SceneError if it cannot be read."""
    path = output_folder / PEOPLE_FILE_NAME
    return read_yaml_model(SessionPeople, path) if path.exists() else None
