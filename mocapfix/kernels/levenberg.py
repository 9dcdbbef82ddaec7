"""The Levenberg-Marquardt solve of one frame's pose, and of many frames in parallel.

Damping and acceptance follow Lourakis' levmar, as MNN-IK's Algorithm 1 does; each direction comes from the sweep. It ends
where the cost is nothing but rounding, or where the fall that a step promises no longer matters: gradient and step are then
small, measured by what they are worth in standard deviations, so that metres and radians compare.
"""

import math

from numba import njit

from mocapfix.kernels import low_rank, sweep
from mocapfix.kernels.pose import copy, forward, stepped
from mocapfix.kernels.system import linearise
from mocapfix.kernels.workspace import load, place, store, workspace

CONVERGED, RAN_OUT, NOTHING_LEFT, UNHELD = 0, 1, 4, 5  # indices into motion.STATUS
TAU = 1e-5  # initial damping over the largest diagonal entry: starts are near (levmar: 1e-3 where they may be far)
SLIGHT = 1e-3  # a predicted fall of the cost (half a sum of squares in standard deviations) that no longer matters
EXACT = 1e-12  # a cost that is nothing but rounding


@njit(cache=True)
def dot(a, b):
    """-> the sum of products of two contiguous arrays of one shape."""
    flat, other = a.reshape(-1), b.reshape(-1)
    total = 0.0
    for i in range(len(flat)):
        total += flat[i] * other[i]
    return total


@njit(cache=True)
def largest(system):
    """-> the largest diagonal entry of the curvature, or 1: of the root's twist, which moves every body, of what holds joints'
    own turns, of the shared unknowns. What markers say of a joint's turn they say of the root's, too.
    """
    entry = 1.0
    for a in range(6):
        total = 0.0
        for j in range(len(system.h)):
            total += system.h[j, a, a]
        entry = max(entry, total)
    for j in range(len(system.own)):
        for a in range(3):
            entry = max(entry, system.own[j, a, a])
    for p in range(len(system.shared)):
        entry = max(entry, system.shared[p, p])
    return entry


@njit(cache=True)
def held(system):
    """-> whether anything says where the pose should be."""
    for j in range(len(system.h)):
        for a in range(6):
            if system.h[j, a, a] > 0.0:
                return True
        for a in range(3):
            if system.own[j, a, a] > 0.0:
                return True
    return dot(system.rows, system.rows) + dot(system.rows_own, system.rows_own) > 0.0


@njit(inline="always")
def direction(tree, work, mu):
    """Write the damped Gauss-Newton step of the work's system. -> the fall of the cost that the damped model promises"""
    system, step, g, b = work.system, work.step, work.g, work.b
    sweep.factor(tree, system, mu, work.factors)
    copy(system.g, g)
    copy(system.b, b)
    copy(system.shared_g, step.shared)
    low_rank.add_gradient(system, work.answers, g, b)
    sweep.solve(tree, system, work.factors, g, b, step)
    low_rank.heed_rows(tree, system, work.factors, work.answers, g, step)
    fall = low_rank.fall(system, work.answers, step)
    fall -= dot(system.g, step.twist) + dot(system.b, step.turn) + dot(system.shared_g, step.shared)
    size = dot(step.twist[0], step.twist[0]) + dot(step.turn, step.turn) + dot(step.shared, step.shared)
    return 0.5 * (mu * size + fall)


@njit(inline="always")
def solve_frame(tree, terms, t, scales2, tau, most, work):
    """Move the work's pose to where frame t's cost is least. -> status, iterations

    Every trial pose is linearised at once: most are accepted, and then the next step needs it. A step whose promise no
    longer matters is taken, but the terms are not asked again what it brought. Where nothing says where the pose should be,
    it stays.

    scales2  squared robust scales, wide to narrow: the solve runs through them, so that far-off starts are not cut off
    tau      initial damping over the largest curvature: small where the start is good
    most     iterations at each scale
    """
    pose, new, system = work.pose, work.new, work.system
    total, status = 0, RAN_OUT
    forward(tree, pose)
    for scale2 in scales2:
        place(pose, new)
        status, iterations, cost, promised, mu, nu, trial = RAN_OUT, 0, 0.0, 0.0, -1.0, 2.0, False
        while True:
            there = linearise(tree, terms, t, scale2, new, system)
            if trial and there < cost:
                mu *= max(1 / 3, 1 - (2 * (cost - there) / promised - 1) ** 3)
                nu = 2.0
                place(new, pose)
            if iterations == most:
                break
            if trial and not there < cost:  # more careful, from where it was, where the model must be made again
                mu, nu, trial = mu * nu, nu * 2.0, False
                place(pose, new)
                continue
            if mu < 0.0:
                if not held(system):
                    return UNHELD, total
                mu = tau * largest(system)
            cost = there
            if cost < EXACT:
                status = NOTHING_LEFT
                break
            iterations += 1
            promised = direction(tree, work, mu)
            if not math.isfinite(promised):
                return UNHELD, total + iterations
            stepped(tree, pose, work.step, new)
            forward(tree, new)
            if promised < SLIGHT:
                status = CONVERGED
                if nu == 2.0:  # after a refusal not even a slight promise is believed unasked
                    place(new, pose)
                break
            trial = True
        total += iterations
    return status, total


@njit(cache=True)
def take_over(root, local, shared, source, t, taken):
    """Give frame t what it takes from the pose of another."""
    for j in range(len(taken)):
        if taken[j]:
            copy(local[source, j], local[t, j])
    if taken[0]:
        copy(root[source], root[t])
        copy(shared[source], shared[t])


@njit(cache=True, nogil=True)
def solve_frames(tree, terms, plan, scales2, tau, most, rows, root, local, shared, status, iterations, first, stop):
    """`solve_frame` on the chains first..stop of a plan: root (T, 3), local (T, J, 3, 3), shared (T, P) in place; status,
    iterations (T,) out. rows: how many the terms write, None where they write none.
    """
    work = workspace(local.shape[1], shared.shape[1], rows)
    for i in range(plan.chains[first], plan.chains[stop]):
        t, source = plan.order[i], plan.source[i]
        if source >= 0:
            take_over(root, local, shared, source, t, plan.taken[min(t, len(plan.taken) - 1)])
        load(root, local, shared, t, work.pose)
        status[t], iterations[t] = solve_frame(tree, terms, t, scales2, tau, most, work)
        store(work.pose, root, local, shared, t)
