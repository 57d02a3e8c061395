"""Machine code that judges candidate motions: limits, boundary lines, other road users, at every step of the horizon.

A candidate is one longitudinal and one lateral polynomial; candidate c of n x m has longitudinal c // m, lateral c % m.
Kinematics, margins and clearance are formulas of planning.kinematics and planning.shapes, inlined here.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from planning.boundary_kernel import first_line
from planning.kinematics import GUARDED, MARGINS, PLACED
from planning.reference_kernel import line_at
from planning.shapes import SIGMAS

margins_of = MARGINS.scalar()
sigmas_of = SIGMAS.scalar()
placed = PLACED.scalar()

NUM_MARGINS = len(GUARDED)
GOOD = 0  # then 1 ... NUM_MARGINS for the margins
CURVATURE_RATE, END_OF_LINE, STOP_POINT, BOUNDARY, OBSTACLE, BEYOND = range(NUM_MARGINS + 1, NUM_MARGINS + 7)
REASONS = (
    "none",
    *GUARDED,
    "curvature rate",
    "end of the reference line",
    "stop point",
    "boundary line",
    "other road user",
    "cannot stop beyond the horizon",
)
ROUNDING = 1.0 + 1e-9  # of a sum of chances that is just the risk
ON_LIMITS = (*range(1, NUM_MARGINS + 1), CURVATURE_RATE, BEYOND)  # reasons that other limits may not give
LEAP = 4  # steps between those looked at in a hurry
CRAWLING = 0.1  # below it the rate of curvature is not looked at: at rest it is free [m/s]


@njit(error_model="numpy", inline="always")
def polynomial(c, i, duration, t):  # type: ignore[no-untyped-def]
    """q, q', q'' of row i at t, uniform beyond its duration."""
    u = min(t, duration)
    c0, c1, c2, c3, c4, c5 = c[i, 0], c[i, 1], c[i, 2], c[i, 3], c[i, 4], c[i, 5]
    q = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5))))
    first = c1 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))
    if t > duration:
        return q + first * (t - duration), first, 0.0
    return q, first, 2.0 * c2 + u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5))


@njit(cache=True, error_model="numpy")
def along_line(coefficients, duration, table, step, dt, out):  # type: ignore[no-untyped-def]
    """out (n, 9, K): s, s', s'', kappa, kappa', x, y, cos theta, sin theta of each motion at dt, 2 dt, ..."""
    for i in range(out.shape[0]):
        for k in range(out.shape[2]):
            out[i, 0, k], out[i, 1, k], out[i, 2, k] = polynomial(coefficients, i, duration[i], (k + 1) * dt)
    add_line(table, step, out)


@njit(cache=True, error_model="numpy")
def add_line(table, step, out):  # type: ignore[no-untyped-def]
    """Rows 3 to 8 of out (n, 9, K), the line at s, which is row 0."""
    for i in range(out.shape[0]):
        row = out[i]
        for k in range(out.shape[2]):
            x, y, theta, kappa, slope = line_at(table, step, row[0, k])
            row[3, k], row[4, k] = kappa, slope
            row[5, k], row[6, k], row[7, k], row[8, k] = x, y, math.cos(theta), math.sin(theta)


@njit(cache=True, error_model="numpy")
def across_line(coefficients, duration, dt, out):  # type: ignore[no-untyped-def]
    """out (m, 3, K): d, d', d'' of each motion told by time."""
    for j in range(out.shape[0]):
        for k in range(out.shape[2]):
            out[j, 0, k], out[j, 1, k], out[j, 2, k] = polynomial(coefficients, j, duration[j], (k + 1) * dt)


@njit(error_model="numpy")
def by_the_way(coefficients, j, way, a, start, out):  # type: ignore[no-untyped-def]
    """out (3, K): d, d', d'' of a motion told by the way, on the longitudinal motion a (9, K)."""
    for k in range(out.shape[1]):
        d, slope, bend = polynomial(coefficients, j, way, a[0, k] - start)
        out[0, k], out[1, k], out[2, k] = d, slope * a[1, k], bend * a[1, k] ** 2 + slope * a[2, k]


@njit(error_model="numpy", inline="always")
def margins_at(a, d, k, limits):  # type: ignore[no-untyped-def]
    """Margins, speed and curvature at step k."""
    return margins_of(
        a[1, k], a[2, k], a[3, k], a[4, k], d[0, k], d[1, k], d[2, k],
        limits[0], limits[1], limits[2], limits[3], limits[4], limits[5],
    )  # fmt: skip


@njit(error_model="numpy")
def within(a, d, limits, speed, curvature):  # type: ignore[no-untyped-def]
    """Whether all margins are kept (NaN keeps none); fills speed and curvature (K,). No branch: it runs on vectors."""
    broken = 0
    for k in range(len(speed)):
        g = margins_at(a, d, k, limits)
        kept = (g[0] >= 0.0) & (g[1] >= 0.0) & (g[2] >= 0.0) & (g[3] >= 0.0) & (g[4] >= 0.0)
        kept &= (g[5] >= 0.0) & (g[6] >= 0.0) & (g[7] >= 0.0) & (g[8] >= 0.0) & (g[9] >= 0.0)
        broken += 0 if kept else 1
        speed[k], curvature[k] = g[10], g[11]
    return broken == 0


@njit(error_model="numpy")
def first_limit(a, d, limits):  # type: ignore[no-untyped-def]
    """The first margin that is not kept, counted from one, and its step."""
    for k in range(a.shape[1]):
        g = margins_at(a, d, k, limits)
        for n in range(NUM_MARGINS):
            if not g[n] >= 0.0:
                return n + 1, k
    return GOOD, a.shape[1]


@njit(error_model="numpy")
def first_turn(speed, curvature, start, most):  # type: ignore[no-untyped-def]
    """The first step at which curvature has changed by more than `most` since the one before; K if none has. At a crawl
    it may: steering at rest is free."""
    if speed[0] > CRAWLING and abs(curvature[0] - start) > most:
        return 0
    turns = 0
    for k in range(1, len(speed)):
        quick = (speed[k] > CRAWLING) & (speed[k - 1] > CRAWLING)
        turns += 1 if quick & (abs(curvature[k] - curvature[k - 1]) > most) else 0
    if turns:
        for k in range(1, len(speed)):
            if min(speed[k], speed[k - 1]) > CRAWLING and abs(curvature[k] - curvature[k - 1]) > most:
                return k
    return len(speed)


@njit(error_model="numpy")
def in_plane(a, d, pose):  # type: ignore[no-untyped-def]
    """pose (4, K): x, y, cos and sin of the heading."""
    for k in range(pose.shape[1]):
        pose[0, k], pose[1, k], pose[2, k], pose[3, k] = placed(
            a[1, k], a[3, k], d[0, k], d[1, k], a[5, k], a[6, k], a[7, k], a[8, k]
        )


@njit(error_model="numpy", inline="always")
def sigmas_at(pose, k, r, middle, circles, radius):  # type: ignore[no-untyped-def]
    """The least z of the vehicle's circles at step k from a rectangle (11, K); infinity where it is far away."""
    dx, dy = pose[0, k] + middle * pose[2, k] - r[0, k], pose[1, k] + middle * pose[3, k] - r[1, k]
    z = math.inf
    if not dx * dx + dy * dy > r[10, k]:
        for i in range(len(circles)):
            x, y = pose[0, k] + circles[i] * pose[2, k], pose[1, k] + circles[i] * pose[3, k]
            told = sigmas_of(
                x, y, r[0, k], r[1, k], r[2, k], r[3, k], r[4, k], r[5, k], r[6, k], r[7, k], r[8, k], radius
            )[0]
            z = told if not told >= z else z  # NaN is not clear
    return z


@njit(error_model="numpy")
def first_rectangle(pose, rectangles, chances, middle, circles, radius, order, hurry):  # type: ignore[no-untyped-def]
    """The first step at which a circle may touch a rectangle, more likely than the risk, or K. Where no rectangle but
    their sum is, sum_m p_m Phi(-z_m) with the least z of each, it is the step of the likeliest.

    rectangles (M, 11, K) of planning.shapes.Obstacles.table; chances: risk, and of each rectangle (M,) the probability,
    the z below which it alone is too much, and the chance that is left where it is not near; order (M,) in which they
    are looked at. In a hurry any such step will do, and the rectangle that was found comes first the next time, for the
    next candidate is like this one."""
    risk, probability, alone, far = chances
    first, total, likeliest, at = pose.shape[1], 0.0, -1.0, pose.shape[1]
    if hurry and len(order):
        for k in range(first - 1, -1, -LEAP):
            if not sigmas_at(pose, k, rectangles[order[0]], middle, circles, radius) > alone[order[0]]:
                return k
    for n in range(len(order)):
        m = order[n]
        r, near = rectangles[m], 0
        for k in range(first):  # on vectors: most are far away
            dx, dy = pose[0, k] + middle * pose[2, k] - r[0, k], pose[1, k] + middle * pose[3, k] - r[1, k]
            near += 0 if dx * dx + dy * dy > r[10, k] else 1
        if near == 0:
            total += far[m]
            continue
        least, worst = math.inf, first
        for k in range(first):
            z = sigmas_at(pose, k, r, middle, circles, radius)
            if not z > alone[m]:
                first = k
                break
            if z < least:
                least, worst = z, k
        chance = max(0.5 * probability[m] * math.erfc(least / math.sqrt(2.0)), far[m])
        total += chance
        if chance > likeliest:
            likeliest, at = chance, worst
        if hurry and (first < pose.shape[1] or total > risk * ROUNDING):
            for i in range(n, 0, -1):
                order[i] = order[i - 1]
            order[0] = m
            break
    return min(first, at) if total > risk * ROUNDING else first


@njit(error_model="numpy")
def first_touch(  # type: ignore[no-untyped-def]
    a, pose, end, stop, lines, rectangles, chances, middle, circles, radius, order, hurry
):  # fmt: skip
    """The first thing that is passed or touched, and its step; in a hurry another road user, if there is one, for that
    is quickly told."""
    num_steps = pose.shape[1]
    found, at = GOOD, num_steps
    if hurry:
        k = first_rectangle(pose, rectangles, chances, middle, circles, radius, order, hurry)
        if k < num_steps:
            return OBSTACLE, k
    if a[0, num_steps - 1] > min(stop, end):  # none drives backwards
        at = 0
        while not a[0, at] > min(stop, end):
            at += 1
        found = STOP_POINT if a[0, at] > stop else END_OF_LINE
    k = first_line(pose, lines, circles, radius)
    if k < at:
        found, at = BOUNDARY, k
    if not hurry:
        k = first_rectangle(pose, rectangles, chances, middle, circles, radius, order, hurry)
        if k < at:
            return OBSTACLE, k
    return found, at


@njit(cache=True, error_model="numpy")
def judge(  # type: ignore[no-untyped-def]
    order, ahead, across, by_way, bends, ways, start, dt, limits, rate, end, stop, stand, braking,
    lines, rectangles, chances, middle, circles, radius, first_good, reason, when,
):  # fmt: skip
    """Fill reason (n m,) and when (n m,), the step at which it arises, of the candidates in `order`; return the first
    good one, or -1. Limits come first, over the whole horizon, then what is touched.

    ahead (n, 9, K) of along_line, across (m, 3, K) of across_line; by_way (m,): the lateral motion is told by the way,
    with coefficients bends (m, 6) and lengths ways (m,); start (s, curvature of the path); end, stop: largest s;
    stand: s before which standing must be possible by `braking` after the horizon; first_good: look no farther than
    the first good one, and in a hurry."""
    num_lateral, num_steps = across.shape[0], across.shape[2]
    speed, curvature = np.empty(num_steps), np.empty(num_steps)
    told, pose = np.empty((3, num_steps)), np.empty((4, num_steps))
    best, sequence = -1, np.arange(len(rectangles))
    for c in order:
        i, j = c // num_lateral, c % num_lateral
        a, d = ahead[i], across[j]
        if by_way[j]:
            by_the_way(bends, j, ways[j], a, start[0], told)
            d = told
        if not within(a, d, limits, speed, curvature):
            found, k = first_limit(a, d, limits)
        else:
            found, k = CURVATURE_RATE, first_turn(speed, curvature, start[1], rate * dt)
            if k == num_steps:
                in_plane(a, d, pose)
                found, k = first_touch(
                    a, pose, end, stop, lines, rectangles, chances, middle, circles, radius, sequence, first_good
                )
                if found == GOOD and a[0, num_steps - 1] + a[1, num_steps - 1] ** 2 / (2.0 * braking) > stand:
                    found = BEYOND
        reason[c], when[c] = found, k
        if found == GOOD and best < 0:
            best = c
            if first_good:
                break
    return best
