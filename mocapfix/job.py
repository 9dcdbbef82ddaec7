"""A cleaning job written down: which takes, whose, in which volume, under which prior, and what is to be written.

A scene of the kind "clean", as `mocapfix run` does it. Paths are from the scene's own folder, and may have wildcards.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import Field

from mocapfix import synthetic
from mocapfix.errors import MocapfixError, SceneError
from mocapfix.files import check_not_there, make_folder
from mocapfix.fill import FillOptions
from mocapfix.job_form import FillForm, PriorForm, Start, SubjectSaid, TakeSaid, VolumeForm, WriteForm
from mocapfix.outputs import OutputOptions
from mocapfix.scenes import START
from mocapfix.yaml_form import Stated, checked

WILD = set("*?[")


class Job(Stated):
    """What the scene says.

    title       one line
    takes       files, wildcards, or takes to be composed
    subject     a subject file; takes to calibrate one from; null: each take its own
    subject_prefix  the one to be cleaned of several subjects in a file; null: all of them
    marker_set  a shipped set's name or a YAML file; null chooses by the labels
    hierarchy   of animations, how their joints are called: a shipped style or a YAML file; null: as their names tell
    """

    kind: Literal["clean"]
    title: str
    takes: tuple[TakeSaid, ...] = Field(min_length=1)
    subject: SubjectSaid | None = None
    subject_prefix: str | None = None
    marker_set: str | None = None
    hierarchy: str | None = None
    volume: VolumeForm = VolumeForm()
    prior: PriorForm = PriorForm()
    start: Start = START
    fill: FillForm = FillForm()
    write: WriteForm = WriteForm()

    @property
    def options(self) -> FillOptions:
        said = self.fill
        return FillOptions(said.max_gap, said.keep, said.frames, said.limit_mm / 1e3, said.refill)

    @property
    def outputs(self) -> OutputOptions:
        return OutputOptions(self.write.also, self.write.bvh_for, self.write.fps, self.volume.floor)

    def found(self, path: Path, folder: Path) -> list[Path]:
        """-> the takes of the scene at `path`, in its order; those that are composed will be in `folder`."""
        takes: list[Path] = []
        for index, each in enumerate(self.takes):
            if each.compose:
                takes.append(composed(folder, each.compose))
            elif each.file:
                takes += files(path, [each.file], f"takes.{index}")
        return list(dict.fromkeys(takes))

    def compose(self, folder: Path, overwrite: bool) -> None:
        """Write the takes that are to be composed. Raises WriteError where one is there and may not be replaced."""
        for each in self.takes:
            if each.compose:
                target = composed(folder, each.compose)
                check_not_there([target], overwrite)
                make_folder(target.parent)
                synthetic.write(target, synthetic.take(seed=each.seed))

    def worn(self, path: Path) -> str | Path | None:
        """-> the marker set: a file beside the scene at `path` goes before a shipped set's name."""
        return _beside(path, self.marker_set)

    def named(self, path: Path) -> str | Path | None:
        """-> how joints are called: a file beside the scene at `path` goes before a shipped style's name."""
        return _beside(path, self.hierarchy)

    def known(self, path: Path) -> Path | list[Path] | None:
        """-> the subject's file, or the takes to calibrate the subject from; None: each take its own."""
        if self.subject is None:
            return None
        if self.subject.file:
            return path.parent / self.subject.file
        return files(path, self.subject.calibrate, "subject.calibrate")


def _beside(path: Path, said: str | None) -> str | Path | None:
    beside = said and path.parent / said
    return beside if beside and beside.is_file() else said


def load(path: str | Path) -> Job:
    """-> what a scene of the kind "clean" says. Raises SceneError with the file and the path of the wrong key."""
    said = checked(Job, Path(path))
    try:
        _ = said.outputs
    except MocapfixError as error:
        raise SceneError(f"{path}: write: {error}") from error
    return said


def composed(folder: Path, name: str) -> Path:
    """-> where a composed take goes: beside what cleaning it gives, which has its name."""
    return folder / "composed" / name


def files(path: Path, names: Iterable[str], key: str) -> list[Path]:
    """-> the files beside the scene at `path` that names and wildcards under `key` say, in their order, each once.

    Raises SceneError where a wildcard finds none; what a plain name says is found missing when it is read.
    """
    found: dict[Path, None] = {}
    for name in names:
        root = Path(name).anchor
        folder, pattern = path.parent / root, name.removeprefix(root)
        matching = sorted(folder.glob(pattern)) if set(pattern) & WILD else [folder / pattern]
        if not matching:
            raise SceneError(f"{path}: {key}: no file in {folder} is called {name!r}.")
        found |= dict.fromkeys(matching)
    return list(found)
