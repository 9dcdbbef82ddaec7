"""Scenes of 2-D keypoints: read the scene file, or compose an example film, solve it, and write the result."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, PositiveFloat
from scipy.spatial.transform import Rotation

from mocapfix import synthetic
from mocapfix.errors import SceneError
from mocapfix.io.files import check_outputs_absent, make_output_folder, replace_atomically
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.keypoints.film_solver import solve_film
from mocapfix.keypoints.keypoint_file import Keypoints, load_detector, read_keypoints
from mocapfix.keypoints.reprojection_problem import build_camera, build_camera_rotation
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.report.stage_timer import ProgressCallback, StageTimer
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.single_pose import Camera, resolve_pose_model
from mocapfix.subject.subject_file import read_subject

if TYPE_CHECKING:
    from mocapfix.report.keypoint_report import KeypointReport


KEYPOINT_OUTPUT_KINDS = ("bvh", "report.html", "report.json", "rrd")


@dataclass(frozen=True)
class KeypointResult:
    """A motion from keypoints, the camera, and what both were estimated from."""

    name: str
    title: str
    keypoints: Keypoints
    rate_hz: float
    skeleton: Skeleton
    motion: Motion
    camera: Camera
    prior_name: str
    timer: StageTimer

    @cached_property
    def _positions(self) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T V 3"]]:
        joints, rotations = compute_world_poses(self.skeleton, self.motion)
        return joints, self.keypoints.detector.compute_point_positions(joints, rotations)

    @property
    def joint_positions(self) -> Float[np.ndarray, "T J 3"]:
        """World positions in metres."""
        return self._positions[0]

    @property
    def reprojection_error_px(self) -> Float[np.ndarray, "T V"]:
        """Distances from each keypoint to the image of its point on the body; NaN for a missing keypoint."""
        distance = np.linalg.norm(self.camera.project(self._positions[1]) - self.keypoints.position_px, axis=-1)
        return np.where(self.keypoints.confidence > 0, distance, np.nan)

    @property
    def report(self) -> KeypointReport:
        """The report, for report.json."""
        error_px, detector = self.reprojection_error_px, self.keypoints.detector
        by_keypoint = [column[np.isfinite(column)] for column in error_px.T]
        means = [round(float(column.mean()), 2) if len(column) else None for column in by_keypoint]
        return {
            "scene": self.name,
            "frames": self.keypoints.frame_count,
            "rate_hz": self.rate_hz,
            "order": detector.name,
            "prior": self.prior_name,
            "camera": {
                "pixels_per_metre": round(self.camera.scale, 3),
                "origin_px": [round(float(x), 2) for x in self.camera.centre],
                "pitch_down_deg": round(float(np.degrees(np.arcsin(-self.camera.rotation[2, 1]))), 3),
            },
            "reprojection_px": {
                "mean": round(float(np.nanmean(error_px)), 2),
                "p95": round(float(np.nanpercentile(error_px, 95)), 2),
                "by_keypoint": dict(zip(detector.labels, means, strict=True)),
            },
            "status": {FrameStatus(status).description: count for status, count in Counter(self.motion.status.tolist()).items()},
            "seconds": self.timer.stage_seconds,
        }

    def write(self, folder: Path, overwrite: bool = False) -> dict[str, Path]:
        """Write the motion as BVH, a page, a report and a recording. Return the files by kind.

        Raises WriteError if one exists already (and overwrite is False), or cannot be written.
        """
        from mocapfix.io.bvh import write_bvh
        from mocapfix.report.keypoint_report import KeypointFilm, write_keypoint_page, write_keypoint_recording

        outputs = {kind: folder / f"{self.name}.{kind}" for kind in KEYPOINT_OUTPUT_KINDS}
        check_outputs_absent(outputs.values(), overwrite)
        make_output_folder(folder)
        keypoints, joint_px = self.keypoints, self.camera.project(self.joint_positions)
        film = KeypointFilm(
            self.title, self.rate_hz, keypoints.image_size_px, keypoints.position_px, keypoints.confidence, self.skeleton,
            self.joint_positions, joint_px,
        )  # fmt: skip
        with self.timer("write"):
            write_bvh(outputs["bvh"], self.skeleton, self.motion, self.rate_hz)
            write_keypoint_recording(outputs["rrd"], film)
            write_keypoint_page(outputs["report.html"], film, self.report)
        with replace_atomically(outputs["report.json"]) as part:
            part.write_text(json.dumps(self.report, indent=1) + "\n", encoding="utf-8")
        return outputs


IMAGE_WIDTH_PX = 1280
IMAGE_HEIGHT_PX = 720
CAMERA_SCALE_PX_M = 180.0  # pixels per metre
FLOOR_HEIGHT_PX = 600.0  # row of the floor in the image
SUBJECT_HEADING_RAD = np.radians(60)  # 0: facing the camera
KEYPOINT_NOISE_SD_M = 0.012  # of a keypoint of confidence 1; inversely proportional to the confidence
MISSING_KEYPOINT_SHARE = 0.05  # of the keypoints


def compose_example_film(
    detector_name: str, seconds: float, rate: float, seed: int = 0
) -> tuple[dict[str, Any], Float[np.ndarray, "T J 3"], Camera]:
    """Return the contents of a JSON file for `keypoint_file.read_keypoints`, the true joints in metres and the true camera."""
    rng, take = np.random.default_rng(seed), synthetic.compose_take(seed=seed, seconds=seconds, rate=rate)
    skeleton = take.subject.skeleton
    detector = load_detector(detector_name, skeleton)
    joints, rotations = compute_world_poses(skeleton, _rotate_heading(take.motion))
    positions = detector.compute_point_positions(joints, rotations)
    middle = CAMERA_SCALE_PX_M * (joints[:, 0, 0].min() + joints[:, 0, 0].max()) / 2
    camera = build_camera(build_camera_rotation(0.0), CAMERA_SCALE_PX_M, np.array([IMAGE_WIDTH_PX / 2 - middle, FLOOR_HEIGHT_PX]))
    confidence = rng.uniform(0.5, 1.0, positions.shape[:2])
    noise = rng.normal(size=positions.shape[:2] + (2,))
    pixels = camera.project(positions) + CAMERA_SCALE_PX_M * KEYPOINT_NOISE_SD_M / confidence[..., None] * noise
    points = np.concatenate([pixels.round(1), confidence.round(2)[..., None]], axis=-1)
    points[rng.random(confidence.shape) < MISSING_KEYPOINT_SHARE] = 0.0
    frames = [{"people": [{detector.json_key: frame.ravel().tolist()}]} for frame in points]
    film = {"order": detector_name, "rate": rate, "image": [IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX], "frames": frames}
    return film, joints, camera


def _rotate_heading(motion: Motion) -> Motion:
    """Return the motion, rotated about the vertical."""
    rotation = Rotation.from_euler("y", SUBJECT_HEADING_RAD).as_matrix()
    local = motion.local_rotations.copy()
    local[:, 0] = rotation @ local[:, 0]
    root = motion.root_position @ rotation.T
    return Motion(root, local, motion.status, motion.iterations, motion.marker_sd, motion.joint_sd)


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
