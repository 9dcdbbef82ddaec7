"""The keypoints of each detector, in its order, and their positions on the body: scenes/keypoints/NAME.yaml."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from pydantic import PositiveFloat

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.files.yaml_models import StrictModel, read_yaml_model
from mocapfix.skeleton import Skeleton


@dataclass(frozen=True)
class KeypointDetector:
    """The V keypoints of a detector.

    json_key  the key of a person's points in its JSON
    labels    V names
    joints    the joint that carries each
    offsets   metres, in the joint's axes
    sd_m      standard deviation per axis of a point detected with confidence 1, people's differences included
    """

    name: str
    json_key: str
    labels: tuple[str, ...]
    joints: Int[np.ndarray, " V"]
    offsets: Float[np.ndarray, "V 3"]
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
    """Return the names of the shipped detectors."""
    return sorted(path.stem for path in (find_shipped_folder("scenes") / "keypoints").glob("*.yaml"))


def load_detector(name: str, skeleton: Skeleton) -> KeypointDetector:
    """Return the detector shipped as scenes/keypoints/NAME.yaml.

    Raises SceneError that lists the shipped detectors, or names the invalid key of the file.
    """
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
