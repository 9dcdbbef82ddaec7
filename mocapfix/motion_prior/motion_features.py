"""Gaps of motion as the motion prior's network sees them, for training and for inference, in numpy.

The network is given the motion in `TOKEN_COUNT` moments: at increasing distances before the gap, evenly inside it, and at
increasing distances after it. Missing rotations are interpolated along the shortest arc between the nearest known moments, the
root position linearly; the network predicts the difference from this interpolation inside the gap, as in the delta-interpolator
(Oreshkin et al. 2022). Positions and directions are relative to the root in the middle of the gap, without its heading.

Rotations are unit quaternions (x, y, z, w) in single precision, for the free joints of the 31-joint skeleton with the root first.
The clavicles do not turn: the arms have their rotation as well.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from mocapfix.skeleton import load_cmu31_body

MOTION_RATE_HZ = 30.0
"""Rate of the training data."""
CONTEXT_DISTANCES_S = np.array([0, 1, 2, 4, 7, 12, 19, 29]) / MOTION_RATE_HZ
"""Times from the last known frame before a gap, or the first one after it, to the moments in which the motion is given."""
INNER_COUNT = 16
"""Evenly spaced moments inside a gap."""
TOKEN_COUNT = INNER_COUNT + 2 * len(CONTEXT_DISTANCES_S)
INNER_TOKENS = slice(len(CONTEXT_DISTANCES_S), len(CONTEXT_DISTANCES_S) + INNER_COUNT)
EDGE_SOFTENING_S = 0.1
"""Harmonic distance from the edges of a gap at which an output has half of its scale."""
FIXED_JOINT_NAMES = ("LeftShoulder", "RightShoulder")
FEATURE_POINT_NAMES = ("Head", "ForeArm", "Hand", "FingerBase", "Leg", "Foot", "ToeBase")
"""Joints whose positions the network is given, on both sides."""
SMALL_ANGLE_SINE = 1e-6


class MotionTree(NamedTuple):
    """The J joints of the motion prior, root first, and the points of the 31-joint skeleton that they carry.

    joints    (J,) their indices among the 31 joints
    parents   (J,) the joint among the J that carries each, -1 for the root
    offsets   (J, 3) m: the joint in the axes of its parent among the J
    carriers  (31,) the joint among the J that carries each of the 31 joints
    points    (31, 3) m: the 31 joints in the axes of their carriers
    features  indices among the 31 of the joints whose positions are features
    """

    joints: np.ndarray
    parents: np.ndarray
    offsets: np.ndarray
    carriers: np.ndarray
    points: np.ndarray
    features: np.ndarray


class InterpolatedWindows(NamedTuple):
    """B gaps with T moments each, without missing values.

    quaternions  (B, T, J, 4) and position (B, T, 3) m of the root, interpolated where missing
    edge_s       (B, T, J) harmonic distance in time from the known moments on either side; 0 where known
    """

    quaternions: np.ndarray
    position: np.ndarray
    edge_s: np.ndarray


@cache
def build_motion_tree() -> MotionTree:
    """Return the joints of the motion prior with the offsets of the average body."""
    body = load_cmu31_body()
    skeleton, count = body.skeleton, len(body.skeleton.names)
    is_used = body.free_joints & ~np.isin(skeleton.names, FIXED_JOINT_NAMES)
    joints = np.flatnonzero(is_used)
    own = np.cumsum(is_used) - 1
    carriers, points = np.zeros(count, int), np.zeros((count, 3))
    for j in range(1, count):
        parent = skeleton.parents[j]
        carriers[j] = own[parent] if is_used[parent] else carriers[parent]
        points[j] = skeleton.offsets[j] + (0.0 if is_used[parent] else points[parent])
    parents = np.where(joints == 0, -1, carriers[joints])
    is_feature = [name.endswith(FEATURE_POINT_NAMES) for name in skeleton.names]
    offsets = points[joints].astype(np.float32)
    return MotionTree(joints, parents, offsets, carriers, points.astype(np.float32), np.flatnonzero(is_feature))


def count_features() -> int:
    """Return the number of features of a moment."""
    tree = build_motion_tree()
    joint_count = len(tree.joints)
    return 6 * joint_count + 3 + 3 * len(tree.features) + joint_count + 4


def count_outputs() -> int:
    """Return the network's outputs for a moment: rotation vectors, root displacement, and the logarithms of their deviations."""
    return 4 * len(build_motion_tree().joints) + 4


def multiply_unit_quaternions(
    a: Float32[np.ndarray, "*batch 4"], b: Float32[np.ndarray, "*#batch 4"]
) -> Float32[np.ndarray, "*batch 4"]:
    """Return the quaternions of the rotations a b."""
    ax, ay, az, aw = (a[..., i] for i in range(4))
    bx, by, bz, bw = (b[..., i] for i in range(4))
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def compute_quaternion_vectors(quaternions: Float32[np.ndarray, "*batch 4"]) -> Float32[np.ndarray, "*batch 3"]:
    """Return the rotation vectors of quaternions, in radians, up to half a turn."""
    signed = np.where(quaternions[..., 3:] < 0, -quaternions, quaternions)
    sine = np.linalg.norm(signed[..., :3], axis=-1, keepdims=True)
    is_small = sine < SMALL_ANGLE_SINE
    factor = np.where(is_small, 2.0, 2 * np.arctan2(sine, signed[..., 3:]) / np.where(is_small, 1.0, sine))
    return (signed[..., :3] * factor).astype(np.float32)


def compute_vector_quaternions(vectors: Float32[np.ndarray, "*batch 3"]) -> Float32[np.ndarray, "*batch 4"]:
    """Return the quaternions of rotation vectors in radians."""
    half = np.linalg.norm(vectors, axis=-1, keepdims=True) / 2
    factor = np.where(half < SMALL_ANGLE_SINE, 0.5, np.sin(half) / np.where(half < SMALL_ANGLE_SINE, 1.0, 2 * half))
    return np.concatenate([vectors * factor, np.cos(half)], axis=-1).astype(np.float32)


def compute_quaternion_matrices(quaternions: Float32[np.ndarray, "*batch 4"]) -> Float32[np.ndarray, "*batch 3 3"]:
    """Return the rotation matrices of unit quaternions."""
    x, y, z, w = (quaternions[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def compute_token_times(gap_s: Float[np.ndarray, " B"]) -> Float[np.ndarray, "B T"]:
    """Return the moments that the network is given, in seconds from the last known frame before a gap.

    gap_s  from the last known frame before the gap to the first one after it
    """
    inner = gap_s[:, None] * np.arange(1, INNER_COUNT + 1) / (INNER_COUNT + 1)
    before = np.broadcast_to(-CONTEXT_DISTANCES_S[::-1], (len(gap_s), len(CONTEXT_DISTANCES_S)))
    return np.concatenate([before, inner, gap_s[:, None] + CONTEXT_DISTANCES_S], axis=1)


def interpolate_missing_values(
    quaternions: Float32[np.ndarray, "B T J 4"],
    position: Float32[np.ndarray, "B T 3"],
    is_known: Bool[np.ndarray, "B T J"],
    times_s: Float[np.ndarray, "B T"],
) -> InterpolatedWindows:
    """Interpolate missing rotations, and the root position where the root is missing; at an end the nearest value is held.

    Each joint must be known in one moment of each gap. The values of missing joints do not matter, but must be finite.
    """
    token_count = is_known.shape[1]
    tokens = np.arange(token_count)[:, None]
    before = np.maximum.accumulate(np.where(is_known, tokens, -1), axis=1)
    after = np.minimum.accumulate(np.where(is_known, tokens, token_count)[:, ::-1], axis=1)[:, ::-1]
    b, t, j = np.nonzero(~is_known)
    first, last = before[b, t, j], after[b, t, j]
    has_start, has_end = first >= 0, last < token_count
    first, last = np.where(has_start, first, last), np.where(has_end, last, first)
    to_start, to_end = times_s[b, t] - times_s[b, first], times_s[b, last] - times_s[b, t]
    span = to_start + to_end
    share = np.where(span > 0, to_start / np.where(span > 0, span, 1), 0.0).astype(np.float32)[:, None]
    start = quaternions[b, first, j]
    turn = compute_quaternion_vectors(multiply_unit_quaternions(start * INVERSE_SIGNS, quaternions[b, last, j]))
    filled = quaternions.copy()
    filled[b, t, j] = multiply_unit_quaternions(start, compute_vector_quaternions(share * turn))
    edge_s = np.zeros(is_known.shape, np.float32)
    edge_s[b, t, j] = np.where(has_start & has_end, share[:, 0] * to_end, np.abs(to_start))
    filled_position, root = position.copy(), j == 0
    b, t, first, last, share = b[root], t[root], first[root], last[root], share[root]
    filled_position[b, t] = (1 - share) * position[b, first] + share * position[b, last]
    return InterpolatedWindows(filled, filled_position, edge_s)


INVERSE_SIGNS = np.array([-1, -1, -1, 1], np.float32)
"""Factors that turn a unit quaternion into that of the inverse rotation."""


def compute_output_scale(edge_s: Float32[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Return the factor of the network's outputs, which makes them continuous at the edges of a gap."""
    return edge_s / (edge_s + np.float32(EDGE_SOFTENING_S))


def remove_window_heading(
    windows: InterpolatedWindows,
) -> tuple[InterpolatedWindows, Float32[np.ndarray, "B 4"], Float32[np.ndarray, "B 3"]]:
    """Return windows relative to the root in their middle moment, and the heading and position that were removed."""
    middle = windows.quaternions.shape[1] // 2
    forward = compute_quaternion_matrices(windows.quaternions[:, middle, 0])[..., 2]
    half = np.arctan2(forward[:, 0], forward[:, 2]) / 2
    heading = np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], axis=-1).astype(np.float32)
    origin = windows.position[:, middle]
    quaternions = windows.quaternions.copy()
    quaternions[:, :, 0] = multiply_unit_quaternions(
        np.broadcast_to((heading * INVERSE_SIGNS)[:, None], quaternions[:, :, 0].shape), quaternions[:, :, 0]
    )
    position = (windows.position - origin[:, None]) @ compute_quaternion_matrices(heading)
    return InterpolatedWindows(quaternions, position, windows.edge_s), heading, origin


def compute_carried_points(
    local_matrices: Float32[np.ndarray, "N J 3 3"], position: Float32[np.ndarray, "N 3"], points: Int[np.ndarray, " P"]
) -> Float32[np.ndarray, "N P 3"]:
    """Return the positions in metres of some of the 31 joints of the average body, by forward kinematics."""
    tree = build_motion_tree()
    world, origins = local_matrices.copy(), np.empty((*local_matrices.shape[:2], 3), np.float32)
    origins[:, 0] = position
    for j, parent in enumerate(tree.parents[1:], 1):
        origins[:, j] = origins[:, parent] + world[:, parent] @ tree.offsets[j]
        world[:, j] = world[:, parent] @ local_matrices[:, j]
    carriers = tree.carriers[points]
    return origins[:, carriers] + (world[:, carriers] @ tree.points[points][..., None])[..., 0]


def compute_window_features(
    windows: InterpolatedWindows,
    is_known: Bool[np.ndarray, "B T J"],
    is_inside: Bool[np.ndarray, "B T"],
    times_s: Float[np.ndarray, "B T"],
) -> Float32[np.ndarray, "B T F"]:
    """Return the features of gaps without heading.

    is_inside  moments that are not beyond the ends of the take
    """
    batch, token_count, joint_count = is_known.shape
    tree, matrices = build_motion_tree(), compute_quaternion_matrices(windows.quaternions)
    points = compute_carried_points(
        matrices.reshape(-1, joint_count, 3, 3), windows.position.reshape(-1, 3), tree.features
    ).reshape(batch, token_count, -1)
    gap_s = times_s[:, [INNER_TOKENS.stop]] - times_s[:, [INNER_TOKENS.start - 1]]
    parts = [
        matrices[..., :2].reshape(batch, token_count, -1),
        windows.position,
        points - np.tile(windows.position, len(tree.features)),
        ~is_known & is_inside[..., None],
        is_inside[..., None],
        windows.edge_s.max(axis=2, keepdims=True),
        times_s[..., None],
        np.broadcast_to(np.sqrt(gap_s)[..., None], (batch, token_count, 1)),
    ]
    return np.concatenate([part.astype(np.float32) for part in parts], axis=-1)
