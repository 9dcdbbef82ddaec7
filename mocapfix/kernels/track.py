"""Frames solved one after the other, each from its neighbour's pose."""

from numba import njit

from mocapfix.kernels.levenberg import load, solve_frame, store, workspace
from mocapfix.kernels.pose import copy


@njit(cache=True, nogil=True)
def follow_windows(tree, terms, scales2, tau, most, rows, root, local, shared, status, iterations, windows, first, stop):
    """Solve the windows first..stop of `windows` (W, 2) (first frame, last frame), each frame from the one before it.

    A window's first frame starts where root (T, 3), local (T, J, 3, 3), shared (T, P) have it; all in place.
    """
    work = workspace(local.shape[1], shared.shape[1], rows)
    for w in range(first, stop):
        load(root, local, shared, windows[w, 0], work.pose)
        for t in range(windows[w, 0], windows[w, 1] + 1):
            status[t], iterations[t] = solve_frame(tree, terms, t, scales2, tau, most, work)
            store(work.pose, root, local, shared, t)


@njit(cache=True, nogil=True)
def bridge_runs(tree, terms, scales2, tau, most, rows, root, local, shared, unsure, runs, first, stop):
    """Solve the runs first..stop of `runs` (R, 2) anew, frame after frame from both ends to the middle, in place.

    Joints that are `unsure` (T, J) start where the frame before (from the far end: after) has them, the others where they
    are: where markers leave two poses open, as a thigh does that lost its knee, the one that goes on smoothly is found.
    """
    work = workspace(local.shape[1], shared.shape[1], rows)
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
            load(root, local, shared, t, work.pose)
            solve_frame(tree, terms, t, scales2, tau, most, work)
            store(work.pose, root, local, shared, t)
