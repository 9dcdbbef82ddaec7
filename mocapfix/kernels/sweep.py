"""The Gauss-Newton direction of a tree of joints in time linear in joints and measurements.

SCOPE's Algorithm 1 as an articulated-body sweep. A body's twist (w, v) is its turn and the velocity of the point of it
that lies at a common origin, both in world axes, so a child's twist is its parent's plus its own joint's turn:

    twist_i = twist_parent + S_i turn_i,    S_i = [I; [d_i]x],    d_i = joint position - origin

and every measurement on body i is a quadratic in twist_i alone: 1/2 twist' H_i twist + g_i' twist. Leaves to root each
joint's turn is minimised out of its body's quadratic, which leaves a 6 x 6 quadratic in its parent's twist; root to
leaves the turns follow. `factor` does the first half once; `solve` uses it for one right-hand side, `covariance` for the
uncertainty of every body.
"""

import numpy as np
from numba import njit

from mocapfix.kernels.small import cholesky_inverse_6, inverse_3


@njit(cache=True)
def factor(parents, free, arm, h, own, mu, gain, inverse_own):
    """Eliminate every joint's turn. -> nothing; all in place.

    arm   (J, 3) joint positions from the origin
    h     (J, 6, 6) each body's own curvature, in: symmetric; out: with its descendants', the root's inverted
    own   (J, 3, 3) curvature of each joint's own turn (priors on joints), in world axes
    mu    Marquardt damping, added to the diagonal of every unknown
    gain  (J, 6, 3) out: H S (S'HS + own)^-1
    inverse_own  (J, 3, 3) out: (S'HS + own)^-1
    """
    u = np.empty((6, 3))
    k = np.empty((3, 3))
    for i in range(len(parents) - 1, 0, -1):
        p = parents[i]
        if not free[i]:
            for a in range(6):
                for b in range(6):
                    h[p, a, b] += h[i, a, b]
            continue
        x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
        for a in range(6):  # u = H S; the columns of [d]x are (0, z, -y), (-z, 0, x), (y, -x, 0)
            u[a, 0] = h[i, a, 0] + z * h[i, a, 4] - y * h[i, a, 5]
            u[a, 1] = h[i, a, 1] - z * h[i, a, 3] + x * h[i, a, 5]
            u[a, 2] = h[i, a, 2] + y * h[i, a, 3] - x * h[i, a, 4]
        for b in range(3):
            k[0, b] = u[0, b] + z * u[4, b] - y * u[5, b] + own[i, 0, b]
            k[1, b] = u[1, b] - z * u[3, b] + x * u[5, b] + own[i, 1, b]
            k[2, b] = u[2, b] + y * u[3, b] - x * u[4, b] + own[i, 2, b]
        for a in range(3):
            k[a, a] += mu
        inverse_3(k, inverse_own[i])
        for a in range(6):
            for b in range(3):
                gain[i, a, b] = u[a, 0] * inverse_own[i, 0, b] + u[a, 1] * inverse_own[i, 1, b] + u[a, 2] * inverse_own[i, 2, b]
        for a in range(6):
            for b in range(a + 1):
                left = h[i, a, b] - gain[i, a, 0] * u[b, 0] - gain[i, a, 1] * u[b, 1] - gain[i, a, 2] * u[b, 2]
                h[p, a, b] += left
                if a != b:
                    h[p, b, a] += left
    for a in range(6):
        h[0, a, a] += mu
    cholesky_inverse_6(h[0])


@njit(cache=True)
def solve(parents, free, arm, root_inverse, gain, inverse_own, g, b, twist, turn):
    """Minimise 1/2 x'Hx + (gradient)'x with what `factor` left. -> nothing; writes `twist` and `turn`.

    g      (J, 6) gradient on each body's twist; spoilt
    b      (J, 3) gradient on each joint's own turn
    twist  (J, 6) out: every body's twist; the root's is its own step
    turn   (J, 3) out: every joint's turn in world axes; zero for the root and joints that are not free
    """
    for i in range(len(parents) - 1, 0, -1):
        p = parents[i]
        if not free[i]:
            for a in range(6):
                g[p, a] += g[i, a]
            continue
        x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
        turn[i, 0] = g[i, 0] + z * g[i, 4] - y * g[i, 5] + b[i, 0]
        turn[i, 1] = g[i, 1] - z * g[i, 3] + x * g[i, 5] + b[i, 1]
        turn[i, 2] = g[i, 2] + y * g[i, 3] - x * g[i, 4] + b[i, 2]
        for a in range(6):
            g[p, a] += g[i, a] - gain[i, a, 0] * turn[i, 0] - gain[i, a, 1] * turn[i, 1] - gain[i, a, 2] * turn[i, 2]
    for a in range(6):
        twist[0, a] = 0.0
        for c in range(6):
            twist[0, a] -= root_inverse[a, c] * g[0, c]
    for a in range(3):
        turn[0, a] = 0.0
    for i in range(1, len(parents)):
        p = parents[i]
        if not free[i]:
            for a in range(3):
                turn[i, a] = 0.0
            for a in range(6):
                twist[i, a] = twist[p, a]
            continue
        u0, u1, u2 = turn[i, 0], turn[i, 1], turn[i, 2]
        for a in range(3):
            total = -(inverse_own[i, a, 0] * u0 + inverse_own[i, a, 1] * u1 + inverse_own[i, a, 2] * u2)
            for c in range(6):
                total -= gain[i, c, a] * twist[p, c]
            turn[i, a] = total
        w0, w1, w2 = turn[i, 0], turn[i, 1], turn[i, 2]
        x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
        twist[i, 0], twist[i, 1], twist[i, 2] = twist[p, 0] + w0, twist[p, 1] + w1, twist[p, 2] + w2
        twist[i, 3] = twist[p, 3] + y * w2 - z * w1
        twist[i, 4] = twist[p, 4] + z * w0 - x * w2
        twist[i, 5] = twist[p, 5] + x * w1 - y * w0


@njit(cache=True)
def covariance(parents, free, arm, root_inverse, gain, inverse_own, spread, turn_variance):
    """Write each body's twist covariance (J, 6, 6) into `spread`, root to leaves, from what `factor` left with mu = 0.

    twist_i = (I - S gain') twist_parent + S turn',  the remaining turn' having covariance inverse_own.
    turn_variance (J,) out: each joint's turn, the mean over its three axes; 0 where a joint is not free.
    """
    s, cross = np.zeros((6, 3)), np.empty((3, 6))
    for a in range(3):
        s[a, a] = 1.0
    turned = np.empty((3, 3))
    for a in range(6):
        for c in range(6):
            spread[0, a, c] = root_inverse[a, c]
    turn_variance[0] = (root_inverse[0, 0] + root_inverse[1, 1] + root_inverse[2, 2]) / 3
    for i in range(1, len(parents)):
        p = parents[i]
        turn_variance[i] = 0.0
        x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
        s[3, 1], s[3, 2], s[4, 0], s[4, 2], s[5, 0], s[5, 1] = -z, y, z, -x, -y, x
        if free[i]:
            for a in range(3):  # cross = covariance of (turn, parent's twist); turned = covariance of turn
                for c in range(6):
                    cross[a, c] = 0.0
                    for e in range(6):
                        cross[a, c] -= gain[i, e, a] * spread[p, e, c]
            for a in range(3):
                for c in range(3):
                    turned[a, c] = inverse_own[i, a, c]
                    for e in range(6):
                        turned[a, c] -= cross[a, e] * gain[i, e, c]
                turn_variance[i] += turned[a, a] / 3
        for a in range(6):
            for c in range(a + 1):
                total = spread[p, a, c]
                if free[i]:
                    for e in range(3):
                        total += s[a, e] * cross[e, c] + s[c, e] * cross[e, a]
                        for f in range(3):
                            total += s[a, e] * turned[e, f] * s[c, f]
                spread[i, a, c] = total
                spread[i, c, a] = total
