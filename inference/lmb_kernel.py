"""Machine code of the labeled multi-Bernoulli filter with Gaussian mixtures: prediction, and the update by one scan.

Arrays are those of models.multi_object: components c of track t stand at offset[t] ... offset[t + 1].
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from inference.association_kernel import AUTO, associate
from inference.kalman_kernel import LOG_TAU, cholesky, condition, gain, innovation, project, room_for, whiten, wrapped

TOLERANCE, MAX_ITERATIONS = 1e-6, 200  # of belief propagation in large groups
FIRST = 0.1  # newcomers are kept at this share of `faint`: nothing can have confirmed them yet
NO_KIND = 1e-9  # share of an object below which it is not of a kind
SMALL = 1e-12  # posterior components of less weight are left out before anything is computed of them


@njit(cache=True, error_model="numpy")
def propagate(offset, existence, weight, covariance, slope, noise, survival):  # type: ignore[no-untyped-def]
    """P <- F P F' + L L' in place, and what survival leaves of existence and weights."""
    num, n, m = noise.shape
    half, full = np.empty((n, n)), np.empty((n, n))
    for c in range(num):
        P, F, L = covariance[c], slope[c], noise[c]
        for i in range(n):
            for j in range(n):
                half[i, j] = 0.0
            for k in range(n):
                if F[i, k] != 0.0:  # most entries are: motion moves few
                    for j in range(n):
                        half[i, j] += F[i, k] * P[k, j]
        for i in range(n):
            for j in range(i + 1):
                total = 0.0
                for k in range(n):
                    total += half[i, k] * F[j, k]
                for k in range(m):
                    total += L[i, k] * L[j, k]
                full[i, j] = total
        for i in range(n):
            for j in range(i + 1):
                P[i, j] = P[j, i] = full[i, j]
    survive(offset, existence, weight, survival)


@njit(cache=True, error_model="numpy")
def survive(offset, existence, weight, survival):  # type: ignore[no-untyped-def]
    """What survival leaves of existence and weights, in place:

    r <- r sum_c w_c s_c,   w_c <- w_c s_c / sum"""
    for t in range(len(existence)):
        total = 0.0
        for c in range(offset[t], offset[t + 1]):
            weight[c] *= survival[c]
            total += weight[c]
        existence[t] *= total
        for c in range(offset[t], offset[t + 1]):
            weight[c] /= total


@njit(error_model="numpy")
def reduce(count, w, kind, num_kinds, mean, P, period, least, merge, most, first, out_w, out_kind, out_mean, out_P):  # type: ignore[no-untyped-def]
    """Reduce a mixture of `count` components to few, written from `first` on, weights summing to one; how many.

    Of each kind, the heaviest takes in all within `merge` of it (squared Mahalanobis distance, its own covariance), by
    moments; and so on with the rest, until `most` are there or what is left is lighter than `least` of all. But the
    first component of a kind stays unless the kind has as good as no weight: what an object is may show late."""
    n = mean.shape[1]
    C, difference, y, centre = np.empty((n, n)), np.empty(n), np.empty(n), np.empty(n)
    total = 0.0
    for i in range(count):
        total += w[i]
    at, kept = first, 0.0
    for own in range(num_kinds):
        start = at
        while at - start < most:
            heaviest, most_weight = -1, (NO_KIND if at == start else least) * total
            for i in range(count):
                if kind[i] == own and w[i] > most_weight:
                    heaviest, most_weight = i, w[i]
            if heaviest < 0:
                break
            cholesky(P[heaviest], C)
            out_w[at], out_kind[at] = 0.0, own
            for i in range(n):
                centre[i] = mean[heaviest, i]
                out_mean[at, i] = 0.0
                for j in range(n):
                    out_P[at, i, j] = 0.0
            for k in range(count):
                if w[k] <= 0.0 or kind[k] != own:
                    continue
                for i in range(n):
                    difference[i] = wrapped(mean[k, i] - centre[i], period[i])
                if k != heaviest and not whiten(C, difference, y) <= merge:
                    continue
                out_w[at] += w[k]
                for i in range(n):
                    out_mean[at, i] += w[k] * difference[i]
                    for j in range(i + 1):
                        out_P[at, i, j] += w[k] * (P[k, i, j] + difference[i] * difference[j])
                w[k] = 0.0
            for i in range(n):
                out_mean[at, i] /= out_w[at]
            for i in range(n):
                for j in range(i + 1):
                    value = out_P[at, i, j] / out_w[at] - out_mean[at, i] * out_mean[at, j]
                    out_P[at, i, j] = out_P[at, j, i] = value
            for i in range(n):
                out_mean[at, i] += centre[i]
            kept += out_w[at]
            at += 1
    for i in range(first, at):
        out_w[i] /= kept
    return at - first


@njit(error_model="numpy")
def longer(array):  # type: ignore[no-untyped-def]
    """The array with room for twice as much."""
    found = np.empty((2 * array.shape[0], *array.shape[1:]), array.dtype)
    found[: array.shape[0]] = array
    return found


@njit(error_model="numpy")
def unseen_mass(offset, weight, kind, P, first, predicted, slope, detection, values, noise, sort, feature, period):  # type: ignore[no-untyped-def]
    """What unseen objects make of each measurement, component by component:

    mass_u = weight_u p_D N(z_j; h, H P H' + R) feature_j(kind),   rho_j = sum_u mass_u"""
    d, n = slope.shape[1], slope.shape[2]
    mass, rho, room = np.zeros(len(weight)), np.zeros(len(values)), room_for(n, d)
    for j in range(len(values)):
        for u in range(offset[j], offset[j + 1]):
            i = first + u
            square, log_det = innovation(P[u], slope[i], predicted[i], values[j], noise[sort[j]], period, room)
            mass[u] = weight[u] * detection[i] * feature[j, kind[u]] * math.exp(-log_det - 0.5 * (square + d * LOG_TAU))
            rho[j] += mass[u]
    return mass, rho


@njit(cache=True, error_model="numpy")
def update(  # type: ignore[no-untyped-def]
    existence, offset, weight, kind, mean, P,
    new_offset, new_weight, new_kind, new_mean, new_P,
    predicted, slope, detection, values, noise, sort, clutter, feature, period,
    state_period, gate, least, merge, most, faint, max_shared,
):  # fmt: skip
    """The posterior of T objects given a scan, with those that it shows first; equations in inference.lmb.

    Returns (source, measurement, existence, offset, weight, kind, mean, P, facts): source (T',) is the old object, or
    -1 - j for one that measurement j shows first; measurement (T',) the one that most probably is of it, -1 where it
    was more probably missed; facts = (log partition, groups by belief propagation, existence left out)."""
    num, count, n, d, M = len(existence), len(weight), mean.shape[1], slope.shape[1], len(values)
    num_kinds = feature.shape[1]
    mass, rho = unseen_mass(
        new_offset, new_weight, new_kind, new_P, count,
        predicted, slope, detection, values, noise, sort, feature, period,
    )  # fmt: skip
    intensity = np.maximum(clutter + rho, 1e-100)  # of measurements that no old object made
    parts, base = room_for(n, d), np.empty((d, d))
    G, S, C, residual, y = parts
    # pairs of a component and a measurement within its gate; those of one component and one R share their gain
    room = 2 * count + 16
    pair_component, pair_gain, pair_entry = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64)
    pair_share, pair_y = np.empty(room), np.empty((room, d))
    gains, num_gains, pairs = np.empty((count + 16, d, n)), 0, 0
    pair_offset = np.zeros(num + 1, np.int64)
    # the association table
    table_offset, missed, entries = np.zeros(num + 1, np.int64), np.empty(num), 0
    measurement, ratio = np.empty(room, np.int64), np.empty(room)
    entry_of = np.full(M, -1, np.int64)
    for t in range(num):
        seen, first_entry = 0.0, entries
        for c in range(offset[t], offset[t + 1]):
            seen += weight[c] * detection[c]
            if detection[c] < 1e-9:
                continue
            project(P[c], slope[c], G, base)
            solved, log_det = -1, 0.0
            for j in range(M):
                R, near = noise[sort[j]], True
                for a in range(d):
                    residual[a] = wrapped(values[j, a] - predicted[c, a], period[a])
                    if residual[a] * residual[a] > gate * (base[a, a] + R[a, a]):
                        near = False
                        break
                if not near:
                    continue
                if solved != sort[j]:
                    solved = sort[j]
                    for a in range(d):
                        for b in range(d):
                            S[a, b] = base[a, b] + R[a, b]
                    log_det = cholesky(S, C)
                    if num_gains == len(gains):
                        gains = longer(gains)
                    gain(C, G, gains[num_gains])
                    num_gains += 1
                square = whiten(C, residual, y)
                if square > gate:
                    continue
                if pairs == len(pair_component):
                    pair_component, pair_gain, pair_entry = (
                        longer(pair_component),
                        longer(pair_gain),
                        longer(pair_entry),
                    )
                    pair_share, pair_y = longer(pair_share), longer(pair_y)
                if entries == len(ratio):
                    measurement, ratio = longer(measurement), longer(ratio)
                e = entry_of[j]
                if e < first_entry:
                    e = entry_of[j] = entries
                    measurement[e], ratio[e] = j, 0.0
                    entries += 1
                likelihood = feature[j, kind[c]] * math.exp(-log_det - 0.5 * (square + d * LOG_TAU))
                share = existence[t] * weight[c] * detection[c] * likelihood / intensity[j]
                ratio[e] += share
                pair_component[pairs], pair_gain[pairs], pair_entry[pairs] = c, num_gains - 1, e
                pair_share[pairs] = share
                for a in range(d):
                    pair_y[pairs, a] = y[a]
                pairs += 1
        table_offset[t + 1], pair_offset[t + 1] = entries, pairs
        missed[t] = max(1.0 - existence[t] * seen, 1e-12)
    taken, free = np.empty(entries), np.empty(num)
    log_partition, loopy, _ = associate(
        table_offset, measurement[:entries], ratio[:entries], missed, M,
        AUTO, max_shared, TOLERANCE, MAX_ITERATIONS, 0, np.zeros(1, np.uint64), taken, free,
    )  # fmt: skip
    explained = np.zeros(M)
    for e in range(entries):
        explained[measurement[e]] += taken[e]

    born, fresh = 0, np.empty(M, np.int64)
    left_out = 0.0
    first_existence = np.empty(M)
    for j in range(M):
        first_existence[j] = max(1.0 - explained[j], 0.0) * rho[j] / intensity[j]
        if first_existence[j] > FIRST * faint:
            fresh[born] = j
            born += 1
        else:
            left_out += first_existence[j]

    widest = 1
    for t in range(num):
        widest = max(widest, offset[t + 1] - offset[t] + pair_offset[t + 1] - pair_offset[t])
    for b in range(born):
        widest = max(widest, new_offset[fresh[b] + 1] - new_offset[fresh[b]])
    w, k, m, V = np.empty(widest), np.empty(widest, np.int64), np.empty((widest, n)), np.empty((widest, n, n))
    source, shown, out_existence = np.empty(num + born, np.int64), np.empty(num + born, np.int64), np.empty(num + born)
    out_offset, room = np.zeros(num + born + 1, np.int64), (num + born) * most * num_kinds
    out_w, out_kind, out_mean, out_P = (
        np.empty(room), np.empty(room, np.int64), np.empty((room, n)), np.empty((room, n, n))
    )  # fmt: skip
    made, at = 0, 0
    for t in range(num):
        have, total, missing = 0, 0.0, 0.0
        for c in range(offset[t], offset[t + 1]):
            value = free[t] * existence[t] * weight[c] * (1.0 - detection[c]) / missed[t]
            missing += value
            if value > SMALL:
                w[have], k[have] = value, kind[c]
                m[have], V[have] = mean[c], P[c]
                have += 1
        total = missing
        for p in range(pair_offset[t], pair_offset[t + 1]):
            e, c = pair_entry[p], pair_component[p]
            value = taken[e] * pair_share[p] / ratio[e] if ratio[e] > 0.0 else 0.0
            total += value
            if value > SMALL:
                w[have], k[have] = value, kind[c]
                condition(mean[c], P[c], gains[pair_gain[p]], pair_y[p], m[have], V[have])
                have += 1
        if have == 0 or not total > faint:
            left_out += total
            continue
        at += reduce(
            have, w, k, num_kinds, m, V, state_period, least, merge, most, at, out_w, out_kind, out_mean, out_P
        )
        source[made], out_existence[made], out_offset[made + 1] = t, min(total, 1.0), at
        shown[made], surest = -1, missing
        for e in range(table_offset[t], table_offset[t + 1]):
            if taken[e] > surest:
                shown[made], surest = measurement[e], taken[e]
        made += 1
    W = np.empty((d, n))
    for b in range(born):
        j, have = fresh[b], 0
        for u in range(new_offset[j], new_offset[j + 1]):
            if mass[u] < SMALL * rho[j]:
                continue
            i = count + u
            innovation(new_P[u], slope[i], predicted[i], values[j], noise[sort[j]], period, parts)
            gain(C, G, W)
            w[have], k[have] = mass[u] / rho[j], new_kind[u]
            condition(new_mean[u], new_P[u], W, y, m[have], V[have])
            have += 1
        at += reduce(
            have, w, k, num_kinds, m, V, state_period, least, merge, most, at, out_w, out_kind, out_mean, out_P
        )
        source[made], out_existence[made], out_offset[made + 1] = -1 - j, first_existence[j], at
        shown[made] = j
        made += 1
    facts = (log_partition + np.log(intensity).sum(), loopy, left_out)
    return (
        source[:made], shown[:made], out_existence[:made], out_offset[: made + 1],
        out_w[:at].copy(), out_kind[:at].copy(), out_mean[:at].copy(), out_P[:at].copy(), facts,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def heaviest(offset, weight, kind, mean, P, num_kinds):  # type: ignore[no-untyped-def]
    """Of each object, mean (T, n) and covariance (T, n, n) of its heaviest component, kind probabilities (T, C)."""
    num, n = len(offset) - 1, mean.shape[1]
    out_mean, out_P, out_kind = np.empty((num, n)), np.empty((num, n, n)), np.zeros((num, num_kinds))
    for t in range(num):
        best = offset[t]
        for c in range(offset[t], offset[t + 1]):
            out_kind[t, kind[c]] += weight[c]
            if weight[c] > weight[best]:
                best = c
        out_mean[t], out_P[t] = mean[best], P[best]
    return out_mean, out_P, out_kind
