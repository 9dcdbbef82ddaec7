"""Screening of points that may be exact functions of others: spread of distances, points between two, places in a frame.

A median is the lower one of an even number of values; values that are NaN do not count, and without values it is infinite.
"""

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel

SD_PER_MEDIAN_DEVIATION = 1.5  # standard deviation of a normal distribution in multiples of its median absolute deviation
# Number of vectors of which a place is a combination, and largest number of fitted vectors.
PLACE_VECTORS = 5
MAX_VECTORS = 5


@compile_inner_kernel
def _find_median(values, count):
    """Return the median of the first values, whose order is changed (Hoare's selection)."""
    if count == 0:
        return np.inf
    rank, low, high = (count - 1) // 2, 0, count - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]


@compile_kernel(nogil=True)
def measure_pair_sds(coordinates, one, other, min_count):
    """Return a robust standard deviation (N,), in metres, of the distance of each pair of points; infinite if it is rarely known.

    Args:
        coordinates: (3, P, T) metres.
        one, other: (N,) the points of each pair.
        min_count: Number of frames in which both must be visible.
    """
    frames = coordinates.shape[2]
    sd_m, distance, known = np.empty(len(one)), np.empty(frames), np.empty(frames)
    for n in range(len(one)):
        a, b = one[n], other[n]
        for t in range(frames):
            x = coordinates[0, a, t] - coordinates[0, b, t]
            y = coordinates[1, a, t] - coordinates[1, b, t]
            z = coordinates[2, a, t] - coordinates[2, b, t]
            distance[t] = np.sqrt(x * x + y * y + z * z)
        count = 0
        for t in range(frames):
            if distance[t] == distance[t]:
                known[count] = distance[t]
                count += 1
        if count < min_count:
            sd_m[n] = np.inf
            continue
        median = _find_median(known, count)
        for i in range(count):
            known[i] = abs(known[i] - median)
        sd_m[n] = SD_PER_MEDIAN_DEVIATION * _find_median(known, count)
    return sd_m


@compile_kernel(nogil=True)
def screen_pairs(own, others, max_misfit_m, min_ratio):
    """Return the median distance (K, K) of a point from each of its lines; infinite unless it is between the two and near.

    The line is that between two others on which the point has the same ratio in all frames. Entry [a, b] with a < b is of the
    pair of the others a and b; the rest of the array is infinite.

    Args:
        own: (F, 3) metres.
        others: (K, F, 3).
        max_misfit_m: Larger distances become infinite.
        min_ratio: To either of the two, below which the point is a copy of the other.
    """
    count, frames = others.shape[:2]
    result, known = np.full((count, count), np.inf), np.empty(frames)
    relative = np.empty((count, frames, 3))
    for k in range(count):
        for t in range(frames):
            for x in range(3):
                relative[k, t, x] = own[t, x] - others[k, t, x]
    square_limit = max_misfit_m * max_misfit_m
    for a in range(count):
        for b in range(a + 1, count):
            far = 0
            for t in range(frames):
                px, py, pz = relative[a, t, 0], relative[a, t, 1], relative[a, t, 2]
                qx, qy, qz = relative[b, t, 0], relative[b, t, 1], relative[b, t, 2]
                x, y, z = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
                sx, sy, sz = px - qx, py - qy, pz - qz
                if x * x + y * y + z * z >= square_limit * (sx * sx + sy * sy + sz * sz):
                    far += 1
                    if far > frames // 2:
                        break
            if far > frames // 2:
                continue  # so many frames are farther from any point of the line
            known_count = 0
            for t in range(frames):
                dot, square = 0.0, 0.0
                for x in range(3):
                    step = relative[a, t, x] - relative[b, t, x]
                    dot += relative[a, t, x] * step
                    square += step * step
                if square > 0:
                    known[known_count] = dot / square
                    known_count += 1
            ratio = _find_median(known, known_count)
            if not min_ratio < ratio < 1 - min_ratio:
                continue
            known_count = 0
            for t in range(frames):
                square = 0.0
                for x in range(3):
                    step = relative[a, t, x] - relative[b, t, x]
                    square += (relative[a, t, x] - ratio * step) ** 2
                if square == square:
                    known[known_count] = np.sqrt(square)
                    known_count += 1
            misfit = _find_median(known, known_count)
            if misfit < max_misfit_m:
                result[a, b] = misfit
    return result


@compile_inner_kernel
def _fit_vectors(target, basis, size, prior, rounds, workspace):
    """Return the median distance (metres) of a target (F, 3) from combinations of vectors, basis (F, 3, at least `size`).

    Coefficients have a prior of the standard deviation 1, as misfits of `prior` metres; frames that do not agree with the others
    have little weight. A frame in which the target or a vector is NaN does not count.
    """
    normal, right, coefficients, weight, misfit = workspace
    frames = len(target)
    for t in range(frames):
        total = target[t, 0] + target[t, 1] + target[t, 2]
        for x in range(3):
            for u in range(size):
                total += basis[t, x, u]
        weight[t] = 1.0 if np.isfinite(total) else 0.0
    count = 0
    for _ in range(rounds):
        for u in range(size):
            right[u] = 0.0
            for v in range(u + 1):
                normal[u, v] = prior * prior if u == v else 0.0
        for t in range(frames):
            if weight[t] == 0.0:
                continue
            for x in range(3):
                for u in range(size):
                    scaled = weight[t] * basis[t, x, u]
                    right[u] += scaled * target[t, x]
                    for v in range(u + 1):
                        normal[u, v] += scaled * basis[t, x, v]
        for u in range(size):  # Cholesky
            for v in range(u + 1):
                total = normal[u, v]
                for k in range(v):
                    total -= normal[u, k] * normal[v, k]
                normal[u, v] = np.sqrt(max(total, 1e-300)) if u == v else total / normal[v, v]
        for u in range(size):
            total = right[u]
            for k in range(u):
                total -= normal[u, k] * coefficients[k]
            coefficients[u] = total / normal[u, u]
        for u in range(size - 1, -1, -1):
            total = coefficients[u]
            for k in range(u + 1, size):
                total -= normal[k, u] * coefficients[k]
            coefficients[u] = total / normal[u, u]
        count = 0
        for t in range(frames):
            if weight[t] == 0.0:
                continue
            square = 0.0
            for x in range(3):
                difference = target[t, x]
                for u in range(size):
                    difference -= basis[t, x, u] * coefficients[u]
                square += difference * difference
            misfit[count] = np.sqrt(square)
            weight[t] = prior / max(misfit[count], prior)
            count += 1
    return _find_median(misfit, count)


@compile_inner_kernel
def _allocate_fit(frames):
    return (
        np.empty((MAX_VECTORS, MAX_VECTORS)), np.empty(MAX_VECTORS), np.empty(MAX_VECTORS), np.empty(frames), np.empty(frames),
    )  # fmt: skip


@compile_kernel(nogil=True)
def screen_mean(own, near, limit_m, rounds):
    """Return the median distance (metres) of a point (F, 3) from a weighted mean of others (F, n, 3), n up to 6."""
    frames, count = near.shape[:2]
    target, basis = np.empty((frames, 3)), np.empty((frames, 3, MAX_VECTORS))
    for t in range(frames):
        for x in range(3):
            target[t, x] = own[t, x] - near[t, 0, x]
            for n in range(1, count):
                basis[t, x, n - 1] = near[t, n, x] - near[t, 0, x]
    return _fit_vectors(target, basis, count - 1, limit_m, rounds, _allocate_fit(frames))


@compile_kernel(nogil=True)
def screen_places(own, near, corner_weights, is_spanning, min_sine, limit_m, rounds):
    """Return the median distance (N,) in metres of a point from its place in each of N frames.

    Args:
        own: (F, 3) metres.
        near: (F, n, 3) the points that the frames are built of.
        corner_weights: (N, 3, n) their weights in the corners of the frames.
        is_spanning: Fit vectors that span the places in all frames with the same corners, instead of those of one frame.
        min_sine: Of the angle of three corners that span a frame.
        limit_m: Misfit from which a frame loses weight.
        rounds: Of reweighting.
    """
    frames, count = near.shape[:2]
    result, target, basis = np.empty(len(corner_weights)), np.empty((frames, 3)), np.empty((frames, 3, MAX_VECTORS))
    workspace, corner = _allocate_fit(frames), np.empty((3, 3))
    for n in range(len(corner_weights)):
        for t in range(frames):
            for c in range(3):
                for x in range(3):
                    total = 0.0
                    for p in range(count):
                        if corner_weights[n, c, p] != 0.0:
                            total += corner_weights[n, c, p] * near[t, p, x]
                    corner[c, x] = total
            first_length, second_length = 0.0, 0.0
            for x in range(3):
                target[t, x] = own[t, x] - corner[0, x]
                basis[t, x, 0] = corner[1, x] - corner[0, x]
                basis[t, x, 1] = corner[2, x] - corner[0, x]
                first_length += basis[t, x, 0] ** 2
                second_length += basis[t, x, 1] ** 2
            first_length, second_length = np.sqrt(first_length), np.sqrt(second_length)
            length = 0.0
            for x in range(3):
                y, z = (x + 1) % 3, (x + 2) % 3
                basis[t, x, 4] = basis[t, y, 0] * basis[t, z, 1] - basis[t, z, 0] * basis[t, y, 1]
                length += basis[t, x, 4] ** 2
            length = np.sqrt(length)
            if not length > min_sine * first_length * second_length:
                target[t, 0] = np.nan
                continue
            for x in range(3):
                basis[t, x, 4] /= length
                basis[t, x, 2] = basis[t, x, 0] / first_length
            for x in range(3):
                y, z = (x + 1) % 3, (x + 2) % 3
                if is_spanning:
                    basis[t, x, 3] = basis[t, x, 1] / second_length
                else:
                    basis[t, x, 3] = basis[t, y, 4] * basis[t, z, 2] - basis[t, z, 4] * basis[t, y, 2]
        result[n] = _fit_vectors(target, basis, PLACE_VECTORS, limit_m, rounds, workspace)
    return result
