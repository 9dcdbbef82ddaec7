"""The closed forms of HybrIK: swing, twist, and the joint between two that are given.

Each is written once, without a branch, on plain numbers: Numba compiles it into the kernels, and the same source works
element by element on torch tensors, which can be trained through. Vectors are three numbers, matrices nine, row by row.
"""

import math

from numba.extending import overload, register_jitable

MIN_LENGTH_SQUARED = 1e-24  # squared: a vector no longer than this has no direction
MIN_SUM_LENGTH_SQUARED = 1e-12  # squared length of the sum of two unit vectors that are as good as opposite
SQUARE_ROOT_EPSILON = 1e-30  # keeps a square root's derivative finite where its argument vanishes


def compute_square_root(x):
    return x**0.5


@overload(compute_square_root)
def _(_x):
    return lambda _x: math.sqrt(_x)  # a power would cost the kernels as much as all the rest of a swing


@register_jitable
def compute_dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@register_jitable
def compute_cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@register_jitable
def add_scaled(a, factor, b):
    """-> a + factor b"""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@register_jitable
def normalise_vector(a):
    """-> `a` at length 1; it must have a length."""
    inverse = 1 / compute_square_root(compute_dot(a, a))
    return a[0] * inverse, a[1] * inverse, a[2] * inverse


@register_jitable
def clip_to_positive(x):
    """-> x, or 0 where it is negative."""
    return (x > 0) * x


@register_jitable
def clip_magnitude(x, limit):
    """-> x, no farther from 0 than `most`."""
    return (abs(x) <= limit) * x + ((x > limit) * 1.0 - (x < -limit) * 1.0) * limit


@register_jitable
def compute_perpendicular(a):
    """-> a unit vector at right angles to the unit vector `a`."""
    x = (abs(a[0]) < 0.8) * 1.0  # whether the x axis is far enough from it, or the y axis must do
    return normalise_vector((-(1 - x) * a[2], x * a[2], (1 - x) * a[0] - x * a[1]))


@register_jitable
def compute_swing(t, p):
    """-> the shortest rotation that carries the direction of `t` into that of `p` (HybrIK, Eqs. 7-9).

    It is two half turns, about `t` and about the middle between the two, and so without the sine by which Eq. 7 divides.
    Where they are opposite, the turn is by half about some axis across them; where `p` has no length, there is none.
    """
    a = normalise_vector(t)
    lost = (compute_dot(p, p) < MIN_LENGTH_SQUARED) * 1.0
    b = normalise_vector(add_scaled(p, lost, a))
    middle = add_scaled(a, 1.0, b)
    opposite = (compute_dot(middle, middle) < MIN_SUM_LENGTH_SQUARED) * 1.0
    kept = 1 - opposite
    h = normalise_vector(add_scaled((kept * middle[0], kept * middle[1], kept * middle[2]), opposite, compute_perpendicular(a)))
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
    """-> the rotation about `t` by the angle of a cosine and a sine, both times any length but 0 (HybrIK, Eq. 10)."""
    u, inverse = normalise_vector(t), 1 / compute_square_root(cosine * cosine + sine * sine)
    c, s = cosine * inverse, sine * inverse
    d = 1 - c
    return (
        c + d * u[0] * u[0], d * u[0] * u[1] - s * u[2], d * u[0] * u[2] + s * u[1],
        d * u[1] * u[0] + s * u[2], c + d * u[1] * u[1], d * u[1] * u[2] - s * u[0],
        d * u[2] * u[0] - s * u[1], d * u[2] * u[1] + s * u[0], c + d * u[2] * u[2],
    )  # fmt: skip


@register_jitable
def compute_twist_evidence(t, m, seen):
    """-> cosine and sine, times both levers, of the turn about `t` that lays the point `m` towards where it is `seen`.

    Summed over points, each by its weight, they tell the turn of least squares: what lies along `t` drops out.
    """
    u = normalise_vector(t)
    return compute_dot(m, seen) - compute_dot(m, u) * compute_dot(seen, u), compute_dot(u, compute_cross(m, seen))


@register_jitable
def solve_two_bone_joint(a, b, c, upper, lower):
    """-> the place of a joint at the distances `upper` from `a` and `lower` from `c`, as near to `b` as that leaves it, and by
    how much the distances miss: more than 0 where `c` is out of reach, less where it is too near.

    The elbow between shoulder and wrist: HybrIK-X, Eqs. 40-49. Where its two spheres do not meet (its Eq. 47 is then the root
    of a negative number), the joint lies in line with both, at its distance from `a`.
    """
    ab, ac = add_scaled(b, -1.0, a), add_scaled(c, -1.0, a)
    none = (compute_dot(ac, ac) < MIN_LENGTH_SQUARED) * 1.0  # one on the other: any axis will do, the best is across to the joint
    axis = normalise_vector(
        add_scaled(
            ac,
            none,
            compute_perpendicular(
                normalise_vector(add_scaled(ab, (compute_dot(ab, ab) < MIN_LENGTH_SQUARED) * 1.0, (1.0, 0.0, 0.0)))
            ),
        )
    )
    reach = compute_dot(ac, axis)
    along = clip_magnitude((upper * upper - lower * lower + reach * reach) / (2 * (reach + none * SQUARE_ROOT_EPSILON)), upper)
    aside = add_scaled(ab, -compute_dot(ab, axis), axis)
    away = normalise_vector(
        add_scaled(aside, (compute_dot(aside, aside) < MIN_LENGTH_SQUARED) * 1.0, compute_perpendicular(axis))
    )
    radius = compute_square_root(clip_to_positive(upper * upper - along * along) + SQUARE_ROOT_EPSILON)
    missed = clip_to_positive(reach - upper - lower) - clip_to_positive(abs(upper - lower) - reach)
    return add_scaled(add_scaled(a, along, axis), radius, away), missed
