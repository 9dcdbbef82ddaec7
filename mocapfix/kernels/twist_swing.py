"""The closed forms of HybrIK: swing, twist, and the joint between two that are given.

Each is written once, without a branch, on plain numbers: Numba compiles it into the kernels, and the same source works
element by element on torch tensors, which can be trained through. Vectors are three numbers, matrices nine, row by row.
"""

import math

from numba.extending import overload, register_jitable

NOTHING = 1e-24  # squared: a vector no longer than this has no direction
OPPOSITE = 1e-12  # squared length of the sum of two unit vectors that are as good as opposite
TINY = 1e-30  # keeps a square root's derivative finite where its argument vanishes


def square_root(x):
    return x**0.5


@overload(square_root)
def _(_x):
    return lambda _x: math.sqrt(_x)  # a power would cost the kernels as much as all the rest of a swing


@register_jitable
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@register_jitable
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@register_jitable
def plus(a, factor, b):
    """-> a + factor b"""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@register_jitable
def unit(a):
    """-> `a` at length 1; it must have a length."""
    inverse = 1 / square_root(dot(a, a))
    return a[0] * inverse, a[1] * inverse, a[2] * inverse


@register_jitable
def positive(x):
    """-> x, or 0 where it is negative."""
    return (x > 0) * x


@register_jitable
def within(x, most):
    """-> x, no farther from 0 than `most`."""
    return (abs(x) <= most) * x + ((x > most) * 1.0 - (x < -most) * 1.0) * most


@register_jitable
def across(a):
    """-> a unit vector at right angles to the unit vector `a`."""
    x = (abs(a[0]) < 0.8) * 1.0  # whether the x axis is far enough from it, or the y axis must do
    return unit((-(1 - x) * a[2], x * a[2], (1 - x) * a[0] - x * a[1]))


@register_jitable
def swing(t, p):
    """-> the shortest rotation that carries the direction of `t` into that of `p` (HybrIK, Eqs. 7-9).

    It is two half turns, about `t` and about the middle between the two, and so without the sine by which Eq. 7 divides.
    Where they are opposite, the turn is by half about some axis across them; where `p` has no length, there is none.
    """
    a = unit(t)
    lost = (dot(p, p) < NOTHING) * 1.0
    b = unit(plus(p, lost, a))
    middle = plus(a, 1.0, b)
    opposite = (dot(middle, middle) < OPPOSITE) * 1.0
    kept = 1 - opposite
    h = unit(plus((kept * middle[0], kept * middle[1], kept * middle[2]), opposite, across(a)))
    c = 4 * dot(a, h)
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
def twist(t, cosine, sine):
    """-> the rotation about `t` by the angle of a cosine and a sine, both times any length but 0 (HybrIK, Eq. 10)."""
    u, inverse = unit(t), 1 / square_root(cosine * cosine + sine * sine)
    c, s = cosine * inverse, sine * inverse
    d = 1 - c
    return (
        c + d * u[0] * u[0], d * u[0] * u[1] - s * u[2], d * u[0] * u[2] + s * u[1],
        d * u[1] * u[0] + s * u[2], c + d * u[1] * u[1], d * u[1] * u[2] - s * u[0],
        d * u[2] * u[0] - s * u[1], d * u[2] * u[1] + s * u[0], c + d * u[2] * u[2],
    )  # fmt: skip


@register_jitable
def told(t, m, seen):
    """-> cosine and sine, times both levers, of the turn about `t` that lays the point `m` towards where it is `seen`.

    Summed over points, each by its weight, they tell the turn of least squares: what lies along `t` drops out.
    """
    u = unit(t)
    return dot(m, seen) - dot(m, u) * dot(seen, u), dot(u, cross(m, seen))


@register_jitable
def between(a, b, c, upper, lower):
    """-> the place of a joint at the distances `upper` from `a` and `lower` from `c`, as near to `b` as that leaves it, and by
    how much the distances miss: more than 0 where `c` is out of reach, less where it is too near.

    The elbow between shoulder and wrist: HybrIK-X, Eqs. 40-49. Where its two spheres do not meet (its Eq. 47 is then the root
    of a negative number), the joint lies in line with both, at its distance from `a`.
    """
    ab, ac = plus(b, -1.0, a), plus(c, -1.0, a)
    none = (dot(ac, ac) < NOTHING) * 1.0  # one on the other: any axis will do, the best is across to the joint
    axis = unit(plus(ac, none, across(unit(plus(ab, (dot(ab, ab) < NOTHING) * 1.0, (1.0, 0.0, 0.0))))))
    reach = dot(ac, axis)
    along = within((upper * upper - lower * lower + reach * reach) / (2 * (reach + none * TINY)), upper)
    aside = plus(ab, -dot(ab, axis), axis)
    away = unit(plus(aside, (dot(aside, aside) < NOTHING) * 1.0, across(axis)))
    radius = square_root(positive(upper * upper - along * along) + TINY)
    missed = positive(reach - upper - lower) - positive(abs(upper - lower) - reach)
    return plus(plus(a, along, axis), radius, away), missed
