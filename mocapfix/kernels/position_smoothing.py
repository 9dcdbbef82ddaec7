"""Smoothing of joint positions over time, compiled: a Kalman filter and the smoother of Rauch, Tung and Striebel.

Each coordinate is an integrated random walk of its velocity, measured with a known standard deviation.
"""

import math

import numpy as np

from mocapfix.kernels.compilation_cache import compile_kernel

START_VARIANCE_M2 = 1e4  # of a position before the first measurement
START_VELOCITY_VARIANCE = 1e2  # m^2/s^2, of a velocity before the first measurement


@compile_kernel(nogil=True)
def smooth_position_joints(positions, sd, walk_density, interval_s, smoothed, smoothed_sd, first, stop):
    """Write smoothed positions (T, J, 3) and standard deviations (T, J) of the joints first..stop - 1.

    positions     (T, J, 3) metres, NaN where not given
    sd            (T, J) metres per axis
    walk_density  (J,) m^2/s^3: variance per second that a velocity gains
    """
    frames = len(positions)
    mean, predicted_mean = np.empty((frames, 3, 2)), np.empty((frames, 3, 2))
    variance, predicted_variance = np.empty((frames, 3)), np.empty((frames, 3))  # of position, both, and velocity
    dt = interval_s
    for j in range(first, stop):
        q = walk_density[j]
        pp, pv, vv = START_VARIANCE_M2, 0.0, START_VELOCITY_VARIANCE
        for t in range(frames):
            if t > 0:
                pp, pv = pp + 2 * dt * pv + dt * dt * vv + q * dt**3 / 3, pv + dt * vv + q * dt * dt / 2
                vv += q * dt
            predicted_variance[t, 0], predicted_variance[t, 1], predicted_variance[t, 2] = pp, pv, vv
            is_given = not math.isnan(positions[t, j, 0])
            gain_p, gain_v = 0.0, 0.0
            if is_given:
                total = pp + sd[t, j] ** 2
                gain_p, gain_v = pp / total, pv / total
            for a in range(3):
                x = mean[t - 1, a, 0] + dt * mean[t - 1, a, 1] if t > 0 else 0.0
                v = mean[t - 1, a, 1] if t > 0 else 0.0
                predicted_mean[t, a, 0], predicted_mean[t, a, 1] = x, v
                if is_given:
                    rest = positions[t, j, a] - x
                    x += gain_p * rest
                    v += gain_v * rest
                mean[t, a, 0], mean[t, a, 1] = x, v
            pp, pv, vv = (1 - gain_p) * pp, (1 - gain_p) * pv, vv - gain_v * pv
            variance[t, 0], variance[t, 1], variance[t, 2] = pp, pv, vv
        for t in range(frames - 1, -1, -1):
            if t < frames - 1:
                fp, fpv, fv = variance[t, 0], variance[t, 1], variance[t, 2]
                np_, npv, nv = predicted_variance[t + 1, 0], predicted_variance[t + 1, 1], predicted_variance[t + 1, 2]
                det = np_ * nv - npv * npv
                c00, c01 = fp + dt * fpv, fpv  # covariance of this frame with the next
                c10, c11 = fpv + dt * fv, fv
                g00, g01 = (c00 * nv - c01 * npv) / det, (c01 * np_ - c00 * npv) / det
                g10, g11 = (c10 * nv - c11 * npv) / det, (c11 * np_ - c10 * npv) / det
                d0, d1, d2 = pp - np_, pv - npv, vv - nv
                pp = fp + g00 * (g00 * d0 + g01 * d1) + g01 * (g00 * d1 + g01 * d2)
                pv = fpv + g10 * (g00 * d0 + g01 * d1) + g11 * (g00 * d1 + g01 * d2)
                vv = fv + g10 * (g10 * d0 + g11 * d1) + g11 * (g10 * d1 + g11 * d2)
                for a in range(3):
                    x, v = mean[t + 1, a, 0] - predicted_mean[t + 1, a, 0], mean[t + 1, a, 1] - predicted_mean[t + 1, a, 1]
                    mean[t, a, 0] += g00 * x + g01 * v
                    mean[t, a, 1] += g10 * x + g11 * v
            smoothed_sd[t, j] = math.sqrt(max(pp, 0.0))
            for a in range(3):
                smoothed[t, j, a] = mean[t, a, 0]
