"""A film of keypoints and the body found in it: a page to look at, and a recording to play.

image      pixels: the camera's own view, and the image's edge where it is known
  keypoints  as they were detected, the paler the less sure
  skeleton   where the camera sees the body
world      Y up, metres
  skeleton   one line from each joint to its parent
"""

from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np

from mocapfix.files.output_files import replace_atomically
from mocapfix.report.html_report import PAGE_COLOURS
from mocapfix.skeleton import Skeleton

KEYPOINT_FIGURE_COUNT = 4  # moments on the page, spread over the film
KEYPOINT_FIGURE_MARGIN = 0.12  # of a picture's larger side, about the body
KEYPOINT_RGB, KEYPOINT_BONE_RGB = (255, 180, 84), (79, 143, 214)  # red, green, blue


@dataclass(frozen=True)
class KeypointFilm:
    """What is shown.

    image       width and height in pixels, if known
    pixels      (T, V, 2), confidence (T, V), 0 where not found
    joints      (T, J, 3) metres, in the world;  images (T, J, 2) pixels: the same as the camera sees them
    """

    title: str
    rate_hz: float
    image_size_px: tuple[float, float] | None
    keypoint_px: np.ndarray
    confidence: np.ndarray
    skeleton: Skeleton
    joint_position_world: np.ndarray
    joint_px: np.ndarray

    @property
    def bones(self) -> np.ndarray:
        """-> (B, 2) parent and child."""
        child = np.flatnonzero(self.skeleton.parents >= 0)
        return np.stack([self.skeleton.parents[child], child], axis=1)


def write_keypoint_recording(target: Path, film: KeypointFilm) -> None:
    """Write a rerun recording (.rrd). Raises WriteError where `target` cannot be written."""
    import rerun as rr
    import rerun.blueprint as rrb

    found, frames = film.confidence > 0, np.arange(len(film.joint_position_world))
    time = [rr.TimeColumn("time", duration=frames / film.rate_hz), rr.TimeColumn("frame", sequence=frames)]
    colours = np.concatenate([np.tile(KEYPOINT_RGB, (found.sum(), 1)), np.round(255 * film.confidence[found])[:, None]], axis=1)
    flat, solid = (at[:, film.bones].astype(np.float32) for at in (film.joint_px, film.joint_position_world))
    count = np.full(len(frames), len(film.bones))
    views = rrb.Horizontal(rrb.Spatial2DView(origin="image", name=film.title), rrb.Spatial3DView(origin="world"))
    with replace_atomically(target) as part:
        to = rr.RecordingStream("mocapfix")
        try:
            to.save(part, default_blueprint=rrb.Blueprint(views, collapse_panels=True))
            to.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
            if film.image_size_px:
                to.log("image", rr.Boxes2D(mins=[[0, 0]], sizes=[film.image_size_px], colors=KEYPOINT_BONE_RGB), static=True)
            to.log("image/keypoints", rr.Points2D.from_fields(radii=3.0), static=True)
            to.log("image/skeleton", rr.LineStrips2D.from_fields(radii=1.0, colors=KEYPOINT_BONE_RGB), static=True)
            to.log("world/skeleton", rr.LineStrips3D.from_fields(radii=0.007, colors=KEYPOINT_BONE_RGB), static=True)
            points = rr.Points2D.columns(positions=film.keypoint_px[found], colors=colours.astype(np.uint8))
            rr.send_columns("image/keypoints", time, points.partition(found.sum(axis=1)), recording=to)
            lines = rr.LineStrips2D.columns(strips=flat.reshape(-1, 2, 2)).partition(count)
            rr.send_columns("image/skeleton", time, lines, recording=to)
            body = rr.LineStrips3D.columns(strips=solid.reshape(-1, 2, 3)).partition(count)
            rr.send_columns("world/skeleton", time, body, recording=to)
        finally:
            to.disconnect()


def write_keypoint_page(target: Path, film: KeypointFilm, report: dict) -> None:
    """Write the page: some moments as the camera saw them, keypoints over the body, and from the side, which it did not see."""
    moments = np.unique(np.linspace(0, len(film.joint_position_world) - 1, KEYPOINT_FIGURE_COUNT + 2)[1:-1].round().astype(int))
    body = _render_facts(report) + '<div class="figures">' + "".join(_render_frame(film, t) for t in moments) + "</div>"
    template = Template(resources.files("mocapfix.report").joinpath("report.html").read_text(encoding="utf-8"))
    size = f"{len(film.joint_position_world)} frames at {film.rate_hz:g} Hz, keypoints in the order of {report['order']}"
    with replace_atomically(target) as part:
        text = template.substitute(title=escape(film.title), subtitle=escape(size), body=body, **PAGE_COLOURS)
        part.write_text(text, encoding="utf-8", newline="\n")


def _render_facts(report: dict) -> str:
    values = [
        (f"{report['camera']['pixels_per_metre']:.1f}", "pixels per metre, estimated"),
        (f"{report['reprojection_px']['mean']:.1f} px", "from keypoint to body, mean"),
        (f"{report['reprojection_px']['p95']:.1f} px", "95th percentile"),
    ]
    return '<div class="facts">' + "".join(f"<div><b>{value}</b><small>{what}</small></div>" for value, what in values) + "</div>"


def _render_frame(film: KeypointFilm, frame: int) -> str:
    """The image's view and the one across it, the body as high in both."""
    height = np.ptp(film.joint_px[frame, :, 1])
    side = (
        film.joint_position_world[frame][:, [2, 1]] * [1, -1] * height / max(np.ptp(film.joint_position_world[frame, :, 1]), 1e-9)
    )
    found = film.confidence[frame] > 0
    seen = "".join(
        f'<circle class="doubted" cx="{x:.1f}" cy="{y:.1f}" r="{0.012 * height:.1f}" opacity="{0.25 + 0.75 * sure:.2f}"/>'
        for (x, y), sure in zip(film.keypoint_px[frame][found], film.confidence[frame][found], strict=True)
    )
    views = ((film.joint_px[frame], seen, "as the camera saw it"), (side, "", "from the left of the image, as nobody saw it"))
    return "".join(
        f"<figure>{_render_skeleton(points, film.bones, more, height)}<figcaption><b>{frame / film.rate_hz:.2f} s</b> {what}</figcaption></figure>"
        for points, more, what in views
    )


def _render_skeleton(joint_px: np.ndarray, bones: np.ndarray, extra_svg: str, body_height_px: float) -> str:
    """-> a picture of joints (J, 2), with more in it; lines as wide as the body's height asks for."""
    margin = KEYPOINT_FIGURE_MARGIN * max(body_height_px, 1.0)
    (left, top), (right, bottom) = joint_px.min(axis=0) - margin, joint_px.max(axis=0) + margin
    path = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in joint_px[bones])
    lines = f'<path class="bones" style="stroke-width:{0.016 * body_height_px:.1f}" d="{path}"/>'
    box = f"{left:.1f} {top:.1f} {right - left:.1f} {bottom - top:.1f}"
    return f'<svg class="figure" viewBox="{box}" role="img">{lines}{extra_svg}</svg>'
