"""The scene keypoints-2d: what its YAML says, and what running it gives."""

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat

from mocapfix.calibrate import subject_file
from mocapfix.errors import SceneError
from mocapfix.files.yaml_models import StrictModel, read_yaml_model
from mocapfix.keypoints import camera_scale, film_solver, keypoint_file
from mocapfix.keypoints.keypoint_result import KeypointResult
from mocapfix.report.stage_timer import ProgressCallback, StageTimer
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve.single_pose import resolve_pose_model

STILL_IMAGE_RATE_HZ = 30.0  # Hz: of one image alone, for its BVH


class KeypointSceneSettings(StrictModel):
    """What the scene says; paths are from the scene's own folder.

    title        one line, for the page
    keypoints    a file, or the folder that OpenPose wrote; see mocapfix.keypoints.keypoint_file
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


def read_keypoint_scene(path: Path) -> KeypointSceneSettings:
    """-> what the scene says. Raises SceneError naming the file and the key that is not as it must be."""
    return read_yaml_model(KeypointSceneSettings, path)


def run_keypoint_scene(path: Path, progress: ProgressCallback | None = None) -> KeypointResult:
    """-> motion and camera of the film that the scene names.

    Raises SceneError for what the scene does not say as it must, ReadError for keypoints that cannot be taken in, TakeError for
    those that tell of no body.
    """
    said, clock = read_keypoint_scene(path), StageTimer(report_progress=progress)
    with clock("read"):
        skeleton = load_scene_skeleton(path, said)
        seen = keypoint_file.read_keypoints(path.parent / said.keypoints, skeleton)
        model = resolve_pose_model(said.prior, skeleton)
    rate = seen.rate_hz or said.rate or (STILL_IMAGE_RATE_HZ if seen.frame_count == 1 else None)
    if rate is None:
        raise SceneError(f"{path}: rate: must say how many frames a second {said.keypoints} has, which does not say it itself.")
    with clock("solve"):
        looking = camera_scale.build_camera_rotation(float(np.radians(said.looks_down)))
        motion, seen_by = film_solver.solve_film(seen, rate, skeleton, model, looking, said.prior_scale)
    return KeypointResult(path.stem, said.title, seen, rate, skeleton, motion, seen_by, said.prior, clock)


def load_scene_skeleton(path: Path, settings: KeypointSceneSettings) -> Skeleton:
    return subject_file.read_subject(path.parent / settings.subject).skeleton if settings.subject else load_cmu31_body().skeleton
