"""How people's bones differ: the shape parameters of a body (SCOPE, Eqs. 1 and 60-64)."""

from pathlib import Path

import numpy as np

from mocapfix.errors import SceneError
from mocapfix.scenes import read_yaml


def load(path: Path, joints: tuple[str, ...]) -> np.ndarray:
    """-> (P, J, 3) metres: one standard deviation of each component of people's bone offsets, in the parents' axes.

    joints  J names; a component leaves those alone that it does not name

    Raises SceneError with the file and the component that does not say what it must.
    """
    said = read_yaml(path).get("components")
    if not isinstance(said, list):
        raise SceneError(f"{path}: components must be a list.")
    components = np.zeros((len(said), len(joints), 3))
    for p, component in enumerate(said):
        try:
            for name, offset in component.items():
                components[p, joints.index(name)] = [float(length) for length in offset]
        except (AttributeError, TypeError, ValueError) as error:
            raise SceneError(f"{path}: components.{p} must give joints of the skeleton three lengths each ({error}).") from error
    return components
