"""Machine code of the labeled multi-Bernoulli filter with particles: the update by one scan."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from inference.association_kernel import AUTO, associate
from inference.lmb_kernel import LOG_TAU, MAX_ITERATIONS, TOLERANCE, cholesky, longer, unseen_mass, whiten, wrapped
from inference.object_particles import LEAST_MISS


@njit(error_model="numpy")
def seen_moments(w, seen, period, mean, S):  # type: ignore[no-untyped-def]
    """Mean (d,) and variances (d,) of what N particles predict, seen (N, d); angles about that of the heaviest."""
    d, best = len(period), w.argmax()
    for a in range(d):
        mean[a] = S[a] = 0.0
        for i in range(len(w)):
            difference = wrapped(seen[i, a] - seen[best, a], period[a])
            mean[a] += w[i] * difference
            S[a] += w[i] * difference * difference
        S[a] -= mean[a] * mean[a]
        mean[a] += seen[best, a]


@njit(cache=True, error_model="numpy")
def update(  # type: ignore[no-untyped-def]
    existence, weight, kind,
    new_offset, new_weight, new_kind, new_mean, new_P,
    predicted, slope, detection, values, noise, sort, clutter, feature, period,
    gate, max_shared,
):  # fmt: skip
    """Existence (T,) and weights (T, N) of the particles given a scan, in place, and what it shows first: existence
    (M,), the masses of the components of unseen objects (U,), (log partition, groups by belief propagation).

    Equations in inference.lmb_particles. Of particle i of object t, h is predicted[t N + i]; those of unseen objects
    follow."""
    num, count = weight.shape
    M, d = len(values), len(period)
    mass, rho = unseen_mass(
        new_offset, new_weight, new_kind, new_P, num * count,
        predicted, slope, detection, values, noise, sort, feature, period,
    )  # fmt: skip
    intensity = np.maximum(clutter + rho, 1e-100)  # of measurements that no old object made
    root, log_norm = np.empty(noise.shape), np.empty(len(noise))
    for k in range(len(noise)):
        log_norm[k] = -cholesky(noise[k], root[k]) - 0.5 * d * LOG_TAU
    mean, S, residual, y = np.empty(d), np.empty(d), np.empty(d), np.empty(d)
    table_offset, missed, entries = np.zeros(num + 1, np.int64), np.empty(num), 0
    room = 2 * num + 16
    measurement, ratio, made = np.empty(room, np.int64), np.empty(room), np.empty((room, count))
    for t in range(num):
        seen, here = 0.0, predicted[t * count : (t + 1) * count]
        for i in range(count):
            seen += weight[t, i] * detection[t * count + i]
        missed[t] = max(1.0 - existence[t] * seen, LEAST_MISS)
        if seen > 1e-9:
            seen_moments(weight[t], here, period, mean, S)
            for j in range(M):
                near, R = True, sort[j]
                for a in range(d):
                    off = wrapped(values[j, a] - mean[a], period[a])
                    near = near and off * off <= gate * (S[a] + noise[R, a, a])
                if not near:
                    continue
                if entries == len(ratio):
                    measurement, ratio, made = longer(measurement), longer(ratio), longer(made)
                total = 0.0
                for i in range(count):
                    for a in range(d):
                        residual[a] = wrapped(values[j, a] - here[i, a], period[a])
                    square = whiten(root[R], residual, y)
                    likelihood = detection[t * count + i] * feature[j, kind[t, i]] * math.exp(log_norm[R] - 0.5 * square)
                    made[entries, i] = existence[t] * weight[t, i] * likelihood / intensity[j]
                    total += made[entries, i]
                if total > 0.0:
                    measurement[entries], ratio[entries] = j, total
                    entries += 1
        table_offset[t + 1] = entries
    taken, free = np.empty(entries), np.empty(num)
    log_partition, loopy, _ = associate(
        table_offset, measurement[:entries], ratio[:entries], missed, M,
        AUTO, max_shared, TOLERANCE, MAX_ITERATIONS, 0, np.zeros(1, np.uint64), taken, free,
    )  # fmt: skip
    first = rho / intensity
    explained = np.zeros(M)
    for t in range(num):
        for i in range(count):
            weight[t, i] *= free[t] * existence[t] * (1.0 - detection[t * count + i]) / missed[t]
        for e in range(table_offset[t], table_offset[t + 1]):
            explained[measurement[e]] += taken[e]
            for i in range(count):
                weight[t, i] += taken[e] * made[e, i] / ratio[e]
        total = 0.0
        for i in range(count):
            total += weight[t, i]
        existence[t] = min(total, 1.0)
        for i in range(count):
            weight[t, i] = weight[t, i] / total if total > 0.0 else 1.0 / count
    first *= np.maximum(1.0 - explained, 0.0)
    return first, mass, (log_partition + np.log(intensity).sum(), loopy)
