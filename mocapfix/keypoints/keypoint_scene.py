"""The scene keypoints-2d: the settings in its YAML file, and running it."""

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat

from mocapfix.calibrate.subject_file import read_subject
from mocapfix.errors import SceneError
from mocapfix.files.yaml_models import StrictModel, read_yaml_model
from mocapfix.keypoints.camera_scale import build_camera_rotation
from mocapfix.keypoints.film_solver import solve_film
from mocapfix.keypoints.keypoint_file import read_keypoints
from mocapfix.keypoints.keypoint_result import KeypointResult
from mocapfix.report.stage_timer import ProgressCallback, StageTimer
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve.single_pose import resolve_pose_model

STILL_IMAGE_RATE_HZ = 30.0  # rate of the BVH of a single image


class KeypointSceneSettings(StrictModel):
    """The keys of the scene file; paths are relative to its folder.

    title        one line, for the page
    keypoints    a file, or the folder that OpenPose wrote; see `keypoint_file`
    rate         Hz, if the keypoints' file does not contain it
    looks_down   degrees by which the camera is pitched down, which the prior's knowledge of upright poses needs
    subject      a subject file with this person's bone lengths; null for the average body, for which the scale is then estimated
    prior        a trained model of poses, or "none"
    prior_scale  factor on the prior's standard deviations (2 = weaker prior)
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
    """Return the scene's settings. Raises SceneError that names the file and the invalid key."""
    return read_yaml_model(KeypointSceneSettings, path)


def run_keypoint_scene(path: Path, progress: ProgressCallback | None = None) -> KeypointResult:
    """Return motion and camera of the film of a scene file.

    Raises SceneError for an invalid scene, ReadError for invalid keypoints, TakeError for keypoints that do not determine a body.
    """
    settings, timer = read_keypoint_scene(path), StageTimer(report_progress=progress)
    with timer("read"):
        skeleton = load_scene_skeleton(path, settings)
        keypoints = read_keypoints(path.parent / settings.keypoints, skeleton)
        model = resolve_pose_model(settings.prior, skeleton)
    rate = keypoints.rate_hz or settings.rate or (STILL_IMAGE_RATE_HZ if keypoints.frame_count == 1 else None)
    if rate is None:
        raise SceneError(f"{path}: rate: give the frames per second of {settings.keypoints}, which does not contain them.")
    with timer("solve"):
        rotation = build_camera_rotation(float(np.radians(settings.looks_down)))
        motion, camera = solve_film(keypoints, rate, skeleton, model, rotation, settings.prior_scale)
    return KeypointResult(path.stem, settings.title, keypoints, rate, skeleton, motion, camera, settings.prior, timer)


def load_scene_skeleton(path: Path, settings: KeypointSceneSettings) -> Skeleton:
    """Return the skeleton of the scene's subject file, or of the average body."""
    return read_subject(path.parent / settings.subject).skeleton if settings.subject else load_cmu31_body().skeleton
