"""Detectors of keypoints, and reading what they found in the images of a film, or in one image.

The formats are one JSON file for a film,

    {"order": "openpose", "rate": 30, "image": [1280, 720], "frames": [{"people": [{"pose_keypoints_2d": [x, y, c, ...]}]}, ...]}

x and y in pixels, to the right and down, c the confidence from 0 (not found) to 1; or OpenPose's own output: a folder with a JSON
file for each frame, ordered by name, or one such file. A frame is the same in both. With COCO's points the key is "keypoints".
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from pydantic import PositiveFloat

from mocapfix.errors import ReadError, SceneError
from mocapfix.io.keypoint_json import describe_unread_hands
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.model.skeleton import Skeleton


@dataclass(frozen=True)
class KeypointDetector:
    """The V keypoints of a detector."""

    name: str
    json_key: str  # the key of a person's points in its JSON
    labels: tuple[str, ...]  # V names
    joints: Int[np.ndarray, " V"]  # the joint that carries each
    offsets: Float[np.ndarray, "V 3"]  # metres, in the joint's axes
    # standard deviation per axis of a point detected with confidence 1, people's differences included
    sd_m: Float[np.ndarray, " V"]

    def compute_point_positions(
        self, joints: Float[np.ndarray, "T J 3"], rotations: Float[np.ndarray, "T J 3 3"]
    ) -> Float[np.ndarray, "T V 3"]:
        """Return the keypoints' world positions in metres, for joints' world positions and rotations."""
        return joints[:, self.joints] + np.einsum("tvab,vb->tva", rotations[:, self.joints], self.offsets)


class _DetectorPoint(StrictModel):
    joint: str
    offset: tuple[float, float, float]
    sd: PositiveFloat


class _DetectorFile(StrictModel):
    name: str
    key: str
    points: dict[str, _DetectorPoint]


def list_detectors() -> list[str]:
    return sorted(path.stem for path in (find_shipped_folder("scenes") / "keypoints").glob("*.yaml"))


def load_detector(name: str, skeleton: Skeleton) -> KeypointDetector:
    """Return the detector scenes/keypoints/NAME.yaml. Raises SceneError that lists the shipped ones, or names the invalid key."""
    if name not in list_detectors():
        raise SceneError(f"Unknown keypoint order {name!r}; choose one of: {', '.join(list_detectors())}.")
    file = read_yaml_model(_DetectorFile, find_shipped_folder("scenes") / "keypoints" / f"{name}.yaml")
    points = file.points.values()
    for label, point in file.points.items():
        if point.joint not in skeleton.names:
            raise SceneError(f"keypoints/{name}.yaml: points.{label}.joint: the skeleton has no joint {point.joint!r}.")
    joints = np.array([skeleton.find_joint(point.joint) for point in points])
    offsets, sd_m = np.array([point.offset for point in points]), np.array([point.sd for point in points])
    return KeypointDetector(file.name, file.key, tuple(file.points), joints, offsets, sd_m)


FRAME_FILE_DETECTOR = "openpose"  # the detector that writes a file for each frame
MIN_SHARED_CONFIDENCE = 1e-9  # sum of two people's confidences, by which a distance is divided


@dataclass(frozen=True)
class Keypoints:
    """One person's keypoints over T frames."""

    detector: KeypointDetector
    position_px: Float[np.ndarray, "T V 2"]  # to the right and down; anything where the confidence is 0
    confidence: Float[np.ndarray, "T V"]  # 0 to 1; 0 where a point was not found
    rate_hz: float | None  # None if the file does not contain it
    image_size_px: tuple[float, float] | None  # width and height; None if the file does not contain them
    notes: list[str] = field(default_factory=list)

    @property
    def frame_count(self) -> int:
        return len(self.position_px)


def read_keypoints(path: Path, skeleton: Skeleton) -> Keypoints:
    """Return the most visible person's keypoints. Raises ReadError that names the file, the frame (from 0) and the key."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    if not files:
        raise ReadError(f"{path}: contains no keypoints (.json); give a file, or the folder that OpenPose wrote.")
    content = _read_json(files[0])
    if "people" in content:
        order, rate, image = FRAME_FILE_DETECTOR, None, None
        frames = [(str(file), _read_json(file)) for file in files]
    else:
        order, rate, image = _parse_header(path, content)
        frames = [(f"{path}: frames.{t}", frame) for t, frame in enumerate(content["frames"])]
    try:
        detector = load_detector(order, skeleton)
    except SceneError as error:
        raise ReadError(f"{path}: order: {error}") from error
    points = track_person([_parse_people(where, frame, detector) for where, frame in frames], len(detector.labels))
    if not points[..., 2].any():
        raise ReadError(f"{path}: no person was found in any frame.")
    position_px, confidence = np.ascontiguousarray(points[..., :2]), np.ascontiguousarray(points[..., 2])
    return Keypoints(detector, position_px, confidence, rate, image, describe_unread_hands(frame for _, frame in frames))


def track_person(people: list[Float[np.ndarray, "_ V 3"]], points: int) -> Float[np.ndarray, "T V 3"]:
    """Return the points (x, y, confidence) of one of the people found in each frame; zero where no person was found.

    The person is the most visible one in the first frame with people, and then the one nearest to their last position.
    """
    track, last = np.zeros((len(people), points, 3)), None
    for t, found in enumerate(people):
        if not len(found):
            continue
        person = found[found[..., 2].sum(axis=1).argmax()]
        if last is not None:
            weight = found[..., 2] * last[:, 2]
            distance = np.linalg.norm(found[..., :2] - last[:, :2], axis=-1)
            mean_distance = (weight * distance).sum(axis=1) / np.maximum(weight.sum(axis=1), MIN_SHARED_CONFIDENCE)
            person = found[np.where(weight.any(axis=1), mean_distance, np.inf).argmin()]
        track[t] = last = person
    return track


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ReadError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from error
    except json.JSONDecodeError as error:
        raise ReadError(f"{path}, line {error.lineno}: is not valid JSON ({error.msg}).") from error
    if not isinstance(content, dict) or not ("people" in content or "frames" in content):
        raise ReadError(f"{path}: contains neither frames nor people; is it a file of keypoints?")
    return content  # pyright: ignore[reportUnknownVariableType] (JSON)


def _parse_header(path: Path, content: dict[str, Any]) -> tuple[str, float | None, tuple[float, float] | None]:
    """Return order, rate and image size of a film's file."""
    order, rate, image = content.get("order"), content.get("rate"), content.get("image")
    if not isinstance(order, str):
        raise ReadError(f"{path}: order: must be one of {', '.join(list_detectors())}, not {order!r}.")
    if rate is not None and not (isinstance(rate, int | float) and 0 < rate < np.inf):
        raise ReadError(f"{path}: rate: must be frames a second, more than 0, not {rate!r}.")
    sides = image if isinstance(image, list) and len(image) == 2 else [0]
    if image is not None and not all(isinstance(side, int | float) and 0 < side < np.inf for side in sides):
        raise ReadError(f"{path}: image: must be [width, height] in pixels, not {image!r}.")
    if not isinstance(content["frames"], list) or not content["frames"]:
        raise ReadError(f"{path}: frames: must be a list of at least one frame.")
    size = (float(image[0]), float(image[1])) if image else None
    return order, None if rate is None else float(rate), size


def _parse_people(where: str, frame: object, detector: KeypointDetector) -> Float[np.ndarray, "N V 3"]:
    """Return the people of a frame: x, y and confidence, clipped to 0 to 1."""
    people = frame.get("people") if isinstance(frame, dict) else None
    if not isinstance(people, list):
        raise ReadError(f"{where}: people: must be a list.")
    points = np.zeros((len(people), len(detector.labels), 3))
    for n, person in enumerate(people):
        try:
            numbers = np.array(person[detector.json_key], float)
            points[n] = numbers.reshape(len(detector.labels), 3)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            expected = f"x, y and confidence of {len(detector.labels)} points ({detector.name})"
            raise ReadError(f"{where}: people.{n}.{detector.json_key}: must contain {expected}.") from error
    if not np.isfinite(points).all():
        raise ReadError(f"{where}: people: contains a number that is not finite.")
    points[..., 2] = points[..., 2].clip(0, 1)
    return points
