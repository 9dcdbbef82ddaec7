"""The cleaned takes in an output folder, and the files of each."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from mocapfix.errors import ReadError
from mocapfix.files.output_files import JSON_REPORT_SUFFIX, get_source_suffixes
from mocapfix.review.changes_file import CHANGES_SUFFIX

KEPT_REPORT_KEYS = ("take", "arguments", "notes")


@dataclass(frozen=True)
class CleanedTake:
    """A cleaned take, or one subject of it, and its files.

    id         path of its outputs without their suffixes, relative to the folder that is reviewed, with "/"
    folder     of its outputs
    stem       of the names of its outputs
    report     the parts of the JSON report that a review needs: a session may have thousands
    """

    id: str
    folder: Path
    stem: str
    report: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the input file."""
        return str(self.report["take"]["file"])

    @property
    def subject(self) -> str:
        """The subject, "" for a take of one subject."""
        return str(self.report["take"].get("person", ""))

    @property
    def arguments(self) -> list[str]:
        """The input and the options with which the take was cleaned; empty if the report does not have them."""
        return list(self.report.get("arguments", ()))

    @property
    def input_path(self) -> Path | None:
        """The input file; None if the report does not name it, or it is not there any more."""
        path = self.folder / self.arguments[0] if self.arguments else None
        return path if path and path.is_file() else None

    @property
    def cleaned_path(self) -> Path:
        """The cleaned file."""
        return self.folder / f"{Path(self.name).stem}.{get_source_suffixes(Path(self.name))[0]}"

    def get_path(self, suffix: str) -> Path:
        """Return the path of an output of this take or subject."""
        return self.folder / f"{self.stem}.{suffix}"

    @property
    def changes_path(self) -> Path:
        """The changes file."""
        return self.get_path(CHANGES_SUFFIX)

    @property
    def approval_path(self) -> Path:
        """The file that records the approval."""
        return self.get_path("approval.json")


def find_cleaned_takes(folder: Path) -> list[CleanedTake]:
    """Return the cleaned takes in an output folder of `clean` or `batch`, by their ids. Raises ReadError if there are none."""
    if not folder.is_dir():
        raise ReadError(f"{folder}: is no folder; name the output folder of `mocapfix clean` or `mocapfix batch`.")
    takes: list[CleanedTake] = []
    for parent, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if name.endswith(JSON_REPORT_SUFFIX) and not name.startswith("."):
                stem = name.removesuffix(JSON_REPORT_SUFFIX)
                take = read_cleaned_take(folder, Path(parent), stem)
                if take.changes_path.is_file():
                    takes.append(take)
    if not takes:
        raise ReadError(f"{folder}: holds no cleaned take; name the output folder of `mocapfix clean` or `mocapfix batch`.")
    return sorted(takes, key=lambda take: take.id)


def read_cleaned_take(root: Path, folder: Path, stem: str) -> CleanedTake:
    """Return the take whose outputs have a stem, in a folder below `root`. Raises ReadError if its report cannot be read."""
    path = folder / f"{stem}{JSON_REPORT_SUFFIX}"
    try:
        report = cast("dict[str, Any]", json.loads(path.read_bytes()))
        kept = {key: report[key] for key in KEPT_REPORT_KEYS if key in report}
        take = CleanedTake((folder.relative_to(root) / stem).as_posix(), folder, stem, kept)
        Path(take.name, take.subject, *take.arguments)  # raises TypeError if they are no texts
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ReadError(f"{path}: is damaged; clean the take again.") from error
    return take


def find_takes_of_one_file(take: CleanedTake, takes: Sequence[CleanedTake]) -> list[CleanedTake]:
    """Return the subjects that were cleaned with a take from one file, itself among them."""
    return [each for each in takes if each.folder == take.folder and each.name == take.name]
