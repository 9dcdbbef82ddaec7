"""Read 3-D keypoints from JSON, in one file for a film.

Two forms are read, both with "rate" (frames per second) and optionally "unit" (m, cm or mm):

    {"rate": 60, "labels": ["nose", ...], "frames": [[[x, y, z], ...], ...]}
    {"rate": 60, "frames": [{"people": [{"pose_keypoints_3d": [x, y, z, c, ...]}]}, ...]}

In the first, a frame lists one point for each label, or is a mapping from labels to points; null is a missing point. The second
is OpenPose's, with the 25 points of BODY_25 and their confidence c, 0 for a missing point. Of several people in a frame, the
first one is followed.
"""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float

from mocapfix.errors import ReadError
from mocapfix.io.coordinates import METRES_PER_UNIT, get_metres_per_unit
from mocapfix.io.file_content import BYTE_ORDER_MARK, decode_text
from mocapfix.io.frame_rate import choose_rate
from mocapfix.io.marker_table import assume_unit, build_take
from mocapfix.io.shipped import read_shipped_yaml
from mocapfix.model.take import TableLayout, Take
from mocapfix.options import ReadOptions

OPENPOSE_KEY = "pose_keypoints_3d"
OPENPOSE_POINTS_FILE = "keypoints/openpose.yaml"
NUMBERS_PER_OPENPOSE_POINT = 4  # x, y, z and the confidence


def is_keypoint_json(head: bytes) -> bool:
    """Return whether a file with this beginning is a JSON object."""
    return head.lstrip().startswith(b"{")


def read_keypoint_json(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a JSON file.

    Raises:
        ReadError: If the JSON is invalid, has no frames or no rate, or a frame has another number of points. The message names
            the file, the frame (from 0) and the key.
    """
    text, encoding = decode_text(data)
    try:
        content: Any = json.loads(text.removeprefix(BYTE_ORDER_MARK))
    except json.JSONDecodeError as error:
        raise ReadError(f"{path}, line {error.lineno}: is not valid JSON ({error.msg}).") from error
    except (RecursionError, ValueError) as error:  # brackets nested too deeply, a number of thousands of digits
        raise ReadError(f"{path}: is not valid JSON ({error}).") from error
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise ReadError(f"{path}: frames: must be a list of at least one frame; is it a file of 3-D keypoints?")
    mapping = cast("dict[str, Any]", content)
    stated = mapping.get("rate")
    if isinstance(stated, bool) or not isinstance(stated, int | float) or not 0 < stated < math.inf:
        if options.rate_hz is None:
            problem = f"must be frames a second, more than 0, not {stated!r}; add it to the file, or give --rate HZ"
            raise ReadError(f"{path}: rate: {problem}.")
        stated = None
    rate, rate_notes = choose_rate(lambda sentence: ReadError(f"{path}: rate: {sentence}"), stated, options)
    labels, points = _parse_frames(path, mapping, cast("list[Any]", frames))
    unit, notes = options.unit or mapping.get("unit"), rate_notes
    if unit is None:
        unit, note = assume_unit(points)
        notes = (*rate_notes, note)
    unit_m = get_metres_per_unit(unit) if isinstance(unit, str) else None
    if unit_m is None:
        raise ReadError(f"{path}: unit: is {unit!r}; give it with --unit, one of {', '.join(METRES_PER_UNIT)}.")
    notes = (*notes, *describe_unread_hands(frames))
    layout = TableLayout(encoding, "\n", ",", ".", unit_m)
    return build_take(path, points, labels, layout, rate, 1, "Y", notes=notes, options=options)


def describe_unread_hands(frames: Iterable[Any]) -> list[str]:
    """Return a note if the people in OpenPose's frames have keypoints of hands."""
    people = [person for frame in frames if isinstance(frame, dict) for person in cast("Any", frame.get("people")) or ()]
    keys = {key for person in people if isinstance(person, dict) for key, points in cast("Any", person).items() if points}
    return ["OpenPose's keypoints of the hands are not read, so the fingers do not move."] * any(
        each.startswith("hand_") for each in keys
    )


def _parse_frames(path: Path, content: dict[str, Any], frames: list[Any]) -> tuple[list[str], Float[np.ndarray, "T P 3"]]:
    """Return the labels and the coordinates of all frames, NaN where missing."""
    labels = content.get("labels")
    if labels is None:
        names = list(read_shipped_yaml(OPENPOSE_POINTS_FILE)["points"])
        return names, np.stack([_parse_person(path, t, frame, len(names)) for t, frame in enumerate(frames)])
    if not isinstance(labels, list) or not labels or not all(isinstance(label, str) for label in cast("list[Any]", labels)):
        raise ReadError(f"{path}: labels: must be a list of names.")
    names = cast("list[str]", labels)
    return names, np.stack([_parse_points(path, t, frame, names) for t, frame in enumerate(frames)])


def _parse_points(path: Path, t: int, frame: object, labels: list[str]) -> Float[np.ndarray, "P 3"]:
    """Return the points of a frame that lists or maps them."""
    where, missing = f"{path}: frames.{t}", [math.nan] * 3
    if isinstance(frame, dict):
        by_label = cast("dict[str, Any]", frame)
        if unknown := [label for label in by_label if label not in labels]:
            raise ReadError(f"{where}: {unknown[0]}: is not among the labels.")
        listed = [by_label.get(label) for label in labels]
    else:
        listed = cast("list[Any]", frame) if isinstance(frame, list) else []
    if len(listed) != len(labels):
        raise ReadError(f"{where}: must have {len(labels)} points, one for each label.")
    try:
        return np.array([missing if point is None else point for point in listed], float).reshape(len(labels), 3)
    except (TypeError, ValueError) as error:
        raise ReadError(f"{where}: each point must be null or three numbers x, y, z.") from error


def _parse_person(path: Path, t: int, frame: object, point_count: int) -> Float[np.ndarray, "P 3"]:
    """Return the points of the first person in a frame of OpenPose."""
    where = f"{path}: frames.{t}"
    people = cast("dict[str, Any]", frame).get("people") if isinstance(frame, dict) else None
    if not isinstance(people, list):
        raise ReadError(f"{where}: must have people, or the file must have labels.")
    if not people:
        return np.full((point_count, 3), math.nan)
    try:
        numbers = np.array(cast("list[Any]", people)[0][OPENPOSE_KEY], float).reshape(-1, NUMBERS_PER_OPENPOSE_POINT)
    except (KeyError, TypeError, ValueError) as error:
        expected = f"x, y, z and confidence of {point_count} points"
        raise ReadError(f"{where}: people.0.{OPENPOSE_KEY}: must contain {expected}; 2-D keypoints are for scenes.") from error
    if len(numbers) not in (0, point_count):
        raise ReadError(f"{where}: people.0.{OPENPOSE_KEY}: has {len(numbers)} points, not {point_count}.")
    if not len(numbers):
        return np.full((point_count, 3), math.nan)
    return np.where(numbers[:, 3:] > 0, numbers[:, :3], math.nan)
