"""Machine code of tracks whose measurements are given: Kalman's update by them, and what others would weigh.

Arrays are those of models.multi_object and of inference.lmb_kernel; the mathematics is that of inference.kalman_kernel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from inference.kalman_kernel import LOG_TAU, condition, densities, gain, innovation, room_for


@njit(cache=True, error_model="numpy")
def see(  # type: ignore[no-untyped-def]
    offset, weight, kind, mean, P, chosen,
    predicted, slope, detection, values, noise, sort, clutter, feature, period, gate,
):  # fmt: skip
    """Condition each group t of components, in place, on its measurement j = chosen[t], or on being missed (-1).

    Returns what it weighs (T,), beside which weights sum to one:

        sum_c w_c p_D,c N(z_j; h_c, H_c P_c H_c' + R_j) feature_j(kind_c),   or   sum_c w_c (1 - p_D,c)

    A component to which the measurement is farther than the gate (squared Mahalanobis distance) has none."""
    n, d = mean.shape[1], slope.shape[1]
    room, W, factor = room_for(n, d), np.empty((d, n)), np.zeros(len(chosen))
    G, _, C, _, y = room
    for t in range(len(chosen)):
        j = chosen[t]
        for c in range(offset[t], offset[t + 1]):
            if j < 0:
                weight[c] *= 1.0 - detection[c]
            else:
                square, log_det = innovation(P[c], slope[c], predicted[c], values[j], noise[sort[j]], period, room)
                if square > gate:
                    weight[c] = 0.0
                else:
                    weight[c] *= detection[c] * feature[j, kind[c]] * math.exp(-log_det - 0.5 * (square + d * LOG_TAU))
                    gain(C, G, W)
                    condition(mean[c], P[c], W, y, mean[c], P[c])  # each entry is read before it is written
            factor[t] += weight[c]
        if factor[t] > 0.0:
            for c in range(offset[t], offset[t + 1]):
                weight[c] /= factor[t]
    return factor


@njit(cache=True, error_model="numpy")
def weights_of(  # type: ignore[no-untyped-def]
    offset, weight, kind, P, predicted, slope, detection, values, noise, sort, clutter, feature, period, gate
):
    """(T, M) what each group would weigh with each measurement: `see`, of all pairs."""
    num, M, room = len(offset) - 1, len(values), room_for(slope.shape[2], slope.shape[1])
    found, density, every = np.zeros((num, M)), np.empty(M), np.arange(M)
    for t in range(num):
        for c in range(offset[t], offset[t + 1]):
            densities(P[c], slope[c], predicted[c], values, every, noise, sort, period, gate, room, density)
            for j in range(M):
                if density[j] > 0.0:
                    found[t, j] += weight[c] * detection[c] * feature[j, kind[c]] * density[j]
    return found
