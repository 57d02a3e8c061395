"""Machine code of the labeled multi-Bernoulli filter with particles: the update by one scan."""

from __future__ import annotations

import numpy as np
from numba import njit

from inference.association_kernel import AUTO, associate
from inference.kalman_kernel import densities, project, room_for, wrapped
from inference.lmb_kernel import MAX_ITERATIONS, TOLERANCE, longer, unseen_mass
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
    existence, weight, kind, P, uniform,
    new_offset, new_weight, new_kind, new_mean, new_P,
    predicted, slope, detection, values, noise, sort, clutter, feature, period,
    gate, max_shared,
):  # fmt: skip
    """Existence (T,) given a scan, in place; which components (T, N) and which measurements of theirs (T, N), -1 for
    missed, posterior particles are to be drawn from, by uniform numbers (T,); and what the scan shows first: existence
    (M,), the masses of the components of unseen objects (U,), (log partition, groups by belief propagation).

    Equations in inference.lmb_particles. Component i of object t is number t N + i, with covariance P (T N, n, n);
    those of unseen objects follow."""
    num, count = weight.shape
    M, d, n = len(values), len(period), new_mean.shape[1]
    mass, rho = unseen_mass(
        new_offset, new_weight, new_kind, new_P, num * count,
        predicted, slope, detection, values, noise, sort, feature, period,
    )  # fmt: skip
    intensity = np.maximum(clutter + rho, 1e-100)  # of measurements that no old object made
    parts, mean, variance, density = room_for(n, d), np.empty(d), np.empty(d), np.empty(M)
    G, S = parts[:2]
    table_offset, missed, entries = np.zeros(num + 1, np.int64), np.empty(num), 0
    room = 2 * num + 16
    measurement, ratio, made = np.empty(room, np.int64), np.empty(room), np.empty((room, count))
    for t in range(num):
        seen, first, best = 0.0, t * count, t * count + weight[t].argmax()
        for i in range(count):
            seen += weight[t, i] * detection[first + i]
        missed[t] = max(1.0 - existence[t] * seen, LEAST_MISS)
        start = entries
        if seen > 1e-9:
            seen_moments(weight[t], predicted[first : first + count], period, mean, variance)
            project(P[best], slope[best], G, S)
            for j in range(M):
                inside = True
                for a in range(d):
                    off = wrapped(values[j, a] - mean[a], period[a])
                    inside = inside and off * off <= gate * (variance[a] + S[a, a] + noise[sort[j], a, a])
                if inside:
                    if entries == len(ratio):
                        measurement, ratio, made = longer(measurement), longer(ratio), longer(made)
                    measurement[entries], ratio[entries] = j, 0.0
                    entries += 1
        table_offset[t + 1] = entries
        if entries == start:
            continue
        for i in range(count):
            c, near = first + i, measurement[start:entries]
            densities(P[c], slope[c], predicted[c], values, near, noise, sort, period, np.inf, parts, density)
            for e in range(start, entries):
                j = measurement[e]
                likelihood = feature[j, kind[t, i]] * density[e - start]
                made[e, i] = existence[t] * weight[t, i] * detection[c] * likelihood / intensity[j]
                ratio[e] += made[e, i]
    taken, free = np.empty(entries), np.empty(num)
    log_partition, loopy, _ = associate(
        table_offset, measurement[:entries], ratio[:entries], missed, M,
        AUTO, max_shared, TOLERANCE, MAX_ITERATIONS, 0, np.zeros(1, np.uint64), taken, free,
    )  # fmt: skip
    component, chosen = np.empty((num, count), np.int64), np.empty((num, count), np.int64)
    explained, share = np.zeros(M), np.empty(count)
    for t in range(num):
        total = 0.0
        for i in range(count):
            share[i] = free[t] * existence[t] * weight[t, i] * (1.0 - detection[t * count + i]) / missed[t]
            total += share[i]
        for e in range(table_offset[t], table_offset[t + 1]):
            explained[measurement[e]] += taken[e]
            total += taken[e]
        made_so_far, reached, mark = 0, 0.0, uniform[t] * total / count
        for e in range(table_offset[t] - 1, table_offset[t + 1]):
            j = -1
            if e >= table_offset[t]:
                j = measurement[e]
                for i in range(count):
                    share[i] = taken[e] * made[e, i] / ratio[e] if ratio[e] > 0.0 else 0.0
            for i in range(count):
                reached += share[i]
                while made_so_far < count and mark < reached:
                    component[t, made_so_far], chosen[t, made_so_far] = t * count + i, j
                    made_so_far += 1
                    mark += total / count
        for k in range(made_so_far, count):  # rounding
            component[t, k], chosen[t, k] = (component[t, k - 1], chosen[t, k - 1]) if k else (t * count, -1)
        existence[t] = min(total, 1.0)
    first_existence = np.maximum(1.0 - explained, 0.0) * rho / intensity
    return component, chosen, first_existence, mass, (log_partition + np.log(intensity).sum(), loopy)
