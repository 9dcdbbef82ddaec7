"""The other side: every motion is also somebody's who is mirrored."""

import numpy as np

FLIP = np.diag([-1.0, 1.0, 1.0])  # left becomes right, x changes sign


def mirrored_name(name: str) -> str:
    """-> the joint on the other side: LeftArm for RightArm, LThumb for RThumb."""
    for left, right in (("Left", "Right"), ("LHip", "RHip"), ("LThumb", "RThumb")):
        if name.startswith(left):
            return right + name[len(left) :]
        if name.startswith(right):
            return left + name[len(right) :]
    return name


def mirrored(vectors: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """-> (N, J, 3) the poses in a mirror, of rotation vectors (N, J, 3) from a middle pose that is its own mirror image.

    A turn about x stays as it is, for x is across the mirror; turns about y and z change their sense.
    """
    return vectors[:, [names.index(mirrored_name(name)) for name in names]] * np.array([1, -1, -1], vectors.dtype)
