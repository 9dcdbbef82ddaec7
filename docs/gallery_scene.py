"""The scenes of the gallery: mannequins, markers and paths before and after, drawn by Chromium with three.js.

docs/generate_gallery.py composes the scenes; docs/gallery_scene.html draws them.
"""

import io
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageOps
from playwright.sync_api import Browser, Page, Route

from mocapfix.review.server import find_three_module
from mocapfix.stats.sequences import find_runs

DOCS = Path(__file__).parent.resolve()
PICTURES = DOCS / "gallery"
WIDTH_PX, HEIGHT_PX = 800, 420
CLIP_FRAMES_PER_S = 20
CLIP_QUALITY = 70
PICTURE_COLOURS = 256
PAGE_FRAME = "#c3ccd6"  # around the picture of a page, which may be as white as the page that shows it
MEASURED, FAULTY, ESTIMATED, RELABELLED, UNLABELLED = "#46525f", "#e0382c", "#12a150", "#7a4df0", "#e0992c"
BODY, CHARACTER = "#b9c6d6", "#e5b78e"
LEGEND = {
    "measured": (MEASURED, False),
    "lost": (FAULTY, True),
    "faulty": (FAULTY, False),
    "ghost": (FAULTY, False),
    "standing foot that slides": (FAULTY, False),
    "estimated": (ESTIMATED, False),
    "repaired": (ESTIMATED, False),
    "standing foot": (ESTIMATED, False),
    "labelled": (RELABELLED, False),
    "without a label": (UNLABELLED, False),
}
"""The colour of each name in a legend, and whether it stands for a ring."""
BALL_M, TRAIL_M = 0.017, 0.007

Joints = dict[str, Float[np.ndarray, " 3"]]
SIDE_PARTS = (
    ("LeftUpLeg", "LeftLeg", 0.07, 0.048), ("LeftLeg", "LeftFoot", 0.048, 0.034), ("LeftFoot", "LeftToeBase", 0.036, 0.027),
    ("LeftShoulder", "LeftArm", 0.055, 0.048), ("LeftArm", "LeftForeArm", 0.044, 0.034),
    ("LeftForeArm", "LeftHand", 0.034, 0.024),
)  # fmt: skip
"""Parts of a mannequin's left side: the joints at both ends, and the radii there in metres. The right side is the same."""
TRUNK_PARTS = (("Hips", "Spine", 0.085, 0.08, 1.55), ("Spine", "Chest", 0.08, 0.095, 1.55), ("Neck", "Head", 0.048, 0.042, 1.0))
"""The same of the trunk, with its width relative to its depth."""
LENGTHENED_PARTS = (("LeftForeArm", "LeftHand", 0.085, 0.03), ("LeftFoot", "LeftToeBase", 0.05, 0.024))
"""Parts beyond the last joints: the two joints that give the direction, the length and the radius in metres."""
HEAD_RADIUS_M, HEAD_RISE_M = 0.095, 0.055
LEFT_ARM = ("LeftArm", "LeftForeArm", "LeftHand")


@dataclass(frozen=True)
class View:
    """A camera that looks at a point from a direction; lengths in metres, angles in degrees."""

    target: Float[np.ndarray, " 3"]
    distance: float
    yaw: float  # from the front (+Z) to the left of the person
    pitch: float = 8.0  # above the horizontal
    angle: float = 28.0  # vertical field of view

    def describe(self) -> dict[str, Any]:
        """Return the view for the page."""
        yaw, pitch = np.radians(self.yaw), np.radians(self.pitch)
        towards = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        side = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
        sun = 1.5 * towards * [1, 0, 1] - 1.2 * side + [0.0, 4.0, 0.0]
        eye = self.target + self.distance * towards
        points = {"target": self.target.tolist(), "eye": eye.tolist(), "sun": sun.tolist()}
        return {**points, "angle": self.angle, "distance": self.distance}


@dataclass(frozen=True)
class Panel:
    """One half of a picture: what is drawn, with a heading at both sides and the names of the colours."""

    name: str
    error: str
    legend: tuple[str, ...]
    bodies: list[dict[str, Any]] = field(default_factory=list)
    balls: list[dict[str, Any]] = field(default_factory=list)
    rings: list[dict[str, Any]] = field(default_factory=list)
    trails: list[dict[str, Any]] = field(default_factory=list)
    labels: list[dict[str, Any]] = field(default_factory=list)

    def add_body(
        self, joints: Joints, colour: str = BODY, opacity: float = 1.0, marked: Collection[str] = (), mark: str = ""
    ) -> None:
        """Add a mannequin; the parts that begin at the joints `marked` have the colour `mark`."""
        self.add_parts(joints, joints.keys() - set(marked), colour, opacity)
        self.add_parts(joints, marked, mark, opacity)

    def add_parts(self, joints: Joints, starts: Collection[str], colour: str, opacity: float) -> None:
        """Add the parts of a mannequin that begin at some joints."""
        parts = [part for joint, part in list_parts(joints) if joint in starts]
        self.bodies.append({"parts": parts, "colour": colour, "opacity": opacity})

    def add_balls(self, positions: Float[np.ndarray, "N 3"], colour: str, radius: float = BALL_M) -> None:
        """Add balls at the positions that are known."""
        known = positions[np.isfinite(positions).all(axis=1)]
        self.balls.extend({"position": each.tolist(), "colour": colour, "radius": radius} for each in known)

    def add_rings(self, positions: Float[np.ndarray, "N 3"], colour: str, radius: float = 1.5 * BALL_M) -> None:
        """Add rings, which face the viewer and are hidden by nothing."""
        self.rings.extend({"position": each.tolist(), "colour": colour, "radius": radius} for each in positions)

    def add_trail(self, points: Float[np.ndarray, "N 3"], colour: str, dashed: bool = False, radius: float = TRAIL_M) -> None:
        """Add the path of a marker where it is known; every third point is enough for a smooth curve."""
        for first, last in find_runs(np.array(np.isfinite(points).all(axis=1))):
            if last > first:
                part = points[sorted({*range(first, last, 3), last})]
                self.trails.append({"points": part.tolist(), "colour": colour, "radius": radius, "dashed": dashed})

    def add_label(self, text: str, position: Float[np.ndarray, " 3"], colour: str, shift: tuple[int, int] = (0, -18)) -> None:
        """Add a text beside a point, shifted in pixels to the right and down."""
        self.labels.append({"text": text, "position": position.tolist(), "colour": colour, "shift": shift})

    def describe(self) -> dict[str, Any]:
        """Return the panel for the page."""
        return {**self.__dict__, "legend": [(name, *LEGEND[name]) for name in self.legend]}


def list_parts(joints: Joints) -> list[tuple[str, list[Any]]]:
    """Return the parts of a mannequin: the joint at which each begins, and its ends and radii."""
    hips, chest = 0.5 * (joints["LeftUpLeg"] + joints["RightUpLeg"]), 0.3 * joints["Spine1"] + 0.7 * joints["Neck"]
    joints = joints | {"Hips": hips, "Chest": chest}
    parts: list[tuple[str, list[Any]]] = []
    for start, end, *shape in TRUNK_PARTS:
        across = joints["LeftUpLeg"] - joints["RightUpLeg"] if start == "Hips" else joints["LeftArm"] - joints["RightArm"]
        parts.append((start, [joints[start].tolist(), joints[end].tolist(), *shape[:2], across.tolist(), shape[2]]))
    rise = (joints["Head"] - joints["Neck"]) / np.linalg.norm(joints["Head"] - joints["Neck"]) * HEAD_RISE_M
    skull = [joints["Head"] + share * rise for share in (0.4, 1.3)]
    parts.append(("Head", [*(each.tolist() for each in skull), HEAD_RADIUS_M * 0.9, HEAD_RADIUS_M]))
    for side in ("Left", "Right"):
        for start, end, *radii in SIDE_PARTS:
            start, end = start.replace("Left", side), end.replace("Left", side)
            parts.append((start, [joints[start].tolist(), joints[end].tolist(), *radii]))
        for before, last, length_m, radius in LENGTHENED_PARTS:
            start, end = joints[before.replace("Left", side)], joints[last.replace("Left", side)]
            tip = end + (end - start) / np.linalg.norm(end - start) * length_m * (1 if "Hand" in last else [1, 0, 1])
            parts.append((last.replace("Left", side), [end.tolist(), tip.tolist(), radius, 0.8 * radius]))
    return parts


def name_joints(names: Sequence[str], positions: Float[np.ndarray, "J 3"]) -> Joints:
    """Return positions by name, without a prefix such as Mixamo's."""
    return {name.split(":")[-1]: position for name, position in zip(names, positions, strict=True)}


class Studio:
    """Chromium with the page of the scenes."""

    def __init__(self, browser: Browser) -> None:
        self.browser = browser
        self._pages: dict[int, Page] = {}

    def _open_page(self, pixel_ratio: int) -> Page:
        if pixel_ratio not in self._pages:
            page = self.browser.new_page(viewport={"width": WIDTH_PX, "height": HEIGHT_PX}, device_scale_factor=pixel_ratio)
            page.route("http://gallery/**", serve_scene)
            page.goto("http://gallery/scene.html")
            page.wait_for_function("window.isReady")
            self._pages[pixel_ratio] = page
        return self._pages[pixel_ratio]

    def draw(self, panels: Sequence[Panel], views: Sequence[View], pixel_ratio: int = 2) -> Image.Image:
        """Return the picture of panels side by side, each with its view."""
        page = self._open_page(pixel_ratio)
        scene = {
            "panels": [each.describe() for each in panels],
            "views": [each.describe() for each in views],
            "height": HEIGHT_PX,
        }
        page.evaluate("scene => draw(scene)", scene)
        return Image.open(io.BytesIO(page.locator("#card").screenshot())).convert("RGB")


def serve_scene(route: Route) -> None:
    """Answer a request of the page of the scenes: with the page itself, or with three.js."""
    route.fulfill(path=find_three_module() if route.request.url.endswith("three.js") else DOCS / "gallery_scene.html")


def save_picture(name: str, picture: Image.Image) -> None:
    """Save a picture of a scene with as few bytes as its soft shades need."""
    few = picture.quantize(PICTURE_COLOURS, Image.Quantize.MEDIANCUT, kmeans=3, dither=Image.Dither.NONE)
    few.save(PICTURES / f"{name}.png", optimize=True)


def save_page(name: str, page: Page) -> None:
    """Save what a page shows; its colours are few, but even the rare ones are kept."""
    picture = ImageOps.expand(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), 2, PAGE_FRAME)
    few = picture.quantize(PICTURE_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(PICTURES / f"{name}.png", optimize=True)


def save_clip(name: str, frames: Sequence[Image.Image]) -> None:
    """Save an animated WebP that repeats."""
    first, *others = frames
    target, duration_ms = PICTURES / f"{name}.webp", round(1000 / CLIP_FRAMES_PER_S)
    first.save(target, save_all=True, append_images=others, duration=duration_ms, loop=0, quality=CLIP_QUALITY, method=6)


def compute_error_mm(first: Float[np.ndarray, "*n 3"], second: Float[np.ndarray, "*n 3"]) -> float:
    """Return the root mean square distance in millimetres."""
    return float(np.sqrt(np.nanmean(np.sum((first - second) ** 2, axis=-1))) * 1e3)
