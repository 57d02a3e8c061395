"""Loopy belief propagation over a group (Williams and Lau 2014), with the Bethe approximation of log Z.

Messages are odds. Row i tells column j how much it wants it, column j tells row i how free it is:

    mu_ij = weight_ij / (alone_i + sum_(k != j) weight_ik nu_ik)
    nu_ij = 1 / (unused_j + sum_(l != i) mu_lj)

and at the fixed point, which is reached from any start,

    P(i takes j) = weight_ij nu_ij / Z_i,   Z_i = alone_i + sum_k weight_ik nu_ik,   Z_j = unused_j + sum_l mu_lj
    log Z ~ sum_i log Z_i + sum_j log Z_j - sum_ij log(1 + mu_ij nu_ij)

This is exact on a group without cycles. Sums without one term are added up from both sides, never subtracted: a row
that cannot be alone is as good as certain, and the difference would be rounding error.
"""

from __future__ import annotations

import math

import numba as nb

FLOOR = 1e-150  # of weights of being alone or unused, next to weights of one: keeps messages and their products finite


@nb.njit(error_model="numpy")
def propagate(problem, tolerance, max_iterations, mu, nu, rest, sums, taken, free):  # type: ignore[no-untyped-def]
    """Fill the probabilities that an entry is taken (e,) and a row is alone (n,); (log Z, whether no probability moved
    by more than the tolerance in the last iteration). mu, nu, rest (e,) and sums (m,) are room."""
    offset, column, weight, alone, unused = problem
    n, num_entries = len(alone), len(column)
    for e in range(num_entries):
        nu[e], taken[e] = 1.0, 0.0
    converged = False
    for iteration in range(max_iterations + 1):
        moved, log_sum = 0.0, 0.0
        for i in range(n):
            total = max(alone[i], FLOOR)
            for e in range(offset[i], offset[i + 1]):
                rest[e] = total
                total += weight[e] * nu[e]
            log_sum += math.log(total)
            free[i], after = alone[i] / total, 0.0
            for e in range(offset[i + 1] - 1, offset[i] - 1, -1):
                share = weight[e] * nu[e]
                mu[e] = weight[e] / (rest[e] + after)
                after += share
                moved = max(moved, abs(share / total - taken[e]))
                taken[e] = share / total
        converged = iteration > 0 and moved < tolerance
        if converged or iteration == max_iterations:
            break
        for j in range(len(unused)):
            sums[j] = max(unused[j], FLOOR)
        for e in range(num_entries):
            rest[e] = sums[column[e]]
            sums[column[e]] += mu[e]
        for j in range(len(unused)):
            sums[j] = 0.0
        for e in range(num_entries - 1, -1, -1):
            nu[e] = 1.0 / (rest[e] + sums[column[e]])
            sums[column[e]] += mu[e]
    for j in range(len(unused)):
        sums[j] = max(unused[j], FLOOR)
    for e in range(num_entries):
        sums[column[e]] += mu[e]
        log_sum -= math.log1p(mu[e] * nu[e])
    for j in range(len(unused)):
        log_sum += math.log(sums[j])
    return log_sum, converged
