"""HTML page and rerun recording of 2-D keypoints and the body fitted to them.

Entities of the recording:

    image          pixels: the camera's view, with the edge of the image if its size is known
      keypoints    detected keypoints; opacity is confidence
      skeleton     projection of the body
    world          Y up, metres
      skeleton     one line from each joint to its parent
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup

from mocapfix.io.files import replace_atomically
from mocapfix.model.skeleton import Skeleton
from mocapfix.report.change_list import Figure
from mocapfix.report.html_report import write_page
from mocapfix.report.recording import check_recording_complete

KEYPOINT_FIGURE_COUNT = 4  # frames on the page, evenly spaced
KEYPOINT_FIGURE_MARGIN = 0.12  # around the body, relative to its height
KEYPOINT_RGB = (255, 180, 84)
KEYPOINT_BONE_RGB = (79, 143, 214)
KEYPOINT_RADIUS = 0.012  # relative to the height of the body
BONE_WIDTH = 0.016  # relative to the height of the body
MIN_OPACITY = 0.25  # of a keypoint with confidence 0


class CameraEntry(TypedDict):
    """The estimated camera."""

    pixels_per_metre: float
    origin_px: list[float]
    pitch_down_deg: float


class ReprojectionSummary(TypedDict):
    """Distances of the keypoints from the projected body in pixels."""

    mean: float
    p95: float
    by_keypoint: dict[str, float | None]


class KeypointReport(TypedDict):
    """The JSON report of a motion fitted to keypoints.

    order   keypoint order of the detector
    status  number of frames by final status of the solver
    """

    scene: str
    frames: int
    rate_hz: float
    order: str
    prior: str
    camera: CameraEntry
    reprojection_px: ReprojectionSummary
    status: dict[str, int]
    seconds: dict[str, float]


@dataclass(frozen=True)
class KeypointFilm:
    """Keypoints of a film and the body fitted to them.

    image_size_px         width and height in pixels; None if unknown
    keypoint_px           (T, V, 2) detected keypoints
    confidence            (T, V), 0 for missing keypoints
    joint_position_world  (T, J, 3) m
    joint_px              (T, J, 2) projections of the joints
    """

    title: str
    rate_hz: float
    image_size_px: tuple[float, float] | None
    keypoint_px: Float[np.ndarray, "T V 2"]
    confidence: Float[np.ndarray, "T V"]
    skeleton: Skeleton
    joint_position_world: Float[np.ndarray, "T J 3"]
    joint_px: Float[np.ndarray, "T J 2"]

    @property
    def bones(self) -> Int[np.ndarray, "B 2"]:
        """Parent and child of each bone."""
        child = np.flatnonzero(self.skeleton.parents >= 0)
        return np.stack([self.skeleton.parents[child], child], axis=1)


def write_keypoint_recording(target: Path, film: KeypointFilm) -> None:
    """Write a rerun recording (.rrd).

    Raises WriteError if `target` cannot be written.
    """
    import rerun as rr
    import rerun.blueprint as rrb

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


def write_keypoint_page(target: Path, film: KeypointFilm, report: KeypointReport) -> None:
    """Write a page with some frames as seen by the camera, keypoints over the body, and the same frames from the side.

    Raises WriteError if `target` cannot be written.
    """
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


def _build_facts(report: KeypointReport) -> list[tuple[str, str]]:
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
