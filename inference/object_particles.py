"""Particles of objects in machine code: their moments, and draws of what a measurement tells of a Gaussian component.

A component N(m, P) that is measured as z is known by Kalman's update of h linearised at m, N(m+, P+), exactly where h
is linear. Particles are drawn from it and weighted by what the linearisation got wrong. Since

    N(x; m, P) N(z; h(m) + H (x - m), R) = N(z; h(m), H P H' + R) N(x; m+, P+)

the weight of a draw needs no density of states, only the ratio of the likelihood to the linearised one:

    w(x) = p_D(x) N(z; h(x), R) / (p_D(m) N(z; h(m) + H (x - m), R))

and that of one that was missed, drawn from N(m, P), is (1 - p_D(x)) / (1 - p_D(m)). For linear h and constant p_D all
weights are one.

Particles are regularised (Musso, Oudjane and Le Gland 2001) with the shrinkage of Liu and West (2001): they are taken
for the middles of kernels of h^2 times the covariance V of their cloud, and drawn to its mean m, so that V stays what
it is,   x ~ N(m + sqrt(1 - h^2) (x_i - m), h^2 V).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from inference.kalman_kernel import cholesky, condition, gain, innovation, room_for, whiten, wrapped

LEAST_MISS = 1e-12  # 1 - p_D is taken for no less, so that an object that cannot be missed can be


@njit(error_model="numpy")
def root_of(P, C):  # type: ignore[no-untyped-def]
    """Lower C with C C' = P, which may be singular: columns of what stands still are zero."""
    n = P.shape[0]
    for j in range(n):
        pivot = P[j, j]
        for k in range(j):
            pivot -= C[j, k] * C[j, k]
        still = not pivot > 1e-13 * P[j, j]
        C[j, j] = 0.0 if still else math.sqrt(pivot)
        for i in range(n):
            if i < j:
                C[i, j] = 0.0
            elif i > j:
                total = P[i, j]
                for k in range(j):
                    total -= C[i, k] * C[j, k]
                C[i, j] = 0.0 if still else total / C[j, j]


@njit(cache=True, error_model="numpy")
def draw(component, measurement, mean, P, predicted, slope, values, noise, sort, period, normal):  # type: ignore[no-untyped-def]
    """States (D, n) of components (D,) that are measured as measurement (D,), -1 for missed: m+ + root(P+) e, of normal
    numbers e (D, n). Component c has mean[c], P[c], predicted[c] = h, slope[c] = H."""
    num, n, d = len(component), mean.shape[1], values.shape[1]
    room, W = room_for(n, d), np.empty((d, n))
    G, _, C, _, y = room
    middle, V, root, found = np.empty(n), np.empty((n, n)), np.empty((n, n)), np.empty((num, n))
    for p in range(num):
        c, j = component[p], measurement[p]
        if p == 0 or c != component[p - 1] or j != measurement[p - 1]:
            middle[:], V[:] = mean[c], P[c]
            if j >= 0:
                innovation(P[c], slope[c], predicted[c], values[j], noise[sort[j]], period, room)
                gain(C, G, W)
                condition(mean[c], P[c], W, y, middle, V)
            root_of(V, root)
        for i in range(n):
            total = middle[i]
            for k in range(i + 1):
                total += root[i, k] * normal[p, k]
            found[p, i] = total
    return found


@njit(cache=True, error_model="numpy")
def draw_prior(component, mean, P, normal):  # type: ignore[no-untyped-def]
    """States (D, n) of components (D,) that nothing is known of but N(mean[c], P[c]), of normal numbers (D, n)."""
    num, n = normal.shape
    root, found = np.empty((n, n)), np.empty((num, n))
    for p in range(num):
        if p == 0 or component[p] != component[p - 1]:
            root_of(P[component[p]], root)
        found[p] = mean[component[p]] + root @ normal[p]
    return found


@njit(cache=True, error_model="numpy")
def log_corrections(  # type: ignore[no-untyped-def]
    state, seen, detected, component, measurement, mean, predicted, slope, detection, values, noise, sort, period
):
    """log w (D,) of states (D, n) that `draw` found, of which h is seen (D, d) and p_D detected (D,)."""
    num, n, d = len(component), mean.shape[1], values.shape[1]
    C, residual, y, found = np.empty((d, d)), np.empty(d), np.empty(d), np.empty(num)
    for p in range(num):
        c, j = component[p], measurement[p]
        if j < 0:
            found[p] = math.log(max(1.0 - detected[p], LEAST_MISS) / max(1.0 - detection[c], LEAST_MISS))
            continue
        cholesky(noise[sort[j]], C)
        for a in range(d):
            residual[a] = wrapped(values[j, a] - seen[p, a], period[a])
        square = whiten(C, residual, y)
        for a in range(d):
            residual[a] = wrapped(values[j, a] - predicted[c, a], period[a])
            for i in range(n):
                residual[a] -= slope[c, a, i] * (state[p, i] - mean[c, i])
        linear = whiten(C, residual, y)
        found[p] = math.log(detected[p] / detection[c]) - 0.5 * (square - linear)
    return found


@njit(cache=True, error_model="numpy")
def moments(group, num, weight, state, period):  # type: ignore[no-untyped-def]
    """Mean (num, n) and covariance (num, n, n) of clouds of particles: particle i is of group[i]. Angles are averaged
    as differences from their circular mean. Weights of a cloud need not sum to one; one without weight is all zero."""
    n = state.shape[1]
    total, mean, P = np.zeros(num), np.zeros((num, n)), np.zeros((num, n, n))
    centre, sine, difference = np.zeros((num, n)), np.zeros((num, n)), np.empty(n)
    for i in range(len(group)):
        g = group[i]
        total[g] += weight[i]
        for a in range(n):
            if math.isinf(period[a]):
                centre[g, a] += weight[i] * state[i, a]
            else:
                angle = 2.0 * math.pi / period[a] * state[i, a]
                sine[g, a] += weight[i] * math.sin(angle)
                centre[g, a] += weight[i] * math.cos(angle)
    for g in range(num):
        for a in range(n):
            if not math.isinf(period[a]):
                centre[g, a] = math.atan2(sine[g, a], centre[g, a]) * period[a] / (2.0 * math.pi)
            elif total[g] > 0.0:
                centre[g, a] /= total[g]
    for i in range(len(group)):
        g = group[i]
        if not total[g] > 0.0:
            continue
        share = weight[i] / total[g]
        for a in range(n):
            difference[a] = wrapped(state[i, a] - centre[g, a], period[a])
            mean[g, a] += share * difference[a]
            for b in range(a + 1):
                P[g, a, b] += share * difference[a] * difference[b]
    for g in range(num):
        for a in range(n):
            for b in range(a + 1):
                P[g, a, b] -= mean[g, a] * mean[g, b]
                P[g, b, a] = P[g, a, b]
        for a in range(n):
            mean[g, a] += centre[g, a]
    return mean, P


@njit(cache=True, error_model="numpy")
def widen(group, mean, V, period, kernel, state, P):  # type: ignore[no-untyped-def]
    """Make particles (D, n) of clouds group (D,), of mean (G, n) and covariance V (G, n, n), the middles of components
    that have the cloud's moments, in place: x <- m + sqrt(1 - h^2) (x - m),   P <- P + h^2 V,   h = kernel."""
    n, keep = state.shape[1], math.sqrt(1.0 - kernel * kernel)
    for p in range(len(group)):
        g = group[p]
        for a in range(n):
            state[p, a] = mean[g, a] + keep * wrapped(state[p, a] - mean[g, a], period[a])
            for b in range(n):
                P[p, a, b] += kernel * kernel * V[g, a, b]
