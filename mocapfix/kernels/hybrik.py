"""HybrIK's recursion down the tree, frame by frame: every joint's rotation in closed form from the points beyond it, compiled.

A joint rotates a set of points: its children, whose mean determines the swing, and all points off that axis, which determine the
twist: markers on the segment, and joints beyond a child that does not rotate. A point may be unknown.

The closed forms of HybrIK: swing, twist, and the middle joint of a two-bone chain.

Each is written once, without a branch, on plain numbers: Numba compiles it into the kernels, and the same source works
element by element on torch tensors, with gradients. Vectors are three numbers, matrices nine, row by row.

The compiled parts of the twist network: its inputs, the bones' directions frame by frame, and its layers.
"""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import overload, register_jitable

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, store_matrix, transpose_matrix

MIN_LENGTH_SQUARED = 1e-24  # a vector no longer than this has no direction
MIN_SUM_LENGTH_SQUARED = 1e-12  # of the sum of two unit vectors: below it they count as opposite
SQUARE_ROOT_EPSILON = 1e-30  # added under a square root to keep its derivative finite at zero


def compute_square_root(x):
    return x**0.5


@overload(compute_square_root)
def _overload_square_root(_x):
    return lambda _x: math.sqrt(_x)  # in the kernels a power would cost as much as all the rest of a swing


@register_jitable
def compute_dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@register_jitable
def compute_cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@register_jitable
def add_scaled(a, factor, b):
    """Return a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@register_jitable
def normalise_vector(a):
    """Return `a` at length 1; `a` must not be zero."""
    inverse = 1 / compute_square_root(compute_dot(a, a))
    return a[0] * inverse, a[1] * inverse, a[2] * inverse


@register_jitable
def clip_to_positive(x):
    """Return x, or 0 if it is negative."""
    return (x > 0) * x


@register_jitable
def clip_magnitude(x, limit):
    """Return x clipped to [-limit, limit]."""
    return (abs(x) <= limit) * x + ((x > limit) * 1.0 - (x < -limit) * 1.0) * limit


@register_jitable
def compute_perpendicular(a):
    """Return a unit vector at right angles to the unit vector `a`."""
    x = (abs(a[0]) < 0.8) * 1.0  # 1: cross with the x axis; 0: `a` is too close to it, cross with the y axis
    return normalise_vector((-(1 - x) * a[2], x * a[2], (1 - x) * a[0] - x * a[1]))


@register_jitable
def compute_swing(t, p):
    """Return the shortest rotation from the direction of `t` to that of `p` (HybrIK, Eqs. 7-9).

    It is composed of two half turns, about `t` and about the bisector, which avoids the division by a sine of Eq. 7. For
    opposite vectors it is a half turn about an axis perpendicular to them; if `p` is zero, it is the identity.
    """
    a = normalise_vector(t)
    no_direction = (compute_dot(p, p) < MIN_LENGTH_SQUARED) * 1.0
    b = normalise_vector(add_scaled(p, no_direction, a))
    bisector = add_scaled(a, 1.0, b)
    opposite = (compute_dot(bisector, bisector) < MIN_SUM_LENGTH_SQUARED) * 1.0
    regular = 1 - opposite
    bisector = (regular * bisector[0], regular * bisector[1], regular * bisector[2])
    h = normalise_vector(add_scaled(bisector, opposite, compute_perpendicular(a)))
    c = 4 * compute_dot(a, h)
    return (
        1 + c * h[0] * a[0] - 2 * (h[0] * h[0] + a[0] * a[0]),
        c * h[0] * a[1] - 2 * (h[0] * h[1] + a[0] * a[1]),
        c * h[0] * a[2] - 2 * (h[0] * h[2] + a[0] * a[2]),
        c * h[1] * a[0] - 2 * (h[1] * h[0] + a[1] * a[0]),
        1 + c * h[1] * a[1] - 2 * (h[1] * h[1] + a[1] * a[1]),
        c * h[1] * a[2] - 2 * (h[1] * h[2] + a[1] * a[2]),
        c * h[2] * a[0] - 2 * (h[2] * h[0] + a[2] * a[0]),
        c * h[2] * a[1] - 2 * (h[2] * h[1] + a[2] * a[1]),
        1 + c * h[2] * a[2] - 2 * (h[2] * h[2] + a[2] * a[2]),
    )


@register_jitable
def compute_twist(t, cosine, sine):
    """Return the rotation about `t` by the angle of a cosine and a sine, both scaled by any factor but 0 (HybrIK, Eq. 10)."""
    u, inverse = normalise_vector(t), 1 / compute_square_root(cosine * cosine + sine * sine)
    c, s = cosine * inverse, sine * inverse
    d = 1 - c
    return (
        c + d * u[0] * u[0], d * u[0] * u[1] - s * u[2], d * u[0] * u[2] + s * u[1],
        d * u[1] * u[0] + s * u[2], c + d * u[1] * u[1], d * u[1] * u[2] - s * u[0],
        d * u[2] * u[0] - s * u[1], d * u[2] * u[1] + s * u[0], c + d * u[2] * u[2],
    )  # fmt: skip


@register_jitable
def compute_twist_evidence(t, model, measured):
    """Return cosine and sine, times both levers, of the rotation about `t` from the point `model` towards `measured`.

    Their weighted sums over points give the least-squares rotation; components along `t` cancel.
    """
    u = normalise_vector(t)
    cosine = compute_dot(model, measured) - compute_dot(model, u) * compute_dot(measured, u)
    return cosine, compute_dot(u, compute_cross(model, measured))


@register_jitable
def solve_two_bone_joint(a, b, c, upper, lower):
    """Return the joint at distance `upper` from `a` and `lower` from `c` that is nearest to `b`, and the error of the reach.

    The error is positive if `c` is out of reach, negative if it is too near. An elbow between shoulder and wrist: HybrIK-X,
    Eqs. 40-49. If the two spheres do not intersect (Eq. 47 would be the root of a negative number), the joint lies in line with
    both ends, at its distance from `a`.
    """
    ab, ac = add_scaled(b, -1.0, a), add_scaled(c, -1.0, a)
    coincident = (compute_dot(ac, ac) < MIN_LENGTH_SQUARED) * 1.0  # any axis will do; perpendicular to the joint is best
    has_no_direction = (compute_dot(ab, ab) < MIN_LENGTH_SQUARED) * 1.0
    fallback = compute_perpendicular(normalise_vector(add_scaled(ab, has_no_direction, (1.0, 0.0, 0.0))))
    axis = normalise_vector(add_scaled(ac, coincident, fallback))
    reach = compute_dot(ac, axis)
    along = (upper * upper - lower * lower + reach * reach) / (2 * (reach + coincident * SQUARE_ROOT_EPSILON))
    along = clip_magnitude(along, upper)
    aside = add_scaled(ab, -compute_dot(ab, axis), axis)
    is_straight = (compute_dot(aside, aside) < MIN_LENGTH_SQUARED) * 1.0
    outward = normalise_vector(add_scaled(aside, is_straight, compute_perpendicular(axis)))
    radius = compute_square_root(clip_to_positive(upper * upper - along * along) + SQUARE_ROOT_EPSILON)
    error = clip_to_positive(reach - upper - lower) - clip_to_positive(abs(upper - lower) - reach)
    return add_scaled(add_scaled(a, along, axis), radius, outward), error


HYBRIK_NAIVE = 0  # HybrIK, Algorithm 1
HYBRIK_ADAPTIVE = 1  # HybrIK, Algorithm 2
HYBRIK_X = 2  # HybrIK-X, 3.2.3
MIN_LEVER_M = 0.01  # mean distance of a joint's points from it; below it they do not determine its direction


class HybrikSkeleton(NamedTuple):
    """A skeleton of J joints with the P points that each joint rotates, joint after joint; Q points may be measured."""

    parents: np.ndarray  # (J,)
    offsets: np.ndarray  # (J, 3) metres, in the parent's axes
    is_solved: np.ndarray  # (J,) bool: whether the joint's rotation is solved; else it stays as given
    first_point: np.ndarray  # (J + 1,) index of each joint's first point, and the end
    point_index: np.ndarray  # (P,) index among the Q measured points, of which the first J are the joints
    rest_position: np.ndarray  # (P, 3) metres, in the joint's axes
    is_child: np.ndarray  # (P,) bool: a child, which determines the swing
    constrains_twist: np.ndarray  # (P,) bool: off the bone's axis
    position_variance: np.ndarray  # (P,) m^2 per axis, of the point about its rest position
    conflict_joint: np.ndarray  # (J,) the joint two bones on which HybrIK-X reaches exactly; -1 for none


class HybrikObservations(NamedTuple):
    """Measured points; one row of `variance` or `twists` may serve all frames."""

    points: np.ndarray  # (T, Q, 3) metres, one number or more NaN where unknown
    variance: np.ndarray  # (T or 1, Q) m^2 per axis
    twists: np.ndarray  # (T or 1, J, 2) cosine and sine of each joint's twist, times its information (1/rad^2)


@compile_kernel(nogil=True)
def solve_hybrik_frames(skeleton, variant, observations, root, local, reach_error, first, stop):
    """Solve `local` (T, J, 3, 3), whose roots are given, in place, in the frames first..stop - 1.

    Args:
        variant: HYBRIK_NAIVE, HYBRIK_ADAPTIVE or HYBRIK_X.
        reach_error: (T,) metres, out: of the conflict joints the largest distance out of reach; negative: too near.
    """
    joints = len(skeleton.parents)
    position, rotation = np.empty((joints, 3)), np.empty((joints, 3, 3))
    for t in range(first, stop):
        points, variance = observations.points[t], observations.variance[t % len(observations.variance)]
        twists = observations.twists[t % len(observations.twists)]
        reach_error[t] = 0.0
        for j in range(joints):
            _compute_world_pose(skeleton, j, root[t], local[t], position, rotation)
            if skeleton.is_solved[j]:
                error = _solve_joint(skeleton, variant, j, points, variance, twists, local[t], position, rotation)
                if abs(error) > abs(reach_error[t]):
                    reach_error[t] = error


@compile_inner_kernel
def _compute_world_pose(skeleton, j, root, local, position, rotation):
    """Write the world pose of one joint from its parent's."""
    p = skeleton.parents[j]
    if p < 0:
        position[j, 0], position[j, 1], position[j, 2] = root[0], root[1], root[2]
        store_matrix(load_matrix(local, j), rotation, j)
    else:
        offset = skeleton.offsets[j]
        rotated = multiply_vector(load_matrix(rotation, p), offset[0], offset[1], offset[2])
        position[j, 0], position[j, 1], position[j, 2] = add_scaled(_read_vector(position, p), 1.0, rotated)
        store_matrix(multiply_matrices(load_matrix(rotation, p), load_matrix(local, j)), rotation, j)


@compile_inner_kernel
def _solve_joint(skeleton, variant, j, points, variance, twists, local, position, rotation):
    """Rotate one joint towards its points. Returns the reach error of its conflict joint, metres."""
    parent_rotation = load_matrix(rotation, skeleton.parents[j])
    to_parent = transpose_matrix(parent_rotation)
    here = _read_vector(position, j)
    origin = _read_vector(points, j) if variant == HYBRIK_NAIVE and _is_known(points, j) else here
    rest, measured, weight, reach_error = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0
    for i in range(skeleton.first_point[j], skeleton.first_point[j + 1]):
        if skeleton.is_child[i]:
            k = skeleton.point_index[i]
            known, target, error = _compute_child_target(skeleton, variant, j, k, points, variance, here, rotation)
            if known:
                w = 1.0 / (variance[k] + skeleton.position_variance[i])
                rest = add_scaled(rest, w, _read_vector(skeleton.rest_position, i))
                measured = add_scaled(measured, w, add_scaled(target, -1.0, origin))
                weight, reach_error = weight + w, error if abs(error) > abs(reach_error) else reach_error
    if compute_dot(rest, rest) <= (MIN_LEVER_M * weight) ** 2:  # nothing is known, or the points' mean is the joint itself
        return 0.0
    swing = compute_swing(rest, multiply_vector(to_parent, measured[0], measured[1], measured[2]))
    to_swung = multiply_matrices(transpose_matrix(swing), to_parent)
    cosine, sine = twists[j, 0], twists[j, 1]
    for i in range(skeleton.first_point[j], skeleton.first_point[j + 1]):
        k = skeleton.point_index[i]
        if skeleton.constrains_twist[i] and _is_known(points, k):
            d = add_scaled(_read_vector(points, k), -1.0, origin if skeleton.is_child[i] else here)
            d = multiply_vector(to_swung, d[0], d[1], d[2])
            c, s = compute_twist_evidence(rest, _read_vector(skeleton.rest_position, i), d)
            w = 1.0 / (variance[k] + skeleton.position_variance[i])
            cosine, sine = cosine + w * c, sine + w * s
    if cosine == 0.0 and sine == 0.0:  # no evidence, or equal evidence for opposite angles
        cosine = 1.0
    store_matrix(multiply_matrices(swing, compute_twist(rest, cosine, sine)), local, j)
    store_matrix(multiply_matrices(parent_rotation, load_matrix(local, j)), rotation, j)
    return reach_error


@compile_inner_kernel
def _compute_child_target(skeleton, variant, j, child, points, variance, here, rotation):
    """Return whether a child's target is known, the target, and the reach error of the conflict joint beyond it."""
    end, target = skeleton.conflict_joint[j], _read_vector(points, child)
    if variant != HYBRIK_X or end < 0 or skeleton.parents[end] != child or not _is_known(points, end):
        return _is_known(points, child), target, 0.0
    if not _is_known(points, child):  # its position with the joint's given rotation
        offset = skeleton.offsets[child]
        target = add_scaled(here, 1.0, multiply_vector(load_matrix(rotation, j), offset[0], offset[1], offset[2]))
    upper, lower = _compute_length(skeleton.offsets, child), _compute_length(skeleton.offsets, end)
    end_target = _compute_subtree_root(skeleton, end, points, variance)
    middle, error = solve_two_bone_joint(here, target, end_target, upper, lower)
    return True, middle, error


@compile_inner_kernel
def _compute_subtree_root(skeleton, j, points, variance):
    """Return the position of a conflict joint according to the sub-tree that hangs on it.

    The joint and its children form one rigid rod; the error of its length is distributed over both ends by their weights.
    """
    rest, measured, weight = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    for i in range(skeleton.first_point[j], skeleton.first_point[j + 1]):
        k = skeleton.point_index[i]
        if skeleton.is_child[i] and _is_known(points, k):
            w = 1.0 / (variance[k] + skeleton.position_variance[i])
            rest = add_scaled(rest, w, _read_vector(skeleton.rest_position, i))
            measured = add_scaled(measured, w, add_scaled(_read_vector(points, k), -1.0, _read_vector(points, j)))
            weight += w
    length = compute_square_root(compute_dot(measured, measured))
    if length == 0.0:
        return _read_vector(points, j)
    share = 1.0 / (weight + 1.0 / variance[j])  # times `weight`, by which `measured` has yet to be divided
    return add_scaled(_read_vector(points, j), share * (1.0 - compute_square_root(compute_dot(rest, rest)) / length), measured)


@compile_inner_kernel
def _is_known(points, k):
    return not math.isnan(points[k, 0] + points[k, 1] + points[k, 2])


@compile_inner_kernel
def _read_vector(m, j):
    return m[j, 0], m[j, 1], m[j, 2]


@compile_inner_kernel
def _compute_length(m, j):
    return compute_square_root(compute_dot(_read_vector(m, j), _read_vector(m, j)))


SINGLE_PRECISION_ZERO = np.float32(0)


class BoneLines(NamedTuple):
    """P straight lines between joints, most of them bones; a line comes after its predecessor."""

    start: np.ndarray  # (P,) joint
    end: np.ndarray  # (P,) joint
    previous: np.ndarray  # (P,) the line that ends at this one's start, -1 for none
    rest_vector: np.ndarray  # (P, 3) metres: from start to end in the rest pose


@compile_kernel(nogil=True)
def compute_bone_direction_frames(lines, positions, root_rotation, directions, first, stop):
    """Write directions (T, 2, P, 3), single precision, of the frames first..stop - 1.

    directions[:, 0] are the lines' unit vectors in the root's axes; directions[:, 1] the same with the swing of the previous
    line removed. The second depends on the next joint's own rotation and on the twist of the bone before: a knee bends in one
    plane only, so a shin that points sideways means a twisted thigh.

    A direction is 0 where one of its joints or the root's rotation is NaN, or its length is 0. The second is also 0 where the
    previous line's is.

    Args:
        positions: (T, J, 3) metres.
        root_rotation: (T, 3, 3).
    """
    for t in range(first, stop):
        to_root = transpose_matrix(load_matrix(root_rotation, t))
        for p in range(len(lines.start)):
            direction = _compute_direction(to_root, positions[t], lines.start[p], lines.end[p])
            q, unswung = lines.previous[p], (0.0, 0.0, 0.0)
            if q >= 0:
                previous = directions[t, 0, q, 0], directions[t, 0, q, 1], directions[t, 0, q, 2]
                if compute_dot(previous, previous) > 0.5:
                    rest = lines.rest_vector[q, 0], lines.rest_vector[q, 1], lines.rest_vector[q, 2]
                    from_swung = transpose_matrix(compute_swing(rest, previous))
                    unswung = multiply_vector(from_swung, direction[0], direction[1], direction[2])
            for a in range(3):
                directions[t, 0, p, a], directions[t, 1, p, a] = direction[a], unswung[a]


@compile_inner_kernel
def _compute_direction(to_root, positions, start, end):
    """Return the unit vector between two joints in the root's axes; 0 if there is none."""
    a = positions[start, 0], positions[start, 1], positions[start, 2]
    b = positions[end, 0], positions[end, 1], positions[end, 2]
    d = add_scaled(b, -1.0, a)
    x, y, z = multiply_vector(to_root, d[0], d[1], d[2])
    length = compute_square_root(x * x + y * y + z * z)
    if length > 0.0:  # neither 0 nor NaN
        return x / length, y / length, z / length
    return 0.0, 0.0, 0.0


@compile_kernel(nogil=True)
def evaluate_layer_frames(weights, biases, inputs, outputs, first, stop):
    """Write the outputs (T, M) of L fully connected layers for inputs (T, N) in the frames first..stop - 1.

    A library for matrix products has threads of its own, which compete with ours and take several times as long.

    Args:
        weights, biases: L matrices, inputs by outputs, and L vectors; between layers, rectified linear units.
    """
    widest, last = 0, len(weights) - 1
    for k in range(last):
        widest = max(widest, len(biases[k]))
    rows = np.empty((len(weights), widest), np.float32)
    for t in range(first, stop):
        row = inputs[t]
        for k in range(last):
            _evaluate_layer(weights[k], biases[k], row, rows[k], True)
            row = rows[k]
        _evaluate_layer(weights[last], biases[last], row, outputs[t], False)


@compile_inner_kernel(fastmath=True)
def _evaluate_layer(weights, biases, row, out, is_rectified):
    inputs, outputs = weights.shape
    for o in range(outputs):
        out[o] = biases[o]
    for i in range(inputs):
        value = row[i]
        if value != SINGLE_PRECISION_ZERO:  # about half of them are zero
            for o in range(outputs):
                out[o] += value * weights[i, o]
    if is_rectified:
        for o in range(outputs):
            out[o] = max(out[o], SINGLE_PRECISION_ZERO)
