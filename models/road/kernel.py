"""The density of all cues in machine code: group by group, with its gradient, and as normal equations.

Numbers of the course are whitened, C = mean + tril x; offsets are in metres here. Groups share an offset, so that the
log density is a sum over groups g of f_g(x, o_g). A course that no sane clothoid joins has NO_ROAD in every group: low
enough for any engine to leave it, and finite, so that none breaks.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from models.clothoid_kernel import COLUMNS, COS, LENGTH, SIN, hermite_one, sample_one
from models.road.course_slopes import hermite_slopes, moments, sample_row
from models.road.cue_kernel import nearest_sample, score_cue

NO_ROAD = -1e9  # [nats]


@nb.njit(error_model="numpy")
def lay_course(z, mean, tril, course, clothoid, table):  # type: ignore[no-untyped-def]
    """Course (6,), clothoid (6,) and samples of the whitened numbers z[:6]; returns their step, inf for no road."""
    for i in range(6):
        course[i] = mean[i]
        for j in range(i + 1):
            course[i] += tril[i, j] * z[j]
    hermite_one(course[0], course[1], course[2], course[3], course[4], course[5], clothoid)
    return sample_one(clothoid, table) if clothoid[LENGTH] < np.inf else np.inf


@nb.njit(cache=True, error_model="numpy")
def group_densities(x, mean, tril, num, paper, cues, group, loc, std, out):  # type: ignore[no-untyped-def]
    """Log densities of the groups, out (S, G), at whitened numbers x (S, 6 + G).

    num    of samples of the course
    paper  whether as printed
    cues   (N, WIDTH) as in models.road.cue_kernel, group (N,) of each
    loc, std  (G,) of the offsets"""
    course, clothoid, table, rows = np.empty(6), np.empty(6), np.empty((num, COLUMNS)), np.empty((0, 6))
    for i in range(len(x)):
        step = lay_course(x[i], mean, tril, course, clothoid, table)
        for g in range(len(loc)):
            out[i, g] = 0.0 if step < np.inf else NO_ROAD
        if step == np.inf:
            continue
        for n in range(len(cues)):
            g, k = group[n], nearest_sample(cues, n, table, step)
            offset = loc[g] + std[g] * x[i, 6 + g]
            out[i, g] += score_cue(paper, cues, n, offset, table, k, rows)[0]


@nb.njit(error_model="numpy")
def linearise(z, mean, tril, num, paper, cues, group, gradient, hessian):  # type: ignore[no-untyped-def]
    """Log density of all cues at z (6 + G,), whitened course and offsets [m]; its gradient (6 + G,) and, unless empty,
    minus its expected second derivatives (6 + G, 6 + G)."""
    size, full = len(z), len(hessian) > 0
    course, clothoid, table, rows = np.empty(6), np.empty(6), np.empty((num, COLUMNS)), np.empty((3, 6))
    gradient[:] = 0.0
    hessian[:] = 0.0
    step = lay_course(z, mean, tril, course, clothoid, table)
    if step == np.inf:
        return (size - 6) * NO_ROAD
    moment, row = np.empty((num, 4)), np.empty(6)
    moments(table, step, moment)
    by_shape, square = np.zeros(6), np.zeros((6, 6))  # in the clothoid's numbers
    mixed, total = np.zeros((size, 6)), 0.0
    for n in range(len(cues)):
        k, o = nearest_sample(cues, n, table, step), 6 + group[n]
        log_density, weight = score_cue(paper, cues, n, z[o], table, k, rows)
        total += log_density
        c, s = table[k, COS], table[k, SIN]
        dx, dy = cues[n, 0] - table[k, 0], cues[n, 1] - table[k, 1]
        along, across = dx * c + dy * s, dy * c - dx * s
        for r in range(3):
            residual, u, v, by_offset = rows[r, 0], rows[r, 1], rows[r, 2], rows[r, 5]
            turn = rows[r, 3] + u * across - v * along
            sample_row(v * s - u * c, -u * s - v * c, turn, rows[r, 4], k, clothoid, table, moment, row)
            gradient[o] -= weight * residual * by_offset
            for i in range(6):
                by_shape[i] -= weight * residual * row[i]
            if full:
                hessian[o, o] += weight * by_offset**2
                for i in range(6):
                    mixed[o, i] += weight * by_offset * row[i]
                    for j in range(i + 1):
                        square[i, j] += weight * row[i] * row[j]
    slopes = course_slopes(course, clothoid, tril)
    for j in range(6):
        for i in range(6):
            gradient[j] += slopes[i, j] * by_shape[i]
    if full:
        whiten_course(square, mixed, slopes, hessian)
    return total


@nb.njit(error_model="numpy")
def course_slopes(course, clothoid, tril):  # type: ignore[no-untyped-def]
    """d clothoid / d x, (6, 6): of its numbers in the whitened course."""
    fit, out = np.empty((3, 6)), np.zeros((6, 6))
    hermite_slopes(course, clothoid, fit)
    for j in range(6):
        for i in range(3):
            out[i, j] = tril[i, j]
            for m in range(j, 6):
                out[3 + i, j] += fit[i, m] * tril[m, j]
    return out


@nb.njit(error_model="numpy")
def whiten_course(square, mixed, slopes, hessian):  # type: ignore[no-untyped-def]
    """The Hessian (6 + G, 6 + G) from its blocks in the clothoid's numbers: square (6, 6), its lower half, and mixed
    (6 + G, 6), where the offsets' rows count."""
    half = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for m in range(6):
                half[i, j] += (square[i, m] if m <= i else square[m, i]) * slopes[m, j]
    for i in range(6):
        for j in range(6):
            for m in range(6):
                hessian[i, j] += slopes[m, i] * half[m, j]
    for o in range(6, len(hessian)):
        for j in range(6):
            for m in range(6):
                hessian[o, j] += mixed[o, m] * slopes[m, j]
            hessian[j, o] = hessian[o, j]


@nb.njit(cache=True, error_model="numpy")
def density_slopes(x, mean, tril, num, paper, cues, group, loc, std, height, gradient):  # type: ignore[no-untyped-def]
    """Log density, height (S,), and its gradient (S, 6 + G) at whitened numbers x (S, 6 + G)."""
    empty, z = np.empty((0, 0)), np.empty(x.shape[1])
    for i in range(len(x)):
        for j in range(6):
            z[j] = x[i, j]
        for g in range(len(loc)):
            z[6 + g] = loc[g] + std[g] * x[i, 6 + g]
        height[i] = linearise(z, mean, tril, num, paper, cues, group, gradient[i], empty)
        for g in range(len(loc)):
            gradient[i, 6 + g] *= std[g]


@nb.njit(cache=True, error_model="numpy")
def normal_equations(z, mean, tril, num, paper, cues, group, hessian, gradient):  # type: ignore[no-untyped-def]
    """Minus the log density at z (6 + G,), its gradient (6 + G,) and its Gauss-Newton Hessian (6 + G, 6 + G)."""
    cost = -linearise(z, mean, tril, num, paper, cues, group, gradient, hessian)
    for j in range(len(z)):
        gradient[j] = -gradient[j]
    return cost


@nb.njit(cache=True, error_model="numpy")
def explain(z, mean, tril, num, paper, cues, group, out):  # type: ignore[no-untyped-def]
    """Of every cue its lateral residual and its residual in direction, both in standard deviations, and the probability
    that it follows the road; out (N, 3)."""
    course, clothoid, table, rows = np.empty(6), np.empty(6), np.empty((num, COLUMNS)), np.empty((3, 6))
    step = lay_course(z, mean, tril, course, clothoid, table)
    for n in range(len(cues)):
        if step == np.inf:
            out[n, 0] = out[n, 1] = out[n, 2] = np.nan
            continue
        k = nearest_sample(cues, n, table, step)
        out[n, 2] = score_cue(paper, cues, n, z[6 + group[n]], table, k, rows)[1]
        out[n, 0], out[n, 1] = rows[1 if paper else 0, 0], rows[2, 0]
