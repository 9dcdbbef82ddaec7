"""Fuzzing of the readers: damaged files of every format are read; each must be read, or refused in one sentence."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mocapfix.animations.joint_mapping import load_naming_convention
from mocapfix.bench.fuzz_mutations import choose_mutations
from mocapfix.bench.fuzz_process import FuzzLimits
from mocapfix.bench.fuzz_seed_files import SEED_FRAME_COUNT, SEED_RATE_HZ, SeedFile, list_seed_files
from mocapfix.calibrate.subject_file import read_subject
from mocapfix.errors import SceneError
from mocapfix.files.shipped import read_yaml
from mocapfix.initialise.twist_regressor import read_twist_regressor
from mocapfix.jobs.cleaning_job import read_cleaning_job
from mocapfix.keypoints.keypoint_scene import read_keypoint_scene
from mocapfix.marker_sets.library import load_marker_set
from mocapfix.pose_prior.io import load_pose_model
from mocapfix.read.amc import read_amc
from mocapfix.read.capture import read_capture
from mocapfix.review.changes_file import read_changes_file
from mocapfix.skeleton import load_cmu31_body
from mocapfix.take import Take
from mocapfix.write.rig import load_rig

READER_FUZZ_LIMITS = FuzzLimits(slow_s=3.0, timeout_s=30.0)
MAX_MUTATIONS = 4
"""of one file"""
COMPANION_SHARE = 0.5
"""of the files with a companion of which the companion is damaged instead"""


def read_job(path: Path) -> object:
    """Read a scene, as `mocapfix run` does."""
    kind = read_yaml(path).get("kind")
    readers: dict[object, Callable[[Path], object]] = {"clean": read_cleaning_job, "keypoints-2d": read_keypoint_scene}
    if not isinstance(kind, str) or kind not in readers:
        raise SceneError(f"{path}: kind: must be one of {', '.join(map(str, readers))}, not {kind!r}.")
    return readers[kind](path)


def read_changes(path: Path) -> object:
    """Read a changes file for the take of the seed file."""
    take = Take(np.zeros((SEED_FRAME_COUNT, 2, 3)), ("Jim:LFHD", "Jim:RFHD"), SEED_RATE_HZ)
    return read_changes_file(path, take)


READERS: Mapping[str, Callable[[Path], object]] = {
    "capture": read_capture,
    "skeleton": read_amc,
    "subject": read_subject,
    "changes": read_changes,
    "job": read_job,
    "marker set": load_marker_set,
    "hierarchy": load_naming_convention,
    "rig": load_rig,
    "pose prior": lambda path: load_pose_model(str(path), load_cmu31_body().skeleton),
    "twist": read_twist_regressor,
}


@dataclass(frozen=True)
class ReaderCase:
    """A damaged file, and the kind of its reader."""

    file: SeedFile

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self.file.data)

    def save(self, folder: Path) -> None:
        """Write the file, and its companion."""
        (folder / self.file.name).write_bytes(self.file.data)
        if self.file.companion:
            (folder / self.file.companion[0]).write_bytes(self.file.companion[1])

    def run(self, folder: Path) -> str:
        """Read the file."""
        own = folder / self.file.name.replace(".", "-")  # an AMC looks for its skeleton among the files beside it
        own.mkdir(exist_ok=True)
        self.save(own)
        READERS[self.file.kind](own / self.file.name)
        return "read"


def build_reader_case(seed: int, seed_files: tuple[SeedFile, ...] = ()) -> ReaderCase:
    """Return the case of a seed: one of the valid files with one to four mutations.

    seed_files  the valid files; by default those of `list_seed_files`
    """
    rng = np.random.default_rng(seed)
    files = seed_files or list_seed_files()
    file = files[int(rng.integers(len(files)))]
    count = int(rng.integers(1, MAX_MUTATIONS + 1))
    if file.companion and rng.random() < COMPANION_SHARE:
        name, data = file.companion
        return ReaderCase(file._replace(companion=(name, mutate(name, data, count, rng))))
    return ReaderCase(file._replace(data=mutate(file.name, file.data, count, rng)))


def mutate(name: str, data: bytes, count: int, rng: np.random.Generator) -> bytes:
    """Return the bytes of a file after `count` mutations that fit its format."""
    mutations = choose_mutations(name)
    for _ in range(count):
        data = mutations[int(rng.integers(len(mutations)))](data, rng)
    return data


def build_folder_builder(folder: Path) -> Callable[[int], ReaderCase]:
    """Return a builder of cases from the captures in a folder, in place of the generated files."""
    files = tuple(SeedFile("capture", path.name, path.read_bytes()) for path in sorted(folder.rglob("*")) if path.is_file())
    return partial(build_reader_case, seed_files=files)
