"""What many frames say together of the unknowns they share, their poses eliminated (Schur complement by the sweep).

Shared unknowns, P = 1 + G + 3 K of them: the logarithm of the body's size, of G bone groups' scales, and the K markers'
places in their joints' axes, in metres.
"""

import numpy as np
from numba import njit

from mocapfix.kernels import sweep
from mocapfix.kernels.levenberg import load, workspace
from mocapfix.kernels.pose import forward
from mocapfix.kernels.system import linearise
from mocapfix.kernels.terms.robust import robust


@njit(cache=True)
def stretched(tree, groups, count, rotation, stretch):
    """Write how each joint moves (count + 1, J, 3) with the logarithm of the size [0] and of each group's scale [1:]."""
    stretch.fill(0)
    for j in range(1, len(tree.parents)):
        p = tree.parents[j]
        for c in range(count + 1):
            mine = c == 0 or groups[j] == c - 1
            for a in range(3):
                stretch[c, j, a] = stretch[c, p, a]
                if mine:
                    for e in range(3):
                        stretch[c, j, a] += rotation[p, a, e] * tree.offsets[j, e]


@njit(cache=True)
def pressed(attached, lever, weight, shift, g):
    """Write the gradient on the bodies' twists, g (J, 6), of markers shifted by `shift` (K, 3)."""
    g.fill(0)
    for k in range(len(shift)):
        w, on = weight[k], g[attached.joints[k]]
        x, y, z = lever[k]
        ex, ey, ez = shift[k]
        on[0] += w * (y * ez - z * ey)
        on[1] += w * (z * ex - x * ez)
        on[2] += w * (x * ey - y * ex)
        on[3] += w * ex
        on[4] += w * ey
        on[5] += w * ez


@njit(cache=True)
def given_way(tree, attached, system, lever, shift, g, b, factors, step, moved):
    """Write where the markers go, `moved` (K, 3), when they are shifted by `shift` (K, 3) and the pose gives way.

    g, b     (J, 6), (J, 3) what that presses the pose with; g is spoilt
    factors  what sweep.factor left
    """
    sweep.solve(tree, system, factors, g, b, step)
    for k in range(len(shift)):
        t = step.twist[attached.joints[k]]
        x, y, z = lever[k]
        moved[k, 0] = shift[k, 0] + t[3] + t[1] * z - t[2] * y
        moved[k, 1] = shift[k, 1] + t[4] + t[2] * x - t[0] * z
        moved[k, 2] = shift[k, 2] + t[5] + t[0] * y - t[1] * x


@njit(cache=True)
def add_frame(tree, terms, t, groups, count, scale2, work, curvature, gradient):
    """Add one frame's part to the shared unknowns' curvature (P, P) and gradient (P,). -> the frame's cost

    terms  the markers' Points first
    work   holds the pose, at its own optimum for the present shared unknowns, or near it
    """
    attached, seen, weight, places = terms[0], terms[0].seen[t], terms[0].weight[t], terms[0].places
    joints, markers = len(tree.parents), len(attached.joints)
    system, factors, step, g, b = work.system, work.factors, work.step, work.system.g, work.system.b
    position, rotation, arm = work.pose.position, work.pose.rotation, work.system.arm
    forward(tree, work.pose)
    cost = linearise(tree, terms, t, scale2, work.pose, system)
    sweep.factor(tree, system, 1e-3, factors)
    stretch = np.empty((count + 1, joints, 3))
    stretched(tree, groups, count, rotation, stretch)
    trusted, error, lever = np.zeros(markers), np.zeros((markers, 3)), np.empty((markers, 3))
    for k in range(markers):
        j, square = attached.joints[k], 0.0
        for a in range(3):
            lever[k, a] = arm[j, a]
            for c in range(3):
                lever[k, a] += rotation[j, a, c] * places[k, c]
        if weight[k] > 0:
            for a in range(3):
                error[k, a] = position[0, a] + lever[k, a] - seen[k, a]
                square += error[k, a] ** 2
            trusted[k] = weight[k] * robust(attached.loss, weight[k] * square, scale2)[1]
    unknowns = 1 + count + 3 * markers
    shift, moved = np.zeros((markers, 3)), np.empty((markers, 3))
    press, unpressed = np.empty_like(g), np.zeros_like(b)
    for p in range(unknowns + 1):  # the last: the residual itself
        k = (p - 1 - count) // 3
        if p <= count:
            for m in range(markers):
                for a in range(3):
                    shift[m, a] = stretch[p, attached.joints[m], a]
        elif p < unknowns:
            shift.fill(0)
            if trusted[k] == 0.0:
                continue
            for a in range(3):
                shift[k, a] = rotation[attached.joints[k], a, (p - 1 - count) % 3]
        if p < unknowns:
            pressed(attached, lever, trusted, shift, press)
            given_way(tree, attached, system, lever, shift, press, unpressed, factors, step, moved)
        else:  # here the pulls on the pose press, too
            given_way(tree, attached, system, lever, error, g, b, factors, step, moved)
        for m in range(markers):
            if trusted[m] == 0.0:
                continue
            r, x, y, z = (
                rotation[attached.joints[m]],
                moved[m, 0] * trusted[m],
                moved[m, 1] * trusted[m],
                moved[m, 2] * trusted[m],
            )
            at = 1 + count + 3 * m
            for a in range(3):
                along = r[0, a] * x + r[1, a] * y + r[2, a] * z
                if p < unknowns:
                    curvature[at + a, p] += along
                else:
                    gradient[at + a] += along
            for c in range(count + 1):
                s = stretch[c, attached.joints[m]]
                if p < unknowns:
                    curvature[c, p] += s[0] * x + s[1] * y + s[2] * z
                else:
                    gradient[c] += s[0] * x + s[1] * y + s[2] * z
    return cost


@njit(cache=True, nogil=True)
def add_frames(tree, terms, groups, count, scale2, root, local, curvature, gradient, cost, first, stop):
    """`add_frame` on first..stop, each into its own row: curvature (T, P, P), gradient (T, P), cost (T,)."""
    work, none = workspace(local.shape[1], 0, 0), np.zeros((len(root), 0))
    for t in range(first, stop):
        load(root, local, none, t, work.pose)
        cost[t] = add_frame(tree, terms, t, groups, count, scale2, work, curvature[t], gradient[t])
