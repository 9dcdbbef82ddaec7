"""The direction as mocapfix computes it: the leaves-to-root sweep, in O(K) + O(N)."""

import time
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.bench.scene import ORIENTATION, POINT, PROJECTION, Scene, rows, stretched
from mocapfix.kernels import sweep
from mocapfix.kernels.levenberg import Attached, arms, copy, linearise


class Work(NamedTuple):
    """What one direction is written into: bodies' and joints' curvatures and gradients, and the shape's."""

    h: np.ndarray  # (J, 6, 6)
    g: np.ndarray  # (J, 6)
    own: np.ndarray  # (J, 3, 3)
    b: np.ndarray  # (J, 3)
    arm: np.ndarray  # (J, 3)
    gain: np.ndarray  # (J, 6, 3)
    inverse_own: np.ndarray  # (J, 3, 3)
    stretch: np.ndarray  # (P, J, 3)
    mixed: np.ndarray  # (P, J, 6) curvature between a shape parameter and a body's twist
    shape: np.ndarray  # (P, P)
    slope: np.ndarray  # (P,)
    twist: np.ndarray  # (P + 1, J, 6) out: steps, of each shape parameter's pose and [P] of the whole
    turn: np.ndarray  # (P + 1, J, 3) out: likewise; the root's is part of its twist
    step: np.ndarray  # (P,) out: of the shape parameters


def work(scene: Scene) -> Work:
    """-> arrays for the scene's direction."""
    j, p = len(scene.local), len(scene.growth)
    shapes = ((j, 6, 6), (j, 6), (j, 3, 3), (j, 3), (j, 3), (j, 6, 3), (j, 3, 3), (p, j, 3), (p, j, 6), (p, p), (p,))
    return Work(*(np.zeros(shape) for shape in (*shapes, (p + 1, j, 6), (p + 1, j, 3), (p,))))


@njit(cache=True)
def direction(scene, w):
    """Linearise all measurements and priors of a scene and solve for the Gauss-Newton step, into `w`."""
    points, tree, shapes = scene.points, scene.tree, len(w.stretch)
    attached = Attached(points.joints, points.places)
    linearise(
        tree, attached, points.targets, points.weight, np.inf, (scene.pull,), scene.local, scene.position, scene.rotation,
        w.h, w.g, w.own, w.b,
    )  # fmt: skip
    stretched(scene, w.stretch)
    w.mixed.fill(0)
    w.shape.fill(0)
    w.slope.fill(0)
    if shapes > 0:
        add(scene, POINT, points, w, False)
    add(scene, PROJECTION, scene.projections, w, True)
    add(scene, ORIENTATION, scene.orientations, w, True)
    arms(scene.position, w.arm)
    sweep.factor(tree.parents, tree.free, w.arm, w.h, w.own, 0.0, w.gain, w.inverse_own)
    eliminate(tree, w)


@njit(cache=True)
def add(scene, kind, measured, w, twists):
    """Add one kind of measurements to the bodies' curvatures (where `twists`), and to the shape's."""
    shapes = len(w.stretch)
    by_place, by_twist, by_shape, error = np.empty((3, 3)), np.empty((3, 6)), np.empty((3, shapes)), np.empty(3)
    for n in range(len(measured.joints)):
        j = measured.joints[n]
        for r in range(rows(scene, kind, measured, n, w.stretch, by_place, by_twist, by_shape, error)):
            if twists:
                for a in range(6):
                    w.g[j, a] += by_twist[r, a] * error[r]
                    for c in range(6):
                        w.h[j, a, c] += by_twist[r, a] * by_twist[r, c]
            for p in range(shapes):
                w.slope[p] += by_shape[r, p] * error[r]
                for a in range(6):
                    w.mixed[p, j, a] += by_shape[r, p] * by_twist[r, a]
                for q in range(shapes):
                    w.shape[p, q] += by_shape[r, p] * by_shape[r, q]


@njit(cache=True)
def eliminate(tree, w):
    """The pose's step, the shape's by its Schur complement: each parameter is one more right-hand side of the sweep."""
    shapes, press, unpressed = len(w.stretch), np.empty_like(w.g), np.zeros_like(w.b)
    for p in range(shapes + 1):
        copy(w.g if p == shapes else w.mixed[p], press)
        b = w.b if p == shapes else unpressed
        sweep.solve(tree.parents, tree.free, w.arm, w.h[0], w.gain, w.inverse_own, press, b, w.twist[p], w.turn[p])
    if shapes == 0:
        return
    reduced, step = w.shape.copy(), w.step
    for p in range(shapes):
        step[p] = -w.slope[p]
    for p in range(shapes):
        reduced[p, p] += 1.0  # the unit normal on the parameter
        for j in range(len(w.g)):
            for a in range(6):
                step[p] -= w.mixed[p, j, a] * w.twist[shapes, j, a]
                for q in range(shapes):
                    reduced[p, q] += w.mixed[p, j, a] * w.twist[q, j, a]
    solve_in_place(reduced, step)
    for p in range(shapes):
        for j in range(len(w.g)):
            for a in range(6):
                w.twist[shapes, j, a] += step[p] * w.twist[p, j, a]
            for a in range(3):
                w.turn[shapes, j, a] += step[p] * w.turn[p, j, a]


@njit(cache=True)
def solve_in_place(a, x):
    """Write the solution of a y = x into x (P,); a (P, P), positive definite, is spoilt. Gaussian elimination."""
    for i in range(len(x)):
        for r in range(i + 1, len(x)):
            part = a[r, i] / a[i, i]
            x[r] -= part * x[i]
            for c in range(i + 1, len(x)):
                a[r, c] -= part * a[i, c]
    for i in range(len(x) - 1, -1, -1):
        for c in range(i + 1, len(x)):
            x[i] -= a[i, c] * x[c]
        x[i] /= a[i, i]


@njit(cache=True)
def repeat(scene, w, times):
    """Compute the same direction so many times."""
    for _ in range(times):
        direction(scene, w)


def seconds(scene: Scene, w: Work, times: int) -> float:
    """-> what one direction costs the processor, the mean of so many in a compiled loop."""
    started = time.thread_time()
    repeat(scene, w, times)
    return (time.thread_time() - started) / times
