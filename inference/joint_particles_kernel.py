"""Machine code of the joint particle filter: the associations of each particle's objects."""

from __future__ import annotations

import numpy as np
from numba import njit

from inference.association_kernel import AUTO, MISSED, associate, choose
from inference.association_random import uniform
from inference.lmb_kernel import MAX_ITERATIONS, TOLERANCE, densities, longer, room_for, unseen_mass
from inference.object_particles import LEAST_MISS


@njit(cache=True, error_model="numpy")
def weigh(  # type: ignore[no-untyped-def]
    start, order, kind, survival, P,
    new_offset, new_weight, new_kind, new_mean, new_P,
    predicted, slope, detection, values, noise, sort, clutter, feature, period,
    gate, max_shared,
):  # fmt: skip
    """Association tables of N particles, and what they are worth: particle n has the objects order[start[n]] ...
    order[start[n + 1] - 1], components with covariances P (R, n, n) that are alive with survival (R,).

    Returns (table: offset (R + 1,) in that order, measurement, ratio, missed (R,)), log p(Z | particle) (N,) but for
    the expected number of detections, masses of the components of unseen objects (U,), the share rho / kappa of these
    in what no old object made (M,), and groups by belief propagation."""
    rows, num, M, d, n = len(order), len(start) - 1, len(values), len(period), new_mean.shape[1]
    mass, rho = unseen_mass(
        new_offset, new_weight, new_kind, new_P, rows,
        predicted, slope, detection, values, noise, sort, feature, period,
    )  # fmt: skip
    intensity = np.maximum(clutter + rho, 1e-100)
    room, density, every = room_for(n, d), np.empty(M), np.arange(M)
    offset, missed, entries, loopy = np.zeros(rows + 1, np.int64), np.empty(rows), 0, 0
    measurement, ratio = np.empty(2 * rows + 16, np.int64), np.empty(2 * rows + 16)
    log_seen = np.full(num, np.log(intensity).sum())
    for k in range(rows):
        c = order[k]
        alive = survival[c] * detection[c]
        missed[k] = max(1.0 - alive, LEAST_MISS)
        if alive > 1e-9:
            densities(P[c], slope[c], predicted[c], values, every, noise, sort, period, gate, room, density)
            for j in range(M):
                if density[j] == 0.0:
                    continue
                if entries == len(ratio):
                    measurement, ratio = longer(measurement), longer(ratio)
                measurement[entries] = j
                ratio[entries] = alive * feature[j, kind[c]] * density[j] / intensity[j]
                entries += 1
        offset[k + 1] = entries
    taken, free, random = np.empty(entries), np.empty(rows), np.zeros(1, np.uint64)
    for i in range(num):
        a, b = start[i], start[i + 1]
        if a == b:
            continue
        first, last = offset[a], offset[b]
        log_sum, groups, _ = associate(
            offset[a : b + 1] - first, measurement[first:last], ratio[first:last], missed[a:b], M,
            AUTO, max_shared, TOLERANCE, MAX_ITERATIONS, 0, random, taken[first:last], free[a:b],
        )  # fmt: skip
        log_seen[i] += log_sum
        loopy += groups
    return (offset, measurement[:entries], ratio[:entries], missed), log_seen, mass, rho / intensity, loopy


@njit(cache=True, error_model="numpy")
def associations(start, table, parent, new_offset, mass, share, max_shared, num_sweeps, random):  # type: ignore[no-untyped-def]
    """Draw an association for each of N particles, copies of parent (N,), which rises: for each object of each (C,) the
    particle, the place in the order of the table and the measurement or MISSED; and of those that a measurement
    begins (B,) the particle, the measurement and the component of unseen objects."""
    offset, measurement, ratio, missed = table
    num, M, count = len(parent), len(share), 0
    for i in range(num):
        count += start[parent[i] + 1] - start[parent[i]]
    whose, place, made = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    new_whose, new_made, new_part = np.empty(16, np.int64), np.empty(16, np.int64), np.empty(16, np.int64)
    taken, at, born, i = np.empty(M, np.bool_), 0, 0, 0
    while i < num:
        copies = 1
        while i + copies < num and parent[i + copies] == parent[i]:
            copies += 1
        a, b = start[parent[i]], start[parent[i] + 1]
        first, last, theta = offset[a], offset[b], np.empty((copies, b - a), np.int64)
        if b > a:
            choose(
                offset[a : b + 1] - first, measurement[first:last], ratio[first:last], missed[a:b], M,
                max_shared, num_sweeps, random, True, theta,
            )  # fmt: skip
        for k in range(copies):
            taken[:] = False
            for t in range(b - a):
                whose[at], place[at], made[at] = i + k, a + t, max(theta[k, t], MISSED)
                if theta[k, t] >= 0:
                    taken[theta[k, t]] = True
                at += 1
            for j in range(M):
                if taken[j] or not uniform(random) < share[j]:
                    continue
                total = 0.0
                for u in range(new_offset[j], new_offset[j + 1]):
                    total += mass[u]
                mark, u = uniform(random) * total, new_offset[j]
                while u < new_offset[j + 1] - 1 and mark >= mass[u]:
                    mark -= mass[u]
                    u += 1
                if born == len(new_whose):
                    new_whose, new_made, new_part = longer(new_whose), longer(new_made), longer(new_part)
                new_whose[born], new_made[born], new_part[born] = i + k, j, u
                born += 1
        i += copies
    return whose, place, made, new_whose[:born], new_made[:born], new_part[:born]
