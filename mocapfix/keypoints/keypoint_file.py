"""Reading keypoints: what a detector found in the images of a film, or in one.

Either one JSON file for a film,

    {"order": "openpose", "rate": 30, "image": [1280, 720], "frames": [{"people": [{"pose_keypoints_2d": [x, y, c, ...]}]}, ...]}

x and y in pixels, to the right and down, c from 0 (not found) to 1 (sure); or what OpenPose itself writes: a folder with a
JSON file for each frame, in the order of their names, or one such file. A frame is the same in both. COCO's people hold
their points as "keypoints".
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError, SceneError
from mocapfix.keypoints import detectors
from mocapfix.keypoints.detectors import KeypointDetector
from mocapfix.skeleton import Skeleton

FRAME_FILE_DETECTOR = "openpose"  # what writes a file for each frame


@dataclass(frozen=True)
class Keypoints:
    """One person's keypoints over T frames.

    pixels      (T, V, 2) to the right and down; anything where the confidence is 0
    confidence  (T, V) 0 to 1; 0 where a point was not found
    rate        Hz; None where the file does not say it
    image       width and height in pixels; None where the file does not say them
    """

    detector: KeypointDetector
    position_px: np.ndarray
    confidence: np.ndarray
    rate_hz: float | None
    image_size_px: tuple[float, float] | None

    @property
    def frame_count(self) -> int:
        return len(self.position_px)


def read_keypoints(path: Path, skeleton: Skeleton) -> Keypoints:
    """-> the keypoints of the person of whom most is seen, in a file or in OpenPose's folder.

    Raises ReadError naming the file, the frame (from 0) and the key that is not as it must be.
    """
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    if not files:
        raise ReadError(f"{path}: holds no keypoints (.json); give a file, or the folder that OpenPose wrote.")
    said = _read_json(files[0])
    if "people" in said:
        order, rate, image = FRAME_FILE_DETECTOR, None, None
        frames = [(str(file), _read_json(file)) for file in files]
    else:
        order, rate, image = _parse_header(path, said)
        frames = [(f"{path}: frames.{t}", frame) for t, frame in enumerate(said["frames"])]
    try:
        known = detectors.load_detector(order, skeleton)
    except SceneError as error:
        raise ReadError(f"{path}: order: {error}") from error
    points = track_person([_parse_people(where, frame, known) for where, frame in frames], len(known.labels))
    if not points[..., 2].any():
        raise ReadError(f"{path}: nobody was found in any frame.")
    return Keypoints(known, np.ascontiguousarray(points[..., :2]), np.ascontiguousarray(points[..., 2]), rate, image)


def track_person(people: list[np.ndarray], points: int) -> np.ndarray:
    """-> (T, V, 3) one person of those found in each frame (N, V, 3), x, y and confidence; zero where nobody was.

    He is the one of whom most is seen in the first frame with people; then the one nearest to where he was last.
    """
    path, last = np.zeros((len(people), points, 3)), None
    for t, found in enumerate(people):
        if not len(found):
            continue
        chosen = found[found[..., 2].sum(axis=1).argmax()]
        if last is not None:
            both = found[..., 2] * last[:, 2]
            apart = np.linalg.norm(found[..., :2] - last[:, :2], axis=-1)
            distance = (both * apart).sum(axis=1) / np.maximum(both.sum(axis=1), 1e-9)
            chosen = found[np.where(both.any(axis=1), distance, np.inf).argmin()]
        path[t] = last = chosen
    return path


def _read_json(path: Path) -> dict:
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ReadError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from error
    except json.JSONDecodeError as error:
        raise ReadError(f"{path}, line {error.lineno}: is not valid JSON ({error.msg}).") from error
    if not isinstance(said, dict) or not ("people" in said or "frames" in said):
        raise ReadError(f"{path}: holds neither frames nor people; is it a file of keypoints?")
    return said


def _parse_header(path: Path, said: dict) -> tuple[str, float | None, tuple[float, float] | None]:
    """-> order, rate and image, as the file says them."""
    order, rate, image = said.get("order"), said.get("rate"), said.get("image")
    if not isinstance(order, str):
        raise ReadError(f"{path}: order: must be one of {', '.join(detectors.list_detectors())}, not {order!r}.")
    if rate is not None and not (isinstance(rate, int | float) and 0 < rate < np.inf):
        raise ReadError(f"{path}: rate: must be frames a second, more than 0, not {rate!r}.")
    if image is not None and not (isinstance(image, list) and len(image) == 2 and all(_is_positive(side) for side in image)):
        raise ReadError(f"{path}: image: must be [width, height] in pixels, not {image!r}.")
    if not isinstance(said["frames"], list) or not said["frames"]:
        raise ReadError(f"{path}: frames: must be a list of at least one frame.")
    return order, rate, tuple(image) if image else None


def _is_positive(number: object) -> bool:
    return isinstance(number, int | float) and 0 < number < np.inf


def _parse_people(where: str, frame: object, known: KeypointDetector) -> np.ndarray:
    """-> (N, V, 3) the people of a frame: x, y and confidence, this from 0 to 1."""
    people = frame.get("people") if isinstance(frame, dict) else None
    if not isinstance(people, list):
        raise ReadError(f"{where}: people: must be a list.")
    found = np.zeros((len(people), len(known.labels), 3))
    for n, person in enumerate(people):
        try:
            numbers = np.array(person[known.json_key], float)
            found[n] = numbers.reshape(len(known.labels), 3)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            held = f"x, y and confidence of {len(known.labels)} points ({known.name})"
            raise ReadError(f"{where}: people.{n}.{known.json_key}: must hold {held}.") from error
    if not np.isfinite(found).all():
        raise ReadError(f"{where}: people: holds a number that is not finite.")
    found[..., 2] = found[..., 2].clip(0, 1)
    return found
