"""A joint that is turned by too much, by the same amount over a span of frames: what it would be without.

An amount can be the same in the parent's axes (d R), in the joint's own (R d) or in the middle one of its three angles. In
each case the right quaternion is linear in what undoes the offset: q = B(q') c, with c the conjugate of d where B is of four
columns, and (cos, sin) of half the angle where it is of two. So the offset that makes a course smoothest is a linear least
squares problem.
"""

import numpy as np
from scipy.spatial.transform import Rotation


def bases(quaternions: np.ndarray, order: str) -> tuple[np.ndarray, ...]:
    """-> the matrices B of (T, 4) quaternions (x, y, z, w): (T, 4, 4) in the parent's axes, (T, 4, 4) in the joint's own,
    (T, 4, 2) in the middle angle of an `order` of intrinsic rotations such as "ZYX".
    """
    turns = Rotation.from_quat(quaternions)
    first = turns.as_euler(order.upper())[:, :1]
    outer = Rotation.from_euler(order[0], first).as_quat()
    inner = (Rotation.from_euler(order[0], first).inv() * turns).as_quat()
    inner *= np.sign((product(outer, inner) * quaternions).sum(1))[:, None]
    axis = np.broadcast_to(np.eye(4)["XYZ".index(order[1].upper())], outer.shape)
    middle = np.stack([quaternions, product(product(outer, axis), inner)], axis=2)
    units = np.broadcast_to(np.eye(4), (len(quaternions), 4, 4))
    either = [quaternions[:, None], units], [units, quaternions[:, None]]
    parents, own = (np.swapaxes(product(*np.broadcast_arrays(q, p)), 1, 2) for p, q in either)
    return parents, own, middle


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """-> the product (..., 4) of quaternions (..., 4), the turn q followed by the turn p."""
    a, b = p[..., :3], q[..., :3]
    vector = p[..., 3:] * b + q[..., 3:] * a + np.cross(a, b)
    return np.concatenate([vector, p[..., 3:] * q[..., 3:] - (a * b).sum(-1, keepdims=True)], axis=-1)
