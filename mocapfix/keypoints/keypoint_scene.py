"""Scenes of 2-D keypoints: read the scene file, solve it, and write the motion, a page, a report and a rerun recording.

Entities of the recording:

    image          pixels: the camera's view, with the edge of the image if its size is known
      keypoints    detected keypoints; opacity is confidence
      skeleton     projection of the body
    world          Y up, metres
      skeleton     one line from each joint to its parent
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float, Int
from markupsafe import Markup
from pydantic import Field, PositiveFloat

from mocapfix.errors import SceneError
from mocapfix.io.files import check_outputs_absent, make_output_folder, replace_atomically
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.keypoints.film_solver import Keypoints, build_camera_rotation, read_keypoints, solve_film
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.stage_timer import ProgressCallback, StageTimer
from mocapfix.report.change_figures import Figure
from mocapfix.report.html_report import write_page
from mocapfix.report.recording import check_recording_complete
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.single_pose import Camera, resolve_pose_model
from mocapfix.subject.library import read_subject

KEYPOINT_OUTPUT_KINDS = ("bvh", "report.html", "report.json", "rrd")


STILL_IMAGE_RATE_HZ = 30.0  # rate of the BVH of a single image


class KeypointSceneSettings(StrictModel):
    """The keys of the scene file; paths are relative to its folder."""

    kind: Literal["keypoints-2d"]
    title: str  # one line, for the page
    keypoints: Path  # a file, or the folder that OpenPose wrote; see `film_solver`
    rate: PositiveFloat | None = None  # Hz, if the keypoints' file does not contain it
    # degrees by which the camera is pitched down, which the prior's knowledge of upright poses needs
    looks_down: float = Field(default=0.0, gt=-90, lt=90)
    # a subject file with this person's bone lengths; null for the average body, for which the scale is then estimated
    subject: Path | None = None
    prior: str  # a trained model of poses, or "none"
    prior_scale: PositiveFloat = 1.0  # factor on the prior's standard deviations (2 = weaker prior)


def read_keypoint_scene(path: Path) -> KeypointSceneSettings:
    """Return the scene's settings. Raises SceneError that names the file and the invalid key."""
    return read_yaml_model(KeypointSceneSettings, path)


KEYPOINT_FIGURE_COUNT = 4  # frames on the page, evenly spaced
KEYPOINT_FIGURE_MARGIN = 0.12  # around the body, relative to its height
KEYPOINT_RGB = (255, 180, 84)
KEYPOINT_BONE_RGB = (79, 143, 214)
KEYPOINT_RADIUS = 0.012  # relative to the height of the body
BONE_WIDTH = 0.016  # relative to the height of the body
MIN_OPACITY = 0.25  # of a keypoint with confidence 0


@dataclass(frozen=True)
class KeypointFilm:
    """Keypoints of a film and the body fitted to them."""

    title: str
    rate_hz: float
    image_size_px: tuple[float, float] | None  # width and height in pixels; None if unknown
    keypoint_px: Float[np.ndarray, "T V 2"]  # detected keypoints
    confidence: Float[np.ndarray, "T V"]  # (T, V), 0 for missing keypoints
    skeleton: Skeleton
    joint_position_world: Float[np.ndarray, "T J 3"]  # m
    joint_px: Float[np.ndarray, "T J 2"]  # projections of the joints

    @property
    def bones(self) -> Int[np.ndarray, "B 2"]:
        """Parent and child of each bone."""
        child = np.flatnonzero(self.skeleton.parents >= 0)
        return np.stack([self.skeleton.parents[child], child], axis=1)


def write_keypoint_recording(target: Path, film: KeypointFilm) -> None:
    """Write a rerun recording (.rrd)."""
    found, frames = film.confidence > 0, np.arange(len(film.joint_position_world))
    time = [rr.TimeColumn("time", duration=frames / film.rate_hz), rr.TimeColumn("frame", sequence=frames)]
    opacity = np.round(255 * film.confidence[found])[:, None]
    colours = np.concatenate([np.tile(KEYPOINT_RGB, (found.sum(), 1)), opacity], axis=1)
    bones_px, bones_world = (joints[:, film.bones].astype(np.float32) for joints in (film.joint_px, film.joint_position_world))
    bone_counts = np.full(len(frames), len(film.bones))
    views = rrb.Horizontal(rrb.Spatial2DView(origin="image", name=film.title), rrb.Spatial3DView(origin="world"))
    with replace_atomically(target) as part:
        recording = rr.RecordingStream("mocapfix")
        try:
            recording.save(part, default_blueprint=rrb.Blueprint(views, collapse_panels=True))
            recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
            if film.image_size_px:
                edge = rr.Boxes2D(mins=[[0, 0]], sizes=[film.image_size_px], colors=KEYPOINT_BONE_RGB)
                recording.log("image", edge, static=True)
            recording.log("image/keypoints", rr.Points2D.from_fields(radii=3.0), static=True)
            style_px = rr.LineStrips2D.from_fields(radii=1.0, colors=KEYPOINT_BONE_RGB)
            recording.log("image/skeleton", style_px, static=True)
            style_world = rr.LineStrips3D.from_fields(radii=0.007, colors=KEYPOINT_BONE_RGB)
            recording.log("world/skeleton", style_world, static=True)
            points = rr.Points2D.columns(positions=film.keypoint_px[found], colors=colours.astype(np.uint8))
            rr.send_columns("image/keypoints", time, points.partition(found.sum(axis=1)), recording=recording)
            lines = rr.LineStrips2D.columns(strips=bones_px.reshape(-1, 2, 2)).partition(bone_counts)
            rr.send_columns("image/skeleton", time, lines, recording=recording)
            body = rr.LineStrips3D.columns(strips=bones_world.reshape(-1, 2, 3)).partition(bone_counts)
            rr.send_columns("world/skeleton", time, body, recording=recording)
        finally:
            recording.disconnect()
        check_recording_complete(part)


def write_keypoint_page(target: Path, film: KeypointFilm, report: Mapping[str, Any]) -> None:
    """Write a page with some frames as seen by the camera, keypoints over the body, and the same frames from the side."""
    frame_count = len(film.joint_position_world)
    frames = np.unique(np.linspace(0, frame_count - 1, KEYPOINT_FIGURE_COUNT + 2)[1:-1].round().astype(int))
    write_page(
        target,
        "keypoint_report.html.jinja",
        title=film.title,
        subtitle=f"{frame_count} frames at {film.rate_hz:g} Hz, keypoint order {report['order']}",
        facts=_build_facts(report),
        figures=[figure for frame in frames for figure in _draw_frame(film, int(frame))],
    )


def _build_facts(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the key numbers: value and text."""
    error_px = report["reprojection_px"]
    return [
        (f"{report['camera']['pixels_per_metre']:.1f}", "pixels per metre, estimated"),
        (f"{error_px['mean']:.1f} px", "mean reprojection error"),
        (f"{error_px['p95']:.1f} px", "95th percentile"),
    ]


def _draw_frame(film: KeypointFilm, frame: int) -> tuple[Figure, Figure]:
    """Return the view of the camera and the view from the side, with the same height of the body."""
    height_px = np.ptp(film.joint_px[frame, :, 1])
    joints = film.joint_position_world[frame]
    side_px = joints[:, [2, 1]] * [1, -1] * height_px / max(np.ptp(joints[:, 1]), 1e-9)
    found = film.confidence[frame] > 0
    keypoints = "".join(
        f'<circle class="suspect" cx="{x:.1f}" cy="{y:.1f}" r="{KEYPOINT_RADIUS * height_px:.1f}" '
        f'opacity="{MIN_OPACITY + (1 - MIN_OPACITY) * confidence:.2f}"/>'
        for (x, y), confidence in zip(film.keypoint_px[frame][found], film.confidence[frame][found], strict=True)
    )
    name = f"{frame / film.rate_hz:.2f} s"
    return (
        Figure(_draw_skeleton(film.joint_px[frame], film.bones, keypoints, height_px), name, "camera view"),
        Figure(_draw_skeleton(side_px, film.bones, "", height_px), name, "side view, from the left of the image"),
    )


def _draw_skeleton(
    joint_px: Float[np.ndarray, "J 2"], bones: Int[np.ndarray, "B 2"], keypoint_svg: str, body_height_px: float
) -> Markup:
    """Return an SVG of bones and keypoints; line widths are proportional to the height of the body."""
    margin = KEYPOINT_FIGURE_MARGIN * max(body_height_px, 1.0)
    (left, top), (right, bottom) = joint_px.min(axis=0) - margin, joint_px.max(axis=0) + margin
    path = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in joint_px[bones])
    lines = f'<path class="bones" style="stroke-width:{BONE_WIDTH * body_height_px:.1f}" d="{path}"/>'
    box = f"{left:.1f} {top:.1f} {right - left:.1f} {bottom - top:.1f}"
    return Markup(f'<svg class="figure" viewBox="{box}" role="img">{lines}{keypoint_svg}</svg>')


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
        return self._positions[0]

    @property
    def reprojection_error_px(self) -> Float[np.ndarray, "T V"]:
        """Distances from each keypoint to the image of its point on the body; NaN for a missing keypoint."""
        distance = np.linalg.norm(self.camera.project(self._positions[1]) - self.keypoints.position_px, axis=-1)
        return np.where(self.keypoints.confidence > 0, distance, np.nan)

    @property
    def report(self) -> dict[str, Any]:
        """The JSON report."""
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
            "notes": self.keypoints.notes,
        }

    def write(self, folder: Path, overwrite: bool = False) -> dict[str, Path]:
        """Write the motion as BVH, a page, a report and a recording. Return the files by kind.

        Raises:
            WriteError: If one exists already (and overwrite is False), or cannot be written.
        """
        from mocapfix.io.bvh import write_bvh

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


def run_keypoint_scene(path: Path, progress: ProgressCallback | None = None) -> KeypointResult:
    """Return motion and camera of the film of a scene file.

    Raises:
        TakeError: For keypoints that do not determine a body.
    """
    settings, timer = read_keypoint_scene(path), StageTimer(report_progress=progress)
    with timer("read"):
        of_subject = read_subject(path.parent / settings.subject) if settings.subject else None
        skeleton = of_subject.skeleton if of_subject else load_cmu31_body().skeleton
        keypoints = read_keypoints(path.parent / settings.keypoints, skeleton)
        model = resolve_pose_model(settings.prior, skeleton)
    rate = keypoints.rate_hz or settings.rate or (STILL_IMAGE_RATE_HZ if keypoints.frame_count == 1 else None)
    if rate is None:
        raise SceneError(f"{path}: rate: give the frames per second of {settings.keypoints}, which does not contain them.")
    with timer("solve"):
        rotation = build_camera_rotation(float(np.radians(settings.looks_down)))
        motion, camera = solve_film(keypoints, rate, skeleton, model, rotation, settings.prior_scale)
    return KeypointResult(path.stem, settings.title, keypoints, rate, skeleton, motion, camera, settings.prior, timer)
