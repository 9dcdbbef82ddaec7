"""Which points a detector finds in an image, in its order, and where they lie on the body: scenes/keypoints/NAME.yaml."""

from dataclasses import dataclass

import numpy as np
from pydantic import PositiveFloat

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.files.yaml_models import StrictModel, read_yaml_model
from mocapfix.skeleton import Skeleton


@dataclass(frozen=True)
class KeypointDetector:
    """The V points that a detector finds.

    key     the name under which its JSON holds a person's points
    labels  V names
    joints  (V,) the joint that carries each
    places  (V, 3) metres, in the joint's axes
    sd      (V,) metres: standard deviation per axis of a point that was surely detected, as far from here as people differ
    """

    name: str
    json_key: str
    labels: tuple[str, ...]
    joints: np.ndarray
    offsets: np.ndarray
    sd_m: np.ndarray

    def compute_point_positions(self, joints: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """-> (T, V, 3) metres: the points in the world, of its joints (T, J, 3) and their rotations (T, J, 3, 3)."""
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
    """-> the detectors there are."""
    return sorted(path.stem for path in (find_shipped_folder("scenes") / "keypoints").glob("*.yaml"))


def load_detector(name: str, skeleton: Skeleton) -> KeypointDetector:
    """-> the detector shipped as scenes/keypoints/NAME.yaml.

    Raises SceneError naming those there are, or the key of the file that is not as it must be.
    """
    if name not in list_detectors():
        raise SceneError(f"There is no order of keypoints named {name!r}; choose one of: {', '.join(list_detectors())}.")
    said = read_yaml_model(_DetectorFile, find_shipped_folder("scenes") / "keypoints" / f"{name}.yaml")
    points = said.points.values()
    for label, point in said.points.items():
        if point.joint not in skeleton.names:
            raise SceneError(f"keypoints/{name}.yaml: points.{label}.joint: the skeleton has no {point.joint!r}.")
    joints = np.array([skeleton.find_joint(point.joint) for point in points])
    places, sd = np.array([point.offset for point in points]), np.array([point.sd for point in points])
    return KeypointDetector(said.name, said.key, tuple(said.points), joints, places, sd)
