"""The Levenberg-Marquardt solve of one frame's pose, and of many frames in parallel.

Damping and acceptance follow Lourakis' levmar, as MNN-IK's Algorithm 1 does; each direction comes from the sweep.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels import sweep
from mocapfix.kernels.kinematics import forward
from mocapfix.kernels.residuals import joint_target, marker_cost, markers
from mocapfix.kernels.rotation import exponential, multiply, orthonormalise

CONVERGED, RAN_OUT = 0, 1
TAU = 1e-3  # initial damping over the largest diagonal entry
ENOUGH = 1e-4  # a predicted fall of the cost (half a sum of squares in standard deviations) that no longer matters


class Tree(NamedTuple):
    """The skeleton as the kernels see it."""

    parents: np.ndarray  # (J,)
    offsets: np.ndarray  # (J, 3) metres
    free: np.ndarray  # (J,) bool


class Attached(NamedTuple):
    """The markers' places on the joints."""

    joints: np.ndarray  # (K,)
    places: np.ndarray  # (K, 3) metres


class Pull(NamedTuple):
    """Joint rotations to be near to: one pose for all frames, or one per frame, with the information of each joint."""

    rotations: np.ndarray  # (1 or T, J, 3, 3)
    information: np.ndarray  # (1 or T, J, 3, 3) 1/rad^2
    root: np.ndarray  # (1 or T, 3) metres
    root_information: np.ndarray  # (1 or T,) 1/m^2; 0 for none


@njit(cache=True)
def of_frame(pull, t):
    """-> the pull on frame t alone."""
    f = min(t, len(pull.root) - 1)
    return Pull(pull.rotations[f], pull.information[f], pull.root[f], pull.root_information[f])


@njit(cache=True)
def copy(source, target):
    """Write every number of `source` into `target`, both contiguous and of one shape."""
    flat, out = source.reshape(-1), target.reshape(-1)
    for i in range(len(flat)):
        out[i] = flat[i]


@njit(cache=True)
def dot(a, b):
    """-> the sum of products of two contiguous arrays of one shape."""
    flat, other = a.reshape(-1), b.reshape(-1)
    total = 0.0
    for i in range(len(flat)):
        total += flat[i] * other[i]
    return total


@njit(cache=True)
def largest(h):
    """-> the largest diagonal entry of the whole curvature: a shift of the root moves every body."""
    total = 0.0
    for j in range(len(h)):
        total += h[j, 3, 3]
    return total


@njit(cache=True)
def arms(position, arm):
    """Write the joints' positions from the common origin, the root's position."""
    for j in range(len(arm)):
        for a in range(3):
            arm[j, a] = position[j, a] - position[0, a]


@njit(cache=True)
def linearise(tree, attached, seen, weight, scale2, pulls, local, position, rotation, h, g, own, b):
    """Fill h (J, 6, 6), g (J, 6), own (J, 3, 3), b (J, 3) at a pose whose world joints are given. -> cost"""
    for array in (h, own):
        array.fill(0)
    g.fill(0)
    b.fill(0)
    cost = markers(attached.joints, attached.places, seen, weight, scale2, position, rotation, h, g)
    unturned = np.eye(3)
    for pull in pulls:
        for j in range(len(local)):
            if tree.free[j] and pull.information[j, 0, 0] > 0:
                parent = rotation[tree.parents[j]] if j else unturned
                cost += joint_target(local[j], pull.rotations[j], pull.information[j], parent, own[j], b[j], True)
        w = pull.root_information
        for a in range(3):
            e = position[0, a] - pull.root[a]
            cost += 0.5 * w * e * e
            g[0, 3 + a] += w * e
            h[0, 3 + a, 3 + a] += w
    for a in range(3):  # the root's own turn is part of its twist
        g[0, a] += b[0, a]
        b[0, a] = 0
        for c in range(3):
            h[0, a, c] += own[0, a, c]
    return cost


@njit(cache=True)
def total_cost(tree, attached, seen, weight, scale2, pulls, local, position, rotation, spare, spare3):
    """-> the cost that `linearise` gives, without derivatives."""
    cost = marker_cost(attached.joints, attached.places, seen, weight, scale2, position, rotation)
    for pull in pulls:
        for j in range(len(local)):
            if tree.free[j] and pull.information[j, 0, 0] > 0:
                cost += joint_target(local[j], pull.rotations[j], pull.information[j], spare, spare, spare3, False)
        for a in range(3):
            e = position[0, a] - pull.root[a]
            cost += 0.5 * pull.root_information * e * e
    return cost


@njit(cache=True)
def turned(tree, root, local, rotation, twist, turn, new_root, new_local):
    """Write the pose after the step: every joint turned about its world axes, the root moved with its twist.

    The turn is carried into the parent's axes before it becomes a rotation, so that rounding in the parents' rotations
    never gathers in their children's: the product parent' turn parent would double it at every step.
    """
    by = np.empty((3, 3))
    exponential(twist[0, 0], twist[0, 1], twist[0, 2], by)
    multiply(by, local[0], new_local[0])
    orthonormalise(new_local[0])
    for a in range(3):
        new_root[a] = root[a] + twist[0, 3 + a]
    for j in range(1, len(local)):
        if not tree.free[j]:
            copy(local[j], new_local[j])
            continue
        r, (x, y, z) = rotation[tree.parents[j]], turn[j]
        exponential(
            r[0, 0] * x + r[1, 0] * y + r[2, 0] * z,
            r[0, 1] * x + r[1, 1] * y + r[2, 1] * z,
            r[0, 2] * x + r[1, 2] * y + r[2, 2] * z,
            by,
        )
        multiply(by, local[j], new_local[j])
        orthonormalise(new_local[j])


@njit(cache=True)
def solve_frame(tree, attached, seen, weight, scales2, pulls, root, local, most):
    """Move one frame's pose, in place, to where its cost is least. -> status, iterations

    scales2  squared robust scales, wide to narrow: the solve runs through them, so that far-off starts are not cut off
    most     iterations at each scale
    """
    joints = len(local)
    position, rotation = np.empty((joints, 3)), np.empty((joints, 3, 3))
    h, g, own, b = np.empty((joints, 6, 6)), np.empty((joints, 6)), np.empty((joints, 3, 3)), np.empty((joints, 3))
    h2, g2 = np.empty_like(h), np.empty_like(g)
    gain, inverse_own, twist, turn = np.empty((joints, 6, 3)), np.empty_like(own), np.empty_like(g), np.empty_like(b)
    new_root, new_local = np.empty(3), np.empty_like(local)
    arm, spare, spare3 = np.empty_like(position), np.zeros((3, 3)), np.zeros(3)
    iterations, status = 0, RAN_OUT
    for scale2 in scales2:
        status, mu, nu, fresh = RAN_OUT, -1.0, 2.0, True
        for _ in range(most):
            if fresh:
                forward(tree.parents, tree.offsets, root, local, position, rotation)
                cost = linearise(tree, attached, seen, weight, scale2, pulls, local, position, rotation, h, g, own, b)
                if mu < 0:
                    mu = TAU * max(largest(h), 1.0)
                arms(position, arm)
            iterations += 1
            copy(h, h2)
            copy(g, g2)
            sweep.factor(tree.parents, tree.free, arm, h2, own, mu, gain, inverse_own)
            sweep.solve(tree.parents, tree.free, arm, h2[0], gain, inverse_own, g2, b, twist, turn)
            promised = 0.5 * (mu * (dot(twist[0], twist[0]) + dot(turn, turn)) - dot(g, twist) - dot(b, turn))
            if promised < ENOUGH:
                status = CONVERGED
                break
            turned(tree, root, local, rotation, twist, turn, new_root, new_local)
            forward(tree.parents, tree.offsets, new_root, new_local, position, rotation)
            new_cost = total_cost(tree, attached, seen, weight, scale2, pulls, new_local, position, rotation, spare, spare3)
            fresh = new_cost < cost
            if fresh:
                rho = (cost - new_cost) / promised
                copy(new_root, root)
                copy(new_local, local)
                mu *= max(1 / 3, 1 - (2 * rho - 1) ** 3)
                nu = 2.0
            else:
                forward(tree.parents, tree.offsets, root, local, position, rotation)
                mu *= nu
                nu *= 2
    return status, iterations


@njit(cache=True)
def point_sd(spread, x, y, z):
    """-> the standard deviation per axis, metres, of a point (x, y, z) from the origin on a body whose twist has covariance
    `spread` (6, 6).
    """
    v = spread
    total = v[3, 3] + v[4, 4] + v[5, 5]  # trace of [-[x]x, I] spread [-[x]x, I]'
    total += 2 * (z * v[3, 1] - y * v[3, 2] + x * v[4, 2] - z * v[4, 0] + y * v[5, 0] - x * v[5, 1])
    total += (y * y + z * z) * v[0, 0] + (x * x + z * z) * v[1, 1] + (x * x + y * y) * v[2, 2]
    total -= 2 * (x * y * v[0, 1] + x * z * v[0, 2] + y * z * v[1, 2])
    return np.sqrt(max(total, 0.0) / 3)


@njit(cache=True)
def uncertainty(tree, attached, seen, weight, scale2, pulls, root, local, marker_sd, joint_sd, joint_var):
    """Write the standard deviation per axis of each marker (K,) and joint (J,), metres, and each joint's turn's variance
    per axis (J,), rad^2.

    From the curvature at the pose, exact to second order; joint_var[0] is the root's turn.
    -> the variance of the root's place per axis, m^2
    """
    joints = len(local)
    position, rotation = np.empty((joints, 3)), np.empty((joints, 3, 3))
    h, g, own, b = np.empty((joints, 6, 6)), np.empty((joints, 6)), np.empty((joints, 3, 3)), np.empty((joints, 3))
    gain, inverse_own, spread = np.empty((joints, 6, 3)), np.empty_like(own), np.empty_like(h)
    forward(tree.parents, tree.offsets, root, local, position, rotation)
    linearise(tree, attached, seen, weight, scale2, pulls, local, position, rotation, h, g, own, b)
    arm = np.empty_like(position)
    arms(position, arm)
    sweep.factor(tree.parents, tree.free, arm, h, own, 0.0, gain, inverse_own)
    sweep.covariance(tree.parents, tree.free, arm, h[0], gain, inverse_own, spread, joint_var)
    for k in range(len(attached.joints)):
        j = attached.joints[k]
        c = attached.places[k]
        x = arm[j, 0] + rotation[j, 0, 0] * c[0] + rotation[j, 0, 1] * c[1] + rotation[j, 0, 2] * c[2]
        y = arm[j, 1] + rotation[j, 1, 0] * c[0] + rotation[j, 1, 1] * c[1] + rotation[j, 1, 2] * c[2]
        z = arm[j, 2] + rotation[j, 2, 0] * c[0] + rotation[j, 2, 1] * c[1] + rotation[j, 2, 2] * c[2]
        marker_sd[k] = point_sd(spread[j], x, y, z)
    for j in range(joints):
        joint_sd[j] = point_sd(spread[j], arm[j, 0], arm[j, 1], arm[j, 2])
    return (spread[0, 3, 3] + spread[0, 4, 4] + spread[0, 5, 5]) / 3


@njit(cache=True, nogil=True)
def solve_frames(tree, attached, seen, weight, scales2, target, prior, root, local, most, status, iterations, first, stop):
    """`solve_frame` on the frames first..stop: root (T, 3), local (T, J, 3, 3) in place; status, iterations (T,) out."""
    for t in range(first, stop):
        pulls = (of_frame(target, t), of_frame(prior, t))
        status[t], iterations[t] = solve_frame(tree, attached, seen[t], weight[t], scales2, pulls, root[t], local[t], most)


@njit(cache=True, nogil=True)
def uncertainties(
    tree, attached, seen, weight, scale2, target, prior, root, local, marker_sd, joint_sd, joint_var, root_var, first, stop
):
    """`uncertainty` of the frames first..stop: marker_sd (T, K), joint_sd and joint_var (T, J), root_var (T,) out."""
    for t in range(first, stop):
        pulls = (of_frame(target, t), of_frame(prior, t))
        root_var[t] = uncertainty(
            tree, attached, seen[t], weight[t], scale2, pulls, root[t], local[t], marker_sd[t], joint_sd[t], joint_var[t]
        )


@njit(cache=True, nogil=True)
def track(tree, attached, seen, weight, scales2, target, prior, root, local, unsure, most, runs, first, stop):
    """Solve the runs first..stop of `runs` (R, 2) anew, frame after frame from both ends to the middle, in place.

    Joints that are `unsure` (T, J) start where the frame before (from the far end: after) has them, the others where they
    are: where markers leave two poses open, as a thigh does that lost its knee, the one that goes on smoothly is found.
    """
    for r in range(first, stop):
        left, right = runs[r, 0], runs[r, 1]
        forth = left > 0
        while left <= right:
            if forth or right == len(root) - 1:
                t, source, left = left, left - 1, left + 1
            else:
                t, source, right = right, right + 1, right - 1
            forth = runs[r, 0] > 0 and (not forth or right == len(root) - 1)
            if source < 0 or source >= len(root):
                continue
            for j in range(1, local.shape[1]):
                if unsure[t, j]:
                    copy(local[source, j], local[t, j])
            pulls = (of_frame(target, t), of_frame(prior, t))
            solve_frame(tree, attached, seen[t], weight[t], scales2, pulls, root[t], local[t], most)
