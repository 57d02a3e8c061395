"""Machine code that judges candidate motions: limits, boundary lines, other road users, at every step of the horizon.

A candidate is one longitudinal and one lateral polynomial; candidate c of n x m has longitudinal c // m, lateral c % m.
Kinematics, margins and clearance are formulas of planning.kinematics and planning.shapes, inlined here.
"""

from __future__ import annotations

import math

from numba import njit

from planning.boundary_kernel import touches
from planning.kinematics import GUARDED, MARGINS, PLACED
from planning.reference_kernel import line_at
from planning.shapes import CELL, CLEARANCE

margins_of = MARGINS.scalar()
clearance_of = CLEARANCE.scalar()
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
    """out (n, K, 9): s, s', s'', kappa, kappa', x, y, cos theta, sin theta of each motion at dt, 2 dt, ..."""
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k, 0], out[i, k, 1], out[i, k, 2] = polynomial(coefficients, i, duration[i], (k + 1) * dt)
    add_line(table, step, out)


@njit(cache=True, error_model="numpy")
def add_line(table, step, out):  # type: ignore[no-untyped-def]
    """Columns 3 to 8 of out (n, K, 9), the line at s, which is column 0."""
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            row = out[i, k]
            x, y, theta, kappa, slope = line_at(table, step, row[0])
            row[3], row[4] = kappa, slope
            row[5], row[6], row[7], row[8] = x, y, math.cos(theta), math.sin(theta)


@njit(cache=True, error_model="numpy")
def across_line(coefficients, duration, dt, out):  # type: ignore[no-untyped-def]
    """out (m, K, 3): d, d', d'' of each motion told by time."""
    for j in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[j, k, 0], out[j, k, 1], out[j, k, 2] = polynomial(coefficients, j, duration[j], (k + 1) * dt)


@njit(error_model="numpy", inline="always")
def limit_broken(ds, dds, kappa, slope, d, dd, ddd, limits):  # type: ignore[no-untyped-def]
    """The first margin that is negative, counted from one, or 0; speed, curvature of the path."""
    g = margins_of(ds, dds, kappa, slope, d, dd, ddd, limits[0], limits[1], limits[2], limits[3], limits[4], limits[5])
    if min(min(min(g[0], g[1]), min(g[2], g[3])), min(min(g[4], g[5]), min(min(g[6], g[7]), min(g[8], g[9])))) >= 0.0:
        return 0, g[10], g[11]
    for n in range(10):
        if not g[n] >= 0.0:  # NaN breaks it too
            return n + 1, g[10], g[11]
    return 0, g[10], g[11]


@njit(error_model="numpy", inline="always")
def obstacle_touched(rectangles, k, x, y, cos, sin, middle, circles, radius):  # type: ignore[no-untyped-def]
    """Whether a circle of the vehicle may touch a rectangle at step k, more likely than its chance allows."""
    mx, my = x + middle * cos, y + middle * sin
    for m in range(rectangles.shape[1]):
        r = rectangles[k, m]
        if (mx - r[0]) ** 2 + (my - r[1]) ** 2 > r[10]:
            continue
        for n in range(len(circles)):
            px, py = x + circles[n] * cos, y + circles[n] * sin
            if clearance_of(px, py, r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], radius)[0] <= 0.0:
                return True
    return False


@njit(cache=True, error_model="numpy")
def judge(  # type: ignore[no-untyped-def]
    order, ahead, across, by_way, bends, ways, start, dt, limits, rate, end, stop, stop_beyond, braking,
    segment, origin, shape, offset, member, rectangles, middle, circles, radius, first_good, reason, when,
):  # fmt: skip
    """Fill reason (n m,) and when (n m,), the step at which it arises, of the candidates in `order`; return the first
    good one, or -1.

    ahead (n, K, 9) of along_line, across (m, K, 3) of across_line; by_way (m,): the lateral motion is told by way, with
    coefficients bends (m, 6) and lengths ways (m,); start (s, curvature of the path); end, stop: largest s allowed;
    stop_beyond: s at which standing must be possible by `braking` after the horizon; first_good: look no farther than
    the first good one."""
    num_lateral, num_steps = across.shape[0], across.shape[1]
    for c in order:
        i, j = c // num_lateral, c % num_lateral
        found, bent, k = 0, start[1], 0
        for k in range(num_steps):
            a = ahead[i, k]
            s, ds, dds = a[0], a[1], a[2]
            if by_way[j]:
                d, slope, bend = polynomial(bends, j, ways[j], s - start[0])
                dd, ddd = slope * ds, bend * ds * ds + slope * dds
            else:
                d, dd, ddd = across[j, k, 0], across[j, k, 1], across[j, k, 2]
            found, v, curvature = limit_broken(ds, dds, a[3], a[4], d, dd, ddd, limits)
            if found:
                break
            if v > CRAWLING:
                if abs(curvature - bent) > rate * dt:
                    found = CURVATURE_RATE
                    break
                bent = curvature
            if s > end or s > stop:
                found = STOP_POINT if s > stop else END_OF_LINE
                break
            x, y, cos, sin = placed(ds, a[3], d, dd, a[5], a[6], a[7], a[8])
            for q in range(len(circles)):
                px, py = x + circles[q] * cos, y + circles[q] * sin
                if touches(segment, origin, shape, offset, member, CELL, px, py, radius):
                    found = BOUNDARY
                    break
            if found:
                break
            if obstacle_touched(rectangles, k, x, y, cos, sin, middle, circles, radius):
                found = OBSTACLE
                break
        if not found and ahead[i, num_steps - 1, 0] + ahead[i, num_steps - 1, 1] ** 2 / (2.0 * braking) > stop_beyond:
            found, k = BEYOND, num_steps
        reason[c], when[c] = found, k
        if first_good and not found:
            return c
    return -1
