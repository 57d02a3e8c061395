"""Machine code of Kalman's filter for one state and one measurement: innovation, density, gain and update.

S = H P H' + R = C C',   y = C^-1 (z - h),   W = C^-1 H P:   mean + W' y,   P - W' W
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

LOG_TAU = math.log(2 * math.pi)


@njit(error_model="numpy")
def wrapped(difference, period):  # type: ignore[no-untyped-def]
    """The difference within half a period; as it is for an infinite one."""
    if math.isinf(period):
        return difference
    return difference - period * math.floor(difference / period + 0.5)


@njit(error_model="numpy")
def cholesky(S, C):  # type: ignore[no-untyped-def]
    """Lower C with C C' = S; log det C. NaN where S is not positive definite."""
    log_det = 0.0
    for i in range(S.shape[0]):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= C[i, k] * C[j, k]
            if i == j:
                C[i, i] = math.sqrt(total)
                log_det += math.log(C[i, i])
            else:
                C[i, j] = total / C[j, j]
    return log_det


@njit(error_model="numpy")
def project(P, H, G, base):  # type: ignore[no-untyped-def]
    """G = P H', base = H P H'."""
    n, d = G.shape
    for a in range(d):
        for i in range(n):
            G[i, a] = 0.0
        for j in range(n):
            if H[a, j] != 0.0:
                for i in range(n):
                    G[i, a] += P[i, j] * H[a, j]
    for a in range(d):
        for b in range(a + 1):
            total = 0.0
            for j in range(n):
                total += H[a, j] * G[j, b]
            base[a, b] = base[b, a] = total


@njit(error_model="numpy")
def whiten(C, residual, y):  # type: ignore[no-untyped-def]
    """y = C^-1 residual; |y|^2."""
    square = 0.0
    for a in range(len(y)):
        total = residual[a]
        for b in range(a):
            total -= C[a, b] * y[b]
        y[a] = total / C[a, a]
        square += y[a] * y[a]
    return square


@njit(error_model="numpy")
def gain(C, G, W):  # type: ignore[no-untyped-def]
    """W = C^-1 G': the mean moves by W' y and the covariance by -W' W."""
    d, n = W.shape
    for i in range(n):
        for a in range(d):
            total = G[i, a]
            for b in range(a):
                total -= C[a, b] * W[b, i]
            W[a, i] = total / C[a, a]


@njit(error_model="numpy")
def condition(mean, P, W, y, new_mean, new_P):  # type: ignore[no-untyped-def]
    """Kalman's update: new_mean = mean + W' y, new_P = P - W' W."""
    d, n = W.shape
    for i in range(n):
        total = mean[i]
        for a in range(d):
            total += W[a, i] * y[a]
        new_mean[i] = total
        for j in range(i + 1):
            total = P[i, j]
            for a in range(d):
                total -= W[a, i] * W[a, j]
            new_P[i, j] = new_P[j, i] = total


@njit(error_model="numpy")
def room_for(n, d):  # type: ignore[no-untyped-def]
    """What `innovation` and `densities` write into, of states (n,) and measurements (d,): G, S, C, residual and y."""
    return np.empty((n, d)), np.empty((d, d)), np.empty((d, d)), np.empty(d), np.empty(d)


@njit(error_model="numpy")
def innovation(P, H, h, z, R, period, room):  # type: ignore[no-untyped-def]
    """|y|^2 and log det C, where C C' = S = H P H' + R and y = C^-1 (z - h); G = P H', S, C and y are left in the room,
    so that N(z; h, S) = exp(-log det C - (|y|^2 + d log 2 pi) / 2)."""
    G, S, C, residual, y = room
    project(P, H, G, S)
    S += R
    log_det = cholesky(S, C)
    for a in range(len(period)):
        residual[a] = wrapped(z[a] - h[a], period[a])
    return whiten(C, residual, y), log_det


@njit(error_model="numpy")
def densities(P, H, h, values, near, noise, sort, period, gate, room, found):  # type: ignore[no-untyped-def]
    """found[e] = N(z_j; h, H P H' + R_j) of the measurements j = near[e]; none where the squared Mahalanobis distance
    is beyond the gate."""
    G, S, C, residual, y = room
    d, base, solved, log_norm = len(period), np.empty_like(S), -1, 0.0
    project(P, H, G, base)
    for e in range(len(near)):
        j = near[e]
        if solved != sort[j]:
            solved = sort[j]
            np.add(base, noise[solved], S)
            log_norm = -cholesky(S, C) - 0.5 * d * LOG_TAU
        for a in range(d):
            residual[a] = wrapped(values[j, a] - h[a], period[a])
        square = whiten(C, residual, y)
        found[e] = 0.0 if square > gate else math.exp(log_norm - 0.5 * square)
