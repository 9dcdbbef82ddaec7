"""Estimates of a lost marker, compiled: between the edges of a gap, from a residual beside it, and the weights of several."""

import math

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.small_matrices import (
    SUM_FASTMATH_FLAGS,
    clear_array,
    factor_cholesky,
    load_matrix,
    multiply_vector,
    solve_cholesky,
    transpose_matrix,
)

EXPECTED_WEIGHT = 2.0  # number of independent hidden stretches that the expected covariance is worth
FIRST_STRETCH_DISCOUNT = 0.5  # number of stretches that are subtracted: a single one shows little
COVARIANCE_RIDGE = 1e-3  # relative increase of the variances, so that equal estimates share their weight


@compile_kernel(nogil=True)
def interpolate_stretches(path, rotation, origin, rows, points, frames, edges, scale):
    """Return estimates (E, K, S, 3) of a path at S points, offsets in K stretches of some frames, and the noise (E, S) in them.

    The path (F, 3) is interpolated in moving axes. Row k of `rows` (K, C + S) has the C samples beside a stretch and the points.
    `edges` (E, 4, C) maps those samples to position and velocity before the stretch, and after it; the first is for a line, the
    second, if there is one, for a spline. With a scale (E,) they are errors, multiplied by it. The noise is relative to that of a
    sample.
    """
    count = edges.shape[2]
    out, noise, local = (
        np.empty((len(edges), len(rows), len(points), 3)),
        np.empty((len(edges), len(points))),
        np.empty((count, 3)),
    )
    for k in range(len(rows)):
        for c in range(count):
            r = rows[k, c]
            x, y, z = path[r, 0] - origin[r, 0], path[r, 1] - origin[r, 1], path[r, 2] - origin[r, 2]
            local[c, 0], local[c, 1], local[c, 2] = multiply_vector(transpose_matrix(load_matrix(rotation, r)), x, y, z)
        for e in range(len(edges)):
            for s in range(len(points)):
                steps, r = frames + 1, rows[k, count + s]
                after = (points[s] + 1) / steps
                before = 1 - after
                speed_before, speed_after = 0.0, 0.0
                if e > 0:
                    speed_before, speed_after = steps * after * before * before, steps * before * after * after
                    before, after = (1 + 2 * after) * before * before, (1 + 2 * before) * after * after
                x, y, z, square = 0.0, 0.0, 0.0, 0.0
                for c in range(count):
                    w = before * edges[e, 0, c] + speed_before * edges[e, 1, c]
                    w += after * edges[e, 2, c] + speed_after * edges[e, 3, c]
                    x, y, z, square = x + w * local[c, 0], y + w * local[c, 1], z + w * local[c, 2], square + w * w
                noise[e, s] = math.sqrt(square)
                x, y, z = multiply_vector(load_matrix(rotation, r), x, y, z)
                out[e, k, s, 0], out[e, k, s, 1], out[e, k, s, 2] = x + origin[r, 0], y + origin[r, 1], z + origin[r, 2]
                for a in range(3 if len(scale) else 0):
                    out[e, k, s, a] = (out[e, k, s, a] - path[r, a]) * scale[e]
    return out, noise


@compile_kernel(nogil=True)
def map_residual(known_s, wanted_s, power, time_scale_s, roughness, noise, known_excess, wanted_excess, weights, variance):
    """Write the linear map (P, N) and the variance (P,) of `stats.gaussian_process.map_residual`, which has the arguments."""
    known, factor, across = len(known_s), np.empty((len(known_s), len(known_s))), np.empty(len(known_s))
    for i in range(known):
        for j in range(i + 1):
            excess = math.sqrt(known_excess[i] * known_excess[j]) / power
            factor[i, j] = _correlate(known_s[i] - known_s[j], time_scale_s, roughness, excess)
        factor[i, i] += noise[i] / power
    factor_cholesky(factor)
    for p in range(len(wanted_s)):
        for i in range(known):
            excess = math.sqrt(wanted_excess[p] * known_excess[i]) / power
            across[i] = _correlate(wanted_s[p] - known_s[i], time_scale_s, roughness, excess)
        weights[p] = across
        solve_cholesky(factor, weights[p])
        variance[p] = max(power * (1 - np.sum(weights[p] * across)) + wanted_excess[p], 0.0)


@compile_inner_kernel
def _correlate(lag_s, time_scale_s, roughness, excess):
    """Return the correlation of a residual at a lag, with that of a smooth process beside it."""
    rough = abs(lag_s) / time_scale_s
    smooth = math.sqrt(3.0) * rough
    return (1 - roughness + excess) * (1 + smooth) * math.exp(-smooth) + roughness * math.exp(-rough)


@compile_kernel(nogil=True)
def regress_without(x, y, left_out, ridge, probes):
    """Return ridge regressions of y (N, 3) on x (N, F), each without the rows that a row of `left_out` (G, N) marks.

    The coefficients (G, F, 3); the sums (G, 2) over the rows left out of the squared errors, and of the variances of the
    predictions relative to that of a residual; and these variances (P,) at probes (P, F) by the first regression. Each row that
    is learned from adds the ridge to the curvature.
    """
    size, coefficients, judged = x.shape[1], np.empty((len(left_out), x.shape[1], 3)), np.zeros((len(left_out), 2))
    whole, part, leverage = np.zeros((size, size + 3)), np.zeros((size, size + 3)), np.empty(len(probes))
    factor, vector = np.empty((size, size)), np.empty(size)
    for n in range(len(x)):
        _add_products(x[n], y[n], whole)
    for g in range(len(left_out)):
        count = 0
        clear_array(part)
        for n in range(len(x)):
            if left_out[g, n]:
                count += 1
                _add_products(x[n], y[n], part)
        for i in range(size):
            for j in range(i + 1):
                factor[i, j] = whole[i, j] - part[i, j]
            factor[i, i] += max(len(x) - count, 1) * ridge
        factor_cholesky(factor)
        for a in range(3):
            for i in range(size):
                vector[i] = whole[i, size + a] - part[i, size + a]
            solve_cholesky(factor, vector)
            for i in range(size):
                coefficients[g, i, a] = vector[i]
        for n in range(len(x)):
            if not left_out[g, n]:
                continue
            judged[g, 1] += _measure_leverage(factor, x[n], vector)
            for a in range(3):
                error = y[n, a]
                for i in range(size):
                    error -= x[n, i] * coefficients[g, i, a]
                judged[g, 0] += error * error
        for p in range(len(probes) if g == 0 else 0):
            leverage[p] = _measure_leverage(factor, probes[p], vector)
    return coefficients, judged, leverage


@compile_inner_kernel
def _add_products(x, y, sums):
    """Add x x' (lower triangle) and x y' to sums (F, F + 3)."""
    for i in range(len(x)):
        for j in range(i + 1):
            sums[i, j] += x[i] * x[j]
        for a in range(3):
            sums[i, len(x) + a] += x[i] * y[a]


@compile_inner_kernel(fastmath=SUM_FASTMATH_FLAGS)
def _measure_leverage(factor, x, vector):
    """Return x' A^-1 x, where A = L L' and `factor` has L; `vector` is overwritten."""
    square = 0.0
    for i in range(len(x)):
        total = 0.0
        for c in range(i):
            total += factor[i, c] * vector[c]
        vector[i] = (x[i] - total) / factor[i, i]
        square += vector[i] * vector[i]
    return square


@compile_kernel(nogil=True)
def combine_estimates(position, error, expected_sd, similarity, independent, shown, correlation, min_sd, points, methods, out):
    """Write the combination of E estimates of a gap with the smallest expected error: positions, deviations and main methods.

    Positions (E, n, 3), errors (E, K, S, 3) and expected deviations (E, S) are those of `GapEstimate`. `similarity` (K,) is that
    of the stretches, of which so many are independent, to the gap; `shown` (E,) is the share of an error in the gap that they
    show, `correlation` (E, E) the expected one, and `points` (S,) are those of the gap. An estimate whose position is NaN in some
    frames counts in the others only.
    """
    estimates, count = expected_sd.shape
    covariance, trust = np.empty((count, estimates, estimates)), np.empty(estimates)
    measure_error_covariances(error, similarity, covariance)
    for e in range(estimates):
        known = 0.0
        for k in range(len(similarity)):
            shown_points = 0
            for s in range(count):
                shown_points += not math.isnan(error[e, k, s, 0])
            known += similarity[k] * (shown_points / count) / len(similarity)
        evidence = max(independent * known - FIRST_STRETCH_DISCOUNT, 0.0) * shown[e]
        trust[e] = evidence / (evidence + EXPECTED_WEIGHT)
    for s in range(count):
        shrink_covariance(covariance[s], expected_sd, s, correlation, trust, min_sd)
    method_count = 0
    for method in methods:
        method_count = max(method_count, method + 1)
    weights, sd, by_method, row = np.zeros((count, estimates)), np.empty(count), np.empty(method_count), 0
    is_active, used = np.zeros(estimates, np.bool_), np.empty(estimates, np.int64)
    for f in range(position.shape[1]):
        is_changed, active = f == 0, 0
        for e in range(estimates):
            is_known = not math.isnan(position[e, f, 0])
            is_changed, is_active[e], active = is_changed or is_known != is_active[e], is_known, active + is_known
        for s in range(count if is_changed else 0):
            sd[s] = math.sqrt(find_weights(covariance[s], is_active, used, weights[s])) if active else math.nan
        while row < count - 2 and points[row + 1] <= f:
            row += 1
        after = min(row + 1, count - 1)
        share = (f - points[row]) / (points[after] - points[row]) if after > row else 0.0
        out[1][f] = (1 - share) * sd[row] + share * sd[after]
        clear_array(by_method)
        most, x = 0, 0.0 if active else math.nan
        y, z = x, x
        for e in range(estimates):
            if is_active[e]:
                weight = (1 - share) * weights[row, e] + share * weights[after, e]
                by_method[methods[e]] += weight
                x, y, z = x + weight * position[e, f, 0], y + weight * position[e, f, 1], z + weight * position[e, f, 2]
        out[0][f, 0], out[0][f, 1], out[0][f, 2] = x, y, z
        for m in range(1, len(by_method)):
            if by_method[m] > by_method[most]:
                most = m
        out[2][f] = most


@compile_inner_kernel
def measure_error_covariances(error, similarity, covariance):
    """Write the second moments (S, E, E), m2 per axis, of the errors (E, K, S, 3) of E estimates at S points; NaN where unknown.

    Stretches are weighted by their similarity to the gap. Neighbouring points and the mirrored point are averaged.
    """
    estimates, stretches, points, _ = error.shape
    moments, counts = np.empty(points + 2), np.empty(points + 2)  # sums of products and of weights, with a margin
    for e in range(estimates):
        for other in range(e + 1):
            clear_array(moments)
            clear_array(counts)
            for k in range(stretches):
                for s in range(points):
                    product = error[e, k, s, 0] * error[other, k, s, 0] + error[e, k, s, 1] * error[other, k, s, 1]
                    product += error[e, k, s, 2] * error[other, k, s, 2]
                    if not math.isnan(product):
                        moments[s + 1] += similarity[k] * product / 3
                        counts[s + 1] += similarity[k]
                        moments[points - s] += similarity[k] * product / 3
                        counts[points - s] += similarity[k]
            for s in range(points):
                beside = 0.5 if 0 < s < points - 1 else 0.0
                moment = moments[s + 1] + beside * (moments[s] + moments[s + 2])
                count = counts[s + 1] + beside * (counts[s] + counts[s + 2])
                covariance[s, e, other] = covariance[s, other, e] = moment / count if count > 0 else math.nan


@compile_inner_kernel
def shrink_covariance(covariance, expected_sd, s, expected_correlation, trust, min_sd):
    """Replace a covariance (E, E) by one between it and the expected one, with a trust (E,), 0 to 1, in each measured error."""
    sd, scale = np.empty(len(covariance)), np.empty(len(covariance))
    for e in range(len(covariance)):
        own, expected = covariance[e, e], math.log(max(expected_sd[e, s], min_sd))
        measured_sd, share = (1.0, 0.0) if math.isnan(own) else (math.sqrt(own), trust[e])
        scale[e] = max(measured_sd, min_sd / 10)
        sd[e] = math.exp(share * math.log(max(measured_sd, min_sd)) + (1 - share) * expected)
    for e in range(len(covariance)):
        for other in range(e + 1):
            measured, expected = covariance[e, other] / scale[e] / scale[other], expected_correlation[e, other]
            measured = expected if math.isnan(measured) else min(max(measured, -1.0), 1.0)
            shared = math.sqrt(trust[e] * trust[other])
            correlation = 1 + COVARIANCE_RIDGE if e == other else shared * measured + (1 - shared) * expected
            covariance[e, other] = covariance[other, e] = correlation * sd[e] * sd[other]


@compile_inner_kernel
def find_weights(covariance, is_active, used, weights):
    """Write weights (E,) that are not negative, sum to one and give a small expected error; return the variance of this error.

    Only the active estimates, of which there is at least one, have a weight. `used` (E,) is overwritten.

    Estimates with negative weights are left out in turn. This can leave out a good one, and a covariance from few stretches
    need not be positive definite. So where the best estimate alone is expected to have the smaller error, it has all the weight.
    """
    count, best = 0, -1
    for e in range(len(weights)):
        weights[e] = 0.0
        if is_active[e]:
            used[count], count = e, count + 1
            best = e if best < 0 or covariance[e, e] < covariance[best, best] else best
    system, kept = np.empty((count, count + 1)), 0  # the last column is what the others are to sum to
    while kept < count:
        for i in range(count):
            for j in range(count):
                system[i, j] = covariance[used[i], used[j]]
            system[i, count] = 1.0
        _eliminate(system, count)
        kept = 0
        for i in range(count):
            if system[i, count] > 0:
                used[kept], system[kept, count], kept = used[i], system[i, count], kept + 1
        if kept == 0:
            used[0], kept = best, 1
        if kept < count:
            kept, count = 0, kept
    total, variance = 0.0, 0.0
    for i in range(count):
        total += system[i, count]
    for i in range(count):
        weights[used[i]] = system[i, count] / total
    for i in range(count):
        for j in range(count):
            variance += weights[used[i]] * covariance[used[i], used[j]] * weights[used[j]]
    if variance > covariance[best, best]:
        for i in range(count):
            weights[used[i]] = 0.0
        weights[best], variance = 1.0, covariance[best, best]
    return variance


@compile_inner_kernel
def _eliminate(system, count):
    """Solve a system of equations, count rows of so many coefficients and a right side, with pivots, in place."""
    for i in range(count):
        pivot = i
        for k in range(i + 1, count):
            if abs(system[k, i]) > abs(system[pivot, i]):
                pivot = k
        divisor = system[pivot, i]
        for c in range(count + 1):
            system[pivot, c], system[i, c] = system[i, c], system[pivot, c] / divisor
        for k in range(count):
            factor = system[k, i]
            for c in range(count + 1 if k != i else 0):
                system[k, c] -= factor * system[i, c]
