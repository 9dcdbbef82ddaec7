"""Anatomical landmarks: each has one place on the average body, to which marker sets and detectors of keypoints refer."""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import PositiveFloat

from mocapfix.errors import format_name_list
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.files.yaml_body_values import JointName, Vector3
from mocapfix.files.yaml_models import StrictModel, read_yaml_model

LANDMARK_FILE = "skeletons/landmarks.yaml"
MIRROR_X = np.array([-1.0, 1.0, 1.0])
MAX_MEDIAN_DISTANCE_M = 0.008
"""the distance from the median plane within which a landmark of pelvis, trunk or head is one of neither side"""


class Landmark(NamedTuple):
    """A landmark on the average body.

    joint_name  the joint that carries it
    offset      (3,) m: its position in the axes of the joint
    spread      m: standard deviation per axis, over people, of a marker on it about the offset
    """

    joint_name: str
    offset: Float[np.ndarray, "3"]
    spread: float


def find_landmark(name: str) -> Landmark:
    """Return a landmark by its name, of paired ones with the side before it: "left acromion", "sacrum".

    Raises ValueError, with a sentence that lists the landmarks, if there is none of that name.
    """
    landmarks = load_landmarks()
    side, _, rest = name.partition(" ")
    if name in landmarks and _is_median(landmarks[name]):
        return landmarks[name]
    if side in ("left", "right") and rest in landmarks:
        landmark = landmarks[rest]
        if side == "left":
            return landmark
        return Landmark(landmark.joint_name.replace("Left", "Right"), landmark.offset * MIRROR_X, landmark.spread)
    known = [key if _is_median(landmark) else f"left {key}" for key, landmark in landmarks.items()]
    raise ValueError(f"there is no landmark {name!r}; the landmarks are {format_name_list(known)}, and those on the right")


@cache
def load_landmarks() -> dict[str, Landmark]:
    """Return the left and the median landmarks by their names without a side, from scenes/skeletons/landmarks.yaml."""
    path = find_shipped_folder("scenes") / LANDMARK_FILE
    models = read_yaml_model(_LandmarkFile, path).landmarks
    return {name: Landmark(model.joint, np.array(model.offset, float), model.spread) for name, model in models.items()}


class _LandmarkModel(StrictModel):
    joint: JointName
    offset: Vector3
    spread: PositiveFloat


class _LandmarkFile(StrictModel):
    landmarks: dict[str, _LandmarkModel]


def _is_median(landmark: Landmark) -> bool:
    return not landmark.joint_name.startswith("Left") and abs(float(landmark.offset[0])) <= MAX_MEDIAN_DISTANCE_M
