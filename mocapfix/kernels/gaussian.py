"""x"""
import numpy as np
from mocapfix.kernels.course import matern
from mocapfix.kernels.registration import fitted
from mocapfix.take import runs

COMMON = 0.05
SHAPE = 0.02
VEL = 0.1
SPAN = 0.05
NOISE = 0.003
FADE = 0.3
REACH = 0.1
USEVEL = True
ROUNDS = 5

def aligned(markers):
    seen = ~np.isnan(markers[..., 0])
    filled = np.nan_to_num(markers)
    shape = markers[np.argmax(seen.sum(1))]
    variance = np.ones(markers.shape[1])
    for _ in range(6):
        known = ~np.isnan(shape[:, 0])
        weight = seen * known / (SHAPE**2 + variance)
        total = np.maximum(weight.sum(1), 1e-12)[:, None]
        here = np.einsum("tm,tma->ta", weight, filled) / total
        there = weight @ np.nan_to_num(shape) / total
        cross = np.einsum("tm,tma,tmb->tab", weight, filled - here[:, None], np.nan_to_num(shape)[None] - there[:, None])
        R = fitted(cross)
        laid = np.einsum("tma,tab->tmb", markers - here[:, None], R) + there[:, None]
        ok = (weight > 0).sum(1) >= 3
        shape = np.nanmean(laid[ok], 0)
        variance = np.nanmean((laid[ok] - shape) ** 2, (0, 2))
    # origin such that markers = R (laid) + origin
    origin = here - np.einsum("tab,tb->ta", R, there)
    return laid, R, origin, ok

def circumstances(R, origin, rate):
    n = max(1, round(SPAN * rate))
    t = np.arange(len(R)); a, b = np.maximum(t - n, 0), np.minimum(t + n, len(R) - 1)
    dt = ((b - a) / rate)[:, None]
    up = R[:, 1, :]
    v = np.einsum("tba,tb->ta", R, (origin[b] - origin[a]) / dt)
    S = np.swapaxes(R[a], 1, 2) @ R[b]
    w = np.stack([S[:, 2, 1] - S[:, 1, 2], S[:, 0, 2] - S[:, 2, 0], S[:, 1, 0] - S[:, 0, 1]], -1) / 2 / dt
    return np.concatenate([up * 0.3, origin[:, 1:2], v * VEL, w * VEL * 0.3], 1)

def states(laid, R, origin, rate):
    T, M = laid.shape[:2]
    parts = [laid.reshape(T, -1)]
    if USEVEL:
        n = max(1, round(SPAN * rate))
        t = np.arange(T); a, b = np.maximum(t - n, 0), np.minimum(t + n, T - 1)
        vel = (laid[b] - laid[a]) / ((b - a) / rate)[:, None, None] * VEL
        vel = np.where(np.isnan(laid), np.nan, vel)
        parts.append(vel.reshape(T, -1))
    parts.append(circumstances(R, origin, rate))
    return np.concatenate(parts, 1)

def interpolated(x):
    out = x.copy(); f = np.arange(len(x))
    for c in range(x.shape[1]):
        k = ~np.isnan(x[:, c])
        if k.any() and not k.all(): out[~k, c] = np.interp(f[~k], f[k], x[k, c])
    return out

def learnt(x, rows):
    hidden = np.isnan(x)
    guess = interpolated(x)
    patterns, which = np.unique(hidden, axis=0, return_inverse=True); which = which.ravel()
    order = np.argsort(which, kind="stable"); starts = np.searchsorted(which[order], np.arange(len(patterns) + 1))
    spread = 0.0
    D = x.shape[1]
    for r in range(ROUNDS):
        mean = guess.mean(0)
        c = guess - mean
        cov = c.T @ c / len(x) + spread
        cov[np.diag_indices(D)] += NOISE**2
        P = np.linalg.inv(cov)
        spread = np.zeros((D, D))
        for p, h in enumerate(patterns):
            if not h.any() : continue
            h = np.flatnonzero(h); rr = order[starts[p]:starts[p+1]]
            inv = np.linalg.inv(P[np.ix_(h, h)])
            z = guess[rr] - mean; z[:, h] = 0
            guess[np.ix_(rr, h)] = mean[h] - z @ P[:, h] @ inv
            spread[np.ix_(h, h)] += inv * (len(rr) / len(x))
    return mean, P, guess

def gaussian(markers, rate, info=None):
    T, M = markers.shape[:2]
    out = np.full(markers.shape, np.nan); dev = np.full((T, M), np.nan)
    seenall = ~np.isnan(markers[..., 0])
    common = np.flatnonzero(seenall.mean(0) > COMMON)
    if len(common) < 4: return out, dev
    mk = markers[:, common]; seen = seenall[:, common]
    laid, R, origin, ok = aligned(mk)
    x = states(laid, R, origin, rate)
    mean, P, guess = learnt(x, ok)
    m = len(common)
    missing = ~seen
    steps = max(1, round(REACH * rate)); pick = np.unique(np.linspace(0, steps - 1, min(6, steps)).astype(int))
    gapof = np.full((T, m), -1); gaps = []
    for k in range(m):
        for a, b in runs(missing[:, k]):
            near = np.r_[a - 1 - pick, b + 1 + pick]; near = near[(near >= 0) & (near < T)]; near = near[seen[near, k]]
            g = np.arange(a, b + 1)
            if len(near):
                A = matern((near[:, None] - near[None]) / rate, FADE) + 1e-3 * np.eye(len(near))
                B = matern((g[:, None] - near[None]) / rate, FADE)
                W = np.linalg.solve(A, B.T).T; left = np.maximum(1 - (W * B).sum(1), 1e-3)
            else: W = np.zeros((len(g), 0)); left = np.ones(len(g))
            gapof[a:b+1, k] = len(gaps); gaps.append((a, near, W, left))
    patterns, which = np.unique(missing, axis=0, return_inverse=True); which = which.ravel()
    res = np.full((T, m, 3), np.nan); d = np.full((T, m), np.nan)
    for p, h in enumerate(patterns):
        if not h.any() or (~h).sum() < 3: continue
        hm = np.flatnonzero(h); rr = np.flatnonzero((which == p) & ok)
        if not len(rr): continue
        cols = np.concatenate([3 * hm[:, None] + np.arange(3)] + ([3 * m + 3 * hm[:, None] + np.arange(3)] if USEVEL else []), 1).ravel()
        inv = np.linalg.inv(P[np.ix_(cols, cols)])
        asked = [rr] + [gaps[g][1] for k in hm for g in np.unique(gapof[rr, k])]
        asked = np.unique(np.concatenate(asked))
        z = guess[asked] - mean; z[:, cols] = 0
        G = mean[cols] - z @ P[:, cols] @ inv
        G = G.reshape(len(asked), len(hm), -1)[:, :, :3]
        var = np.diag(inv).reshape(len(hm), -1)[:, :3].mean(1)
        pos = np.full(T, -1); pos[asked] = np.arange(len(asked))
        for i, k in enumerate(hm):
            for g in np.unique(gapof[rr, k]):
                a, near, W, left = gaps[g]
                mine = rr[gapof[rr, k] == g]
                e = laid[near, k] - G[pos[near], i]
                res[mine, k] = G[pos[mine], i] + W[mine - a] @ e
                d[mine, k] = np.sqrt(var[i] * left[mine - a])
    world = np.einsum("tab,tmb->tma", R, res) + origin[:, None]
    out[:, common] = world; dev[:, common] = d
    return out, dev
