"""The scene keypoints-2d: what its YAML says, and what running it gives."""

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat

from mocapfix import subject_file
from mocapfix.clock import Clock, Progress
from mocapfix.errors import SceneError
from mocapfix.keypoints import camera, read, solve
from mocapfix.keypoints.result import Result
from mocapfix.skeleton import Skeleton, cmu31
from mocapfix.solve.single import named
from mocapfix.yaml_form import Stated, checked

STILL = 30.0  # Hz: of one image alone, for its BVH


class Settings(Stated):
    """What the scene says; paths are from the scene's own folder.

    title        one line, for the page
    keypoints    a file, or the folder that OpenPose wrote; see mocapfix.keypoints.read
    rate         Hz, where the file does not say it
    looks_down   degrees that the camera looks down; what the prior knows of standing upright needs it
    subject      a subject file, for this person's bones; null for the average body, which the scale is then for
    prior        a trained model of poses, or "none"
    prior_scale  times its standard deviations: with 2 it is believed half as much
    """

    kind: Literal["keypoints-2d"]
    title: str
    keypoints: Path
    rate: PositiveFloat | None = None
    looks_down: float = Field(default=0.0, gt=-90, lt=90)
    subject: Path | None = None
    prior: str
    prior_scale: PositiveFloat = 1.0


def settings(path: Path) -> Settings:
    """-> what the scene says. Raises SceneError naming the file and the key that is not as it must be."""
    return checked(Settings, path)


def run(path: Path, progress: Progress | None = None) -> Result:
    """-> motion and camera of the film that the scene names.

    Raises SceneError for what the scene does not say as it must, ReadError for keypoints that cannot be taken in, TakeError for
    those that tell of no body.
    """
    said, clock = settings(path), Clock(progress=progress)
    with clock("read"):
        skeleton = bones(path, said)
        seen = read.keypoints(path.parent / said.keypoints, skeleton)
        model = named(said.prior, skeleton)
    rate = seen.rate or said.rate or (STILL if seen.frames == 1 else None)
    if rate is None:
        raise SceneError(f"{path}: rate: must say how many frames a second {said.keypoints} has, which does not say it itself.")
    with clock("solve"):
        looking = camera.looking(float(np.radians(said.looks_down)))
        motion, seen_by = solve.film(seen, rate, skeleton, model, looking, said.prior_scale)
    return Result(path.stem, said.title, seen, rate, skeleton, motion, seen_by, said.prior, clock)


def bones(path: Path, said: Settings) -> Skeleton:
    return subject_file.load(path.parent / said.subject).skeleton if said.subject else cmu31().skeleton
