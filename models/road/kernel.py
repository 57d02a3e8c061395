"""The density of all cues in machine code: group by group, with its gradient, and as normal equations.

Everything is computed in the numbers of the clothoid. What comes from C passes through the Hermite fit first
(`slopes_in_course`); engines run on the whitened numbers of models.road.numbers. Groups share an offset, so that the
log density is one factor of the course and a sum over groups g of f_g(theta, o_g). Where there is no sane clothoid
every factor is NO_ROAD: low enough for any engine to leave it, and finite, so that none breaks.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.clothoid_kernel import COLUMNS, COS, LENGTH, SIN, hermite_one, sample_one
from models.road.course_slopes import hermite_slopes, moments, sample_row
from models.road.cue_kernel import LOCAL, LOG_ROOT, RESIDUALS, find_samples, score_cue, score_groups
from models.road.numbers import affine, course_density

NO_ROAD = -1e9  # [nats]


@nb.njit(error_model="numpy")
def correction(x, mean, tril, root_mean, root, theta, gradient, hessian):  # type: ignore[no-untyped-def]
    """theta (6,) of x and the factor of the course, log N(C; ..) + log |dC / dx| - log N(x; 0, 1); -inf for no road."""
    affine(x, mean, tril, theta)
    height = course_density(theta, root_mean, root, gradient, hessian)
    for i in range(6):
        height += math.log(tril[i, i]) + 0.5 * x[i] * x[i] + LOG_ROOT
    return height


@nb.njit(cache=True, error_model="numpy")
def group_densities(x, course, num, paper, cues, group, loc, std, out):  # type: ignore[no-untyped-def]
    """Factors, out (S, 1 + G): of the course, then log densities of the groups, at whitened numbers x (S, 6 + G).

    course  (mean, tril) of theta and (mean, root) of C, as in models.road.numbers
    num     of samples of the course
    paper   whether as printed
    cues    (N, WIDTH) as in models.road.cue_kernel, group (N,) of each
    loc, std  (G,) of the offsets"""
    theta, table, near = np.empty(6), np.empty((num, COLUMNS)), np.empty(len(cues), np.int64)
    none, empty, offset, changes = np.empty(0), np.empty((0, 0)), np.empty(len(loc)), np.empty(len(loc))
    for i in range(len(x)):
        height = correction(x[i], *course, theta, none, empty)  # type: ignore[call-arg]
        if height == -np.inf:
            out[i] = NO_ROAD
            continue
        for g in range(len(loc)):
            offset[g] = loc[g] + std[g] * x[i, 6 + g]
        find_samples(cues, table, sample_one(theta, table), near)
        out[i, 0] = height
        score_groups(paper, cues, group, near, offset, table, out[i, 1:], changes)


@nb.njit(error_model="numpy")
def linearise(theta, offset, num, paper, cues, group, gradient, hessian):  # type: ignore[no-untyped-def]
    """Log density of all cues beside the clothoid theta (6,) at offsets (G,) [m]; its gradient (6 + G,) in both and,
    unless empty, minus its expected second derivatives (6 + G, 6 + G), of which the lower half is filled."""
    full, groups, num_cues = len(hessian) > 0, len(offset), len(cues)
    table, moment, near = np.empty((num, COLUMNS)), np.empty((num, 4)), np.empty(num_cues, np.int64)
    rows, weights = np.empty((2, num_cues, RESIDUALS, LOCAL)), np.empty((2, num_cues))
    height, changes, local, row = np.empty(groups), np.empty(groups), np.empty(LOCAL), np.empty(6)
    step = sample_one(theta, table)
    moments(table, step, moment)
    find_samples(cues, table, step, near)
    score_groups(paper, cues, group, near, offset, table, height, changes, rows, weights)
    gradient[:] = 0.0
    hessian[:] = 0.0
    for n in range(num_cues):
        k, g = near[n], group[n]
        c, s = table[k, COS], table[k, SIN]
        dx, dy = cues[n, 0] - table[k, 0], cues[n, 1] - table[k, 1]
        along, across = dx * c + dy * s, dy * c - dx * s
        local[:] = 0.0  # the gradient in the local numbers
        for leaves in range(2 if changes[g] > 0.0 else 1):
            weight = weights[leaves, n]
            for r in range(RESIDUALS):
                part = rows[leaves, n, r]
                for j in range(1, LOCAL):
                    local[j] -= weight * part[0] * part[j]
                if full:
                    chain(part, c, s, along, across, k, theta, table, moment, row)
                    add_square(weight, row, part[5], 6 + g, hessian)
        chain(local, c, s, along, across, k, theta, table, moment, row)
        gradient[6 + g] += local[5]
        for i in range(6):
            gradient[i] += row[i]
    return height.sum()


@nb.njit(error_model="numpy")
def chain(local, c, s, along, across, k, theta, table, moment, row):  # type: ignore[no-untyped-def]
    """Slopes in the local numbers of a cue about sample k, local (LOCAL,), become slopes in theta, row (6,)."""
    u, v = local[1], local[2]
    turn = local[3] + u * across - v * along
    sample_row(v * s - u * c, -u * s - v * c, turn, local[4], k, theta, table, moment, row)
    row[LENGTH] += local[6] * k / (len(table) - 1.0)


@nb.njit(error_model="numpy")
def add_square(weight, row, by_offset, o, hessian):  # type: ignore[no-untyped-def]
    """weight J J^T of one residual, J = row (6,) in the course and `by_offset` in number o, to the lower half."""
    hessian[o, o] += weight * by_offset**2
    for i in range(6):
        hessian[o, i] += weight * by_offset * row[i]
        for j in range(i + 1):
            hessian[i, j] += weight * row[i] * row[j]


@nb.njit(error_model="numpy")
def whiten(tril, gradient, hessian):  # type: ignore[no-untyped-def]
    """Gradient (6 + G,) and the lower half of a Hessian (6 + G, 6 + G) in theta become those in x, in place."""
    left = np.empty(6)
    for j in range(6):
        total = 0.0
        for i in range(j, 6):
            total += tril[i, j] * gradient[i]
        gradient[j] = total  # what comes later reads later numbers only
    if len(hessian) == 0:
        return
    half = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            half[i, j] = 0.0
            for m in range(j, 6):
                half[i, j] += (hessian[i, m] if m <= i else hessian[m, i]) * tril[m, j]
    for i in range(6):
        for j in range(i + 1):
            hessian[i, j] = 0.0
            for m in range(i, 6):
                hessian[i, j] += tril[m, i] * half[m, j]
    for o in range(6, len(hessian)):
        for j in range(6):
            left[j] = 0.0
            for m in range(j, 6):
                left[j] += hessian[o, m] * tril[m, j]
        hessian[o, :6] = left


@nb.njit(error_model="numpy")
def whitened_slopes(x, offset, course, num, paper, cues, group, gradient, hessian):  # type: ignore[no-untyped-def]
    """All factors together at whitened x (6,) of the course and offsets (G,) [m]: their sum, its gradient (6 + G,) in
    these and, unless empty, the lower half of minus its second derivatives, after Gauss and Newton."""
    theta, by_course = np.empty(6), np.empty(6)
    square = np.empty((6, 6)) if len(hessian) > 0 else np.empty((0, 0))
    height = correction(x, *course, theta, by_course, square)  # type: ignore[call-arg]
    if height == -np.inf:
        gradient[:] = 0.0
        hessian[:] = 0.0
        return (1 + len(offset)) * NO_ROAD
    height += linearise(theta, offset, num, paper, cues, group, gradient, hessian)
    for i in range(6):
        gradient[i] += by_course[i]
        if len(hessian) > 0:
            for j in range(i + 1):
                hessian[i, j] += square[i, j]
    whiten(course[1], gradient, hessian)
    for i in range(6):
        gradient[i] += x[i]
        if len(hessian) > 0:
            hessian[i, i] -= 1.0
    return height


@nb.njit(cache=True, error_model="numpy")
def density_slopes(x, course, num, paper, cues, group, loc, std, height, gradient):  # type: ignore[no-untyped-def]
    """Log density of the factors, height (S,), and its gradient (S, 6 + G) at whitened numbers x (S, 6 + G)."""
    empty, offset = np.empty((0, 0)), np.empty(len(loc))
    for i in range(len(x)):
        for g in range(len(loc)):
            offset[g] = loc[g] + std[g] * x[i, 6 + g]
        height[i] = whitened_slopes(x[i, :6], offset, course, num, paper, cues, group, gradient[i], empty)
        for g in range(len(loc)):
            gradient[i, 6 + g] *= std[g]


@nb.njit(cache=True, error_model="numpy")
def normal_equations(z, course, num, paper, cues, group, hessian, gradient):  # type: ignore[no-untyped-def]
    """Minus the factors at z (6 + G,), whitened course and offsets [m], its gradient (6 + G,) and the lower half of its
    Gauss-Newton Hessian (6 + G, 6 + G)."""
    cost = -whitened_slopes(z[:6], z[6:], course, num, paper, cues, group, gradient, hessian)
    for j in range(len(z)):
        gradient[j] = -gradient[j]
    return cost


@nb.njit(cache=True, error_model="numpy")
def slopes_in_course(z, num, paper, cues, group, height, gradient):  # type: ignore[no-untyped-def]
    """Log density of the cues, height (S,), and its gradient (S, 6 + G) at courses C and offsets [m], z (S, 6 + G)."""
    theta, fit, empty = np.empty(6), np.empty((3, 6)), np.empty((0, 0))
    for s in range(len(z)):
        c, slope = z[s], gradient[s]
        hermite_one(c[0], c[1], c[2], c[3], c[4], c[5], theta)
        if theta[LENGTH] == np.inf:
            slope[:] = 0.0
            height[s] = (len(c) - 6) * NO_ROAD
            continue
        height[s] = linearise(theta, c[6:], num, paper, cues, group, slope, empty)
        hermite_slopes(c[:6], theta, fit)
        shape = slope[3:6].copy()
        slope[3:6] = 0.0  # the start of the clothoid is that of the course
        for j in range(6):
            for i in range(3):
                slope[j] += fit[i, j] * shape[i]


@nb.njit(cache=True, error_model="numpy")
def explain(z, num, paper, cues, group, out):  # type: ignore[no-untyped-def]
    """Of every cue its lateral residual and its residual in direction, both in standard deviations, and the probability
    that it follows the road, out (N, 3), at a course C and offsets [m], z (6 + G,)."""
    theta, table, rows = np.empty(6), np.empty((num, COLUMNS)), np.empty((RESIDUALS, LOCAL))
    hermite_one(z[0], z[1], z[2], z[3], z[4], z[5], theta)
    if theta[LENGTH] == np.inf:
        out[:] = np.nan
        return
    groups = len(z) - 6
    near, height, changes = np.empty(len(cues), np.int64), np.empty(groups), np.empty(groups)
    find_samples(cues, table, sample_one(theta, table), near)
    score_groups(paper, cues, group, near, z[6:], table, height, changes)
    for n in range(len(cues)):
        weight = score_cue(paper, cues, n, z[6 + group[n]], table, near[n], rows)[1]
        out[n, 0], out[n, 1] = rows[1 if paper else 0, 0], rows[2, 0]
        out[n, 2] = (1.0 - changes[group[n]]) * weight
