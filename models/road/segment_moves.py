"""Steps over roads of pieces, in machine code, scaled to what the cues say.

Given where its knots are, a road is nearly linear in its other numbers b (offsets, start, curvatures, rate), so that
their posterior is nearly normal, N(m, P^-1) with P = C C' and C lower triangular. Both depend on the knots and the data
alone, not on b (`fitted`), and whiten it:

    w = C' (b - m)

All steps are taken with w at hand, so that one that moves a knot carries the road along: it keeps w, not b, as in
transport reversible jump (Davies, Salomone, Sutton, Drovandi 2023):

    walk         w_j moves by U[-a, a] for one j; the log of a is uniform
    scale        all of w by e^t, t ~ U[-a, a]:  |J| = e^(n t); it brings home chains that begin far away
    refresh      of the road's numbers: (w, xi) -> (r w + q xi, q w - r xi), r^2 + q^2 = 1, xi normal; r is 0 or R_NEAR
    shift        one knot moves by U[-a, a]; b' = m' + C'^-T w with the new m and C:  |J| = |C| / |C'|
    birth_death  a knot is born anywhere with one more w, normal; or a uniform one dies with its w. The born takes the
                 place of the first inactive slot, whose values travel back in u'

A poor fit costs acceptance, not correctness. Normal numbers beyond FAR are not carried by u: a step from or to there is
not valid. `propose` is the involution of all moves; the batched path and the compiled chain both call it.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.clothoid_kernel import BEND, COLUMNS, COS, HEADING, SIN, X, Y
from models.intersection.moves import normal_cdf, normal_quantile, split_choice
from models.intersection.refit import solve_spd
from models.intersection.window import window
from models.overwrite import overwrite
from models.road.cue_kernel import LOCAL, RESIDUALS, nearest_sample, score_cue
from models.road.segment_kernel import (
    CUES,
    GROUP,
    GROUPS,
    LENGTH,
    PAPER,
    REFERENCE_STEP,
    SHAPE,
    SLOTS,
    lay_pieces,
    sort_nodes,
    views,
)

WALK, SCALE, REFRESH, SHIFT, BIRTH_DEATH = range(5)
NAMES = ("walk", "scale", "refresh", "shift", "birth_death")
PROBABILITIES = (0.2, 0.1, 0.25, 0.25, 0.2)
FITS = 2  # linearisations of a fit: about the reference road, then about what was found
LARGEST_WALK, LARGEST_SCALE, LARGEST_SHIFT = 3.0, 6.0, 0.5  # standard deviations, log of a factor, share of the length
LOG_RANGE = 4.0  # steps are up to exp(-LOG_RANGE) shorter
R_NEAR, SHARE_NEAR = 0.9, 0.5
FAR = 7.0


@nb.njit(error_model="numpy")
def reaches(node, order, num, table, step, bend, turn, right, up):  # type: ignore[no-untyped-def]
    """How samples move with curvature: (num samples, num + 3) each, by the curvature at the start, the rate, the
    curvature of every active slot, and, last, all of the curvature that the samples have themselves.

    bend   of a sample, turn its integral, (right, up) the integral of turn (-sin, cos)"""
    size, i = num + 3, 0
    column = np.empty(num + 1, np.int64)
    for a in range(num + 1):
        column[a] = 0 if a == 0 else 2 + order[a]
    whole, half, now = np.zeros(size), np.empty(size), np.empty(size)
    for m in range(2 * len(table) - 1):
        s, k = 0.5 * step * m, m // 2
        while i < num and s >= node[0, i + 1]:
            apart = 0.5 * (node[0, i + 1] - node[0, i])
            whole[column[i]] += apart
            whole[column[i + 1]] += apart
            i += 1
        t = s - node[0, i]
        overwrite(now, whole)
        if i < num:
            apart = node[0, i + 1] - node[0, i]
            now[column[i]] += t - 0.5 * t * t / apart
            now[column[i + 1]] += 0.5 * t * t / apart
        else:
            now[column[i]] += t
            now[1] += 0.5 * t * t
        if m % 2 == 1:
            overwrite(half, now)
            middle = 0.5 * (table[k, HEADING] + table[k + 1, HEADING])
            half[size - 1] = middle - 0.125 * step * (table[k + 1, BEND] - table[k, BEND]) - table[0, HEADING]
            continue
        now[size - 1] = table[k, HEADING] - table[0, HEADING]
        for j in range(size):
            bend[k, j], turn[k, j], right[k, j], up[k, j] = 0.0, now[j], 0.0, 0.0
        if i < num:
            bend[k, column[i]], bend[k, column[i + 1]] = 1.0 - t / apart, t / apart
        else:
            bend[k, column[i]], bend[k, 1] = 1.0, t
        bend[k, size - 1] = table[k, BEND]
        if k == 0:
            continue
        cos = 6.0 / step * (table[k, X] - table[k - 1, X]) - table[k - 1, COS] - table[k, COS]  # four times
        sin = 6.0 / step * (table[k, Y] - table[k - 1, Y]) - table[k - 1, SIN] - table[k, SIN]
        for j in range(size):
            before, middle, sixth = turn[k - 1, j], half[j], step / 6.0
            across = before * table[k - 1, SIN] + middle * sin + now[j] * table[k, SIN]
            ahead = before * table[k - 1, COS] + middle * cos + now[j] * table[k, COS]
            right[k, j], up[k, j] = right[k - 1, j] - sixth * across, up[k - 1, j] + sixth * ahead


@nb.njit(error_model="numpy")
def linearise(z, floats, ints, table, step, offset, precision, centre):  # type: ignore[no-untyped-def]
    """Precision P (lower triangle) and P m of the linear numbers, given the knots of z, with the cues linearised about
    a road's samples `table`, a `step` apart, and offsets (G,). It makes proposals only, and leaves out the end of the
    sight and changes of lanes."""
    _, loc, std, _, _, cues = views(floats, ints)
    slots, groups, group, paper = ints[SLOTS], ints[GROUPS], window(ints, GROUP, (ints[CUES],)), ints[PAPER] == 1
    node, order = np.empty((2, slots + 1)), np.empty(slots + 1, np.int64)
    num = sort_nodes(z, groups, slots, node, order)
    shape = (len(table), num + 3)
    bend, turn, right, up = np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape)
    reaches(node, order, num, table, step, bend, turn, right, up)
    size = SHAPE + num
    for i in range(groups + size):
        for j in range(i):
            precision[i, j] = 0.0
        precision[i, i] = 1.0 / std[i] ** 2
        centre[i] = loc[i] / std[i] ** 2
    rows, row = np.empty((RESIDUALS, LOCAL)), np.empty(size + 1)
    for n in range(len(cues)):
        g, k = group[n], nearest_sample(cues, n, table, step)
        _, weight = score_cue(paper, cues, n, offset[g], table, k, rows)
        c, s = table[k, COS], table[k, SIN]
        dx, dy = cues[n, 0] - table[k, X], cues[n, 1] - table[k, Y]
        along, across = dx * c + dy * s, dy * c - dx * s
        dx, dy = table[k, X] - table[0, X], table[k, Y] - table[0, Y]
        for r in range(3):
            if r == 1 and not paper:
                continue  # what the variance tells: little, and far from linear
            residual, u, v, by_offset = rows[r, 0], rows[r, 1], rows[r, 2], rows[r, 5]
            row[0], row[1], swing = v * s - u * c, -u * s - v * c, rows[r, 3] + u * across - v * along
            row[2] = swing - row[0] * dy + row[1] * dx
            for j in range(num + 3):
                row[3 + j] = swing * turn[k, j] + row[0] * right[k, j] + row[1] * up[k, j] + rows[r, 4] * bend[k, j]
            target = row[0] * table[0, X] + row[1] * table[0, Y] + row[2] * table[0, HEADING] + row[size]
            target += by_offset * offset[g] - residual
            precision[g, g] += weight * by_offset**2
            centre[g] += weight * by_offset * target
            for i in range(size):
                weighted = weight * row[i]
                centre[groups + i] += weighted * target
                precision[groups + i, g] += weighted * by_offset
                for j in range(i + 1):
                    precision[groups + i, groups + j] += weighted * row[j]


@nb.njit(error_model="numpy")
def fitted(z, floats, ints, factor, centre):  # type: ignore[no-untyped-def]
    """C (n, n) and m (n,) of the n linear numbers given the knots of z; False where there is no fit."""
    slots, groups = ints[SLOTS], ints[GROUPS]
    _, _, _, offset, table, _ = views(floats, ints)
    size = groups + SHAPE + int(z[0])
    linearise(z, floats, ints, table, floats[REFERENCE_STEP], offset, factor, centre)
    if not solve_spd(factor, centre, size):
        return False
    own, at = np.empty((len(table), COLUMNS)), z.copy()
    for _ in range(FITS - 1):
        overwrite(at[1:], centre[:size])
        step = lay_pieces(at, groups, slots, floats[LENGTH], own)
        linearise(z, floats, ints, own, step, at[1 : 1 + groups], factor, centre)
        if not solve_spd(factor, centre, size):
            return False
    return True


@nb.njit(error_model="numpy")
def whiten(z, factor, centre, size, w):  # type: ignore[no-untyped-def]
    """w = C' (b - m) of a state."""
    for i in range(size):
        w[i] = 0.0
        for j in range(i, size):
            w[i] += factor[j, i] * (z[1 + j] - centre[j])


@nb.njit(error_model="numpy")
def colour(w, factor, centre, size, z):  # type: ignore[no-untyped-def]
    """b = m + C'^-1 w into a state; returns whether it is finite."""
    total = 0.0
    for i in range(size - 1, -1, -1):
        value = w[i]
        for j in range(i + 1, size):
            value -= factor[j, i] * (z[1 + j] - centre[j])
        z[1 + i] = centre[i] + value / factor[i, i]
        total += abs(z[1 + i])
    return total < math.inf


@nb.njit(error_model="numpy")
def log_det(factor, size):  # type: ignore[no-untyped-def]
    """log |C|."""
    total = 0.0
    for i in range(size):
        total += math.log(factor[i, i])
    return total


@nb.njit(error_model="numpy")
def log_normal(x):  # type: ignore[no-untyped-def]
    return -0.5 * (x * x + math.log(2.0 * math.pi))


@nb.njit(error_model="numpy")
def step_size(u):  # type: ignore[no-untyped-def]
    """Length of a step, 1 at most."""
    return math.exp(-LOG_RANGE * u)


@nb.njit(error_model="numpy")
def swap_slots(z, a, b, bends, slots):  # type: ignore[no-untyped-def]
    z[bends + a], z[bends + b] = z[bends + b], z[bends + a]
    z[bends + slots + a], z[bends + slots + b] = z[bends + slots + b], z[bends + slots + a]


@nb.njit(error_model="numpy")
def walk(u, u_new, factor, centre, size, w, z_new):  # type: ignore[no-untyped-def]
    """Move one whitened number."""
    j, _ = split_choice(u[0], size)
    w[j] += LARGEST_WALK * step_size(u[1]) * (2.0 * u[2] - 1.0)
    u_new[2] = 1.0 - u[2]
    return colour(w, factor, centre, size, z_new)


@nb.njit(error_model="numpy")
def scale(u, u_new, factor, centre, size, w, z_new, log_q):  # type: ignore[no-untyped-def]
    """Shrink or stretch all whitened numbers."""
    t = LARGEST_SCALE * step_size(u[0]) * (2.0 * u[1] - 1.0)
    for i in range(size):
        w[i] *= math.exp(t)
    u_new[1], log_q[2] = 1.0 - u[1], size * t
    return colour(w, factor, centre, size, z_new)


@nb.njit(error_model="numpy")
def refresh(u, u_new, factor, centre, groups, size, w, z_new, log_q):  # type: ignore[no-untyped-def]
    """Mirror the road's whitened numbers and fresh normal ones in each other."""
    r = R_NEAR if u[0] < SHARE_NEAR else 0.0
    q = math.sqrt(1.0 - r * r)
    for i in range(groups, size):
        own, fresh = w[i], normal_quantile(u[1 + i - groups])
        w[i], back = r * own + q * fresh, q * own - r * fresh
        if not (abs(fresh) < FAR and abs(back) < FAR):
            return False
        u_new[1 + i - groups] = normal_cdf(back)
        log_q[0] += log_normal(fresh)
        log_q[1] += log_normal(back)
    return colour(w, factor, centre, size, z_new)


def propose(kind, z, u, floats, ints, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """One involution; returns False where the step leaves the state space."""
    overwrite(z_new, z)
    overwrite(u_new, u)
    log_q[0] = log_q[1] = log_q[2] = 0.0
    slots, groups, num, length = ints[SLOTS], ints[GROUPS], int(z[0]), floats[LENGTH]
    bends, size = 1 + groups + SHAPE, groups + SHAPE + num
    knots, birth = bends + slots, u[0] < 0.5
    last, place = num if birth else num - 1, 0  # the slot that a birth or a death changes, and whose place it has
    if kind == BIRTH_DEATH:
        if last < 0 or last >= slots:
            return False
        place, _ = split_choice(u[1], last + 1)
        if not birth:
            swap_slots(z_new, place, last, bends, slots)
    elif kind == SHIFT:
        if num == 0:
            return False
        place, _ = split_choice(u[0], num)
    full = groups + SHAPE + slots
    factor, centre, w = np.empty((full, full)), np.empty(full), np.empty(full)
    if not fitted(z_new, floats, ints, factor, centre):
        return False
    whiten(z_new, factor, centre, size, w)
    if kind == WALK:
        return walk(u, u_new, factor, centre, size, w, z_new)
    if kind == SCALE:
        return scale(u, u_new, factor, centre, size, w, z_new, log_q)
    if kind == REFRESH:
        return refresh(u, u_new, factor, centre, groups, size, w, z_new, log_q)
    log_q[2] = log_det(factor, size)
    if kind == SHIFT:
        z_new[knots + place] += LARGEST_SHIFT * length * step_size(u[1]) * (2.0 * u[2] - 1.0)
        u_new[2] = 1.0 - u[2]
        if not 0.0 < z_new[knots + place] < length or not fitted(z_new, floats, ints, factor, centre):
            return False
        log_q[2] -= log_det(factor, size)
        return colour(w, factor, centre, size, z_new)
    spread = views(floats, ints)[2][groups + SHAPE]
    fresh = normal_quantile(u[3])
    back = z_new[bends + last] / spread if birth else w[size - 1]
    if not (abs(fresh) < FAR and abs(back) < FAR):
        return False
    u_new[0], u_new[2], u_new[3] = (u[0] + 0.5) % 1.0, z_new[knots + last] / length, normal_cdf(back)
    z_new[0], z_new[knots + last] = num + (1.0 if birth else -1.0), u[2] * length
    if not fitted(z_new, floats, ints, factor, centre):
        return False
    if birth:
        w[size] = fresh
        size += 1
    else:
        z_new[bends + last] = spread * fresh
        size -= 1
    log_q[0], log_q[1] = log_normal(fresh), log_normal(back)
    log_q[2] += (-1.0 if birth else 1.0) * math.log(spread) - log_det(factor, size)
    finite = colour(w, factor, centre, size, z_new)
    if birth:
        swap_slots(z_new, place, last, bends, slots)
    return finite


@nb.njit(cache=True, error_model="numpy")
def improve(z, floats, ints):  # type: ignore[no-untyped-def]
    """The centre of the fit given the knots of a state, in place; False where there is none."""
    full = ints[GROUPS] + SHAPE + ints[SLOTS]
    factor, centre = np.empty((full, full)), np.empty(full)
    if not fitted(z, floats, ints, factor, centre):
        return False
    for i in range(ints[GROUPS] + SHAPE + int(z[0])):
        z[1 + i] = centre[i]
    return True
