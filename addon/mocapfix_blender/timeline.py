"""The scene's frame rate and range, and markers on its timeline where a take is uncertain."""

import json
from collections.abc import Sequence

import bpy
import numpy as np

from .uncertain_stretches import UncertainStretch

TIMELINE_PROPERTY = "mocapfix_timeline"
"""custom property of the scene: the names and frames of the timeline markers of each take, as JSON"""
MAX_MARKED_STRETCHES = 200
"""stretches of a take with markers on the timeline, the longest ones"""
END_PREFIX = "end: "


def set_rate_and_range(scene: bpy.types.Scene, rate: float, first_frame: int, frame_count: int) -> None:
    """Set the scene's frame rate and its range of frames."""
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate
    scene.frame_start, scene.frame_end = first_frame, first_frame + frame_count - 1


def compute_scene_frames(scene: bpy.types.Scene, frame_count: int, rate: float, first_frame: int) -> np.ndarray:
    """Return the frames of the scene at which the frames of a take are shown, not necessarily whole."""
    scene_rate = scene.render.fps / scene.render.fps_base
    # Rates that agree to six digits are the same: Blender stores them in single precision.
    ratio = 1.0 if abs(scene_rate / rate - 1.0) < 1e-6 else scene_rate / rate
    return first_frame + np.arange(frame_count) * ratio


def mark_uncertain_stretches(
    scene: bpy.types.Scene, take_key: str, stretches: Sequence[UncertainStretch], first_frame: int
) -> None:
    """Put a marker at the first and the last frame of each stretch; remove those of an earlier import of the take.

    A marker that the user has renamed or moved stays.
    """
    recorded = json.loads(scene.get(TIMELINE_PROPERTY, "{}"))
    earlier = {(name, frame) for name, frame in recorded.pop(take_key, [])}
    for marker in [each for each in scene.timeline_markers if (each.name, each.frame) in earlier]:
        scene.timeline_markers.remove(marker)
    rate = scene.render.fps / scene.render.fps_base
    written = []
    for stretch in sorted(stretches, key=lambda each: each.first_s - each.last_s)[:MAX_MARKED_STRETCHES]:
        first, last = (first_frame + round(seconds * rate) for seconds in (stretch.first_s, stretch.last_s))
        for text, frame in ((stretch.text, first), (f"{END_PREFIX}{stretch.text}", last)):
            if text == stretch.text or last > first:
                marker = scene.timeline_markers.new(text, frame=frame)
                written.append((marker.name, marker.frame))
    recorded[take_key] = written
    scene[TIMELINE_PROPERTY] = json.dumps(recorded)
