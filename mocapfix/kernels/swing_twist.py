"""The closed forms of HybrIK: swing, twist, and the middle joint of a two-bone chain.

Each is written once, without a branch, on plain numbers: Numba compiles it into the kernels, and the same source works
element by element on torch tensors, with gradients. Vectors are three numbers, matrices nine, row by row.
"""

import math

from numba.extending import overload, register_jitable

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
