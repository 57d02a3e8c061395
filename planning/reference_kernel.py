"""Machine code of a reference line: its value at an arc length, and the foot point of a position.

The line is a table of (x, y, theta, kappa, kappa') at multiples of `step`; between them x, y, theta and kappa are cubic
Hermite interpolants and kappa' is linear.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

LEAST = 0.1  # of 1 - kappa d in Newton's divisor, and the least that counts as a foot point
MAX_STEP = 10.0  # of Newton [m]
TOLERANCE = 1e-10  # [m]
FOUND, CURVATURE_CENTRE, BEYOND_ENDS, NOT_CONVERGED = range(4)


@njit(error_model="numpy", inline="always")
def line_at(table, step, s):  # type: ignore[no-untyped-def]
    """x, y, theta, kappa, kappa' at arc length s; beyond the ends the last cubic goes on."""
    n = min(max(math.floor(s / step), 0), table.shape[0] - 2)
    f = s / step - n
    g = 1.0 - f
    h00, h10, h01, h11 = (1.0 + 2.0 * f) * g * g, f * g * g * step, f * f * (3.0 - 2.0 * f), -f * f * g * step
    a, b = table[n], table[n + 1]
    x = h00 * a[0] + h10 * math.cos(a[2]) + h01 * b[0] + h11 * math.cos(b[2])
    y = h00 * a[1] + h10 * math.sin(a[2]) + h01 * b[1] + h11 * math.sin(b[2])
    theta = h00 * a[2] + h10 * a[3] + h01 * b[2] + h11 * b[3]
    kappa = h00 * a[3] + h10 * a[4] + h01 * b[3] + h11 * b[4]
    return x, y, theta, kappa, a[4] + f * (b[4] - a[4])


@njit(cache=True, error_model="numpy")
def lines_at(table, step, s, out):  # type: ignore[no-untyped-def]
    """out (N, 5) of s (N,)."""
    for i in range(len(s)):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = line_at(table, step, s[i])


@njit(error_model="numpy")
def foot(table, step, x, y, start):  # type: ignore[no-untyped-def]
    """Arc length s and offset d of the foot point, from a warm start, and how the search ended.

    Newton on f(s) = (r - c(s)) . t(s) = 0 with f' = -(1 - kappa d), its divisor kept positive, its step bounded."""
    end = (table.shape[0] - 1) * step
    s = min(max(start, 0.0), end)
    d = w = move = 0.0
    for _ in range(50):
        cx, cy, theta, kappa, _ = line_at(table, step, s)
        cos, sin = math.cos(theta), math.sin(theta)
        ahead, d = (x - cx) * cos + (y - cy) * sin, (y - cy) * cos - (x - cx) * sin
        w = 1.0 - kappa * d
        move = min(max(ahead / max(w, LEAST), -MAX_STEP), MAX_STEP)
        if abs(move) <= TOLERANCE:
            return s, d, (FOUND if w > LEAST else CURVATURE_CENTRE)
        if (s <= 0.0 and move < 0.0) or (s >= end and move > 0.0):
            return s, d, BEYOND_ENDS
        s = min(max(s + move, 0.0), end)
    return s, d, (NOT_CONVERGED if w > LEAST else CURVATURE_CENTRE)


@njit(cache=True, error_model="numpy")
def feet(table, step, points, start, out, ended):  # type: ignore[no-untyped-def]
    """out (N, 2) = (s, d) and ended (N,) of points (N, 2) from start (N,)."""
    for i in range(len(points)):
        out[i, 0], out[i, 1], ended[i] = foot(table, step, points[i, 0], points[i, 1], start[i])


@njit(cache=True, error_model="numpy")
def nearest(table, points, start):  # type: ignore[no-untyped-def]
    """start (N,): the table's row nearest to each point, for a first foot without a warm start."""
    for i in range(len(points)):
        best, at = np.inf, 0
        for n in range(table.shape[0]):
            gap = (table[n, 0] - points[i, 0]) ** 2 + (table[n, 1] - points[i, 1]) ** 2
            if gap < best:
                best, at = gap, n
        start[i] = at
