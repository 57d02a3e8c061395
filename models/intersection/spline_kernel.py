"""The residuals of [M20] section IV-D as a sum of squares in machine code.

    e1 = p_y - f(p_x)                    of every point in the frame of its lane, over the noise of positions
    e2 = d (|d| - width)                 of points a along lane A against lane B, over the gap noise, where |d| < delta
    d  = n_A . (a_B^y - f_B(a_B^x))      the step from B to a along the y-axis of B's frame, seen across A

[M20] prints both squared, eq. 6 and 8: here they are residuals, and the cost is half the sum of their squares. It
writes d - width for a neighbour on the left; |d| - width serves either side, and e2 stays smooth at d = 0.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.spline import ORDER, spline_weights


@nb.njit(error_model="numpy")
def tie(d, width, delta):  # type: ignore[no-untyped-def]
    """e2 and de2/dd: zero with d = 0 and |d| = width, and from delta on."""
    if abs(d) >= delta:
        return 0.0, 0.0
    return d * (abs(d) - width), 2.0 * abs(d) - width


@nb.njit(error_model="numpy")
def spline_distance(controls, frames, a, b, x, room, index, slopes):  # type: ignore[no-untyped-def]
    """d at x on lane a against lane b; inf where a point has no counterpart on b.

    controls (L, n); frames (L, 4) as in SplineEvidence; room (4, 4) for the bases
    index    (8,) controls, of all, that d depends on; slopes (8,) its derivatives in them"""
    num = controls.shape[1]
    own, lean, other, lean_other = room
    k = spline_weights(x, frames[a, 2], frames[a, 3], num, own, lean)
    f = slope = 0.0
    for q in range(ORDER):
        f += own[q] * controls[a, k + q]
        slope += lean[q] * controls[a, k + q]
    cos = frames[a, 0] * frames[b, 0] + frames[a, 1] * frames[b, 1]
    sin = frames[a, 1] * frames[b, 0] - frames[a, 0] * frames[b, 1]
    bx, by = cos * x - sin * f, sin * x + cos * f
    if not frames[b, 2] <= bx <= frames[b, 2] + frames[b, 3] * (num - ORDER + 1):
        return np.inf
    j = spline_weights(bx, frames[b, 2], frames[b, 3], num, other, lean_other)
    step, slope_other = by, 0.0
    for q in range(ORDER):
        step -= other[q] * controls[b, j + q]
        slope_other += lean_other[q] * controls[b, j + q]
    length = math.sqrt(1.0 + slope * slope)
    across = (cos - sin * slope) / length  # n_A . e_y of B's frame
    turn = -(sin + cos * slope) / length**3 * step
    for q in range(ORDER):
        index[q], index[ORDER + q] = a * num + k + q, b * num + j + q
        slopes[q] = across * (cos + sin * slope_other) * own[q] + turn * lean[q]
        slopes[ORDER + q] = -across * other[q]
    return across * step


@nb.njit(error_model="numpy")
def add_square(residual, index, slopes, num, hessian, gradient):  # type: ignore[no-untyped-def]
    """Add a residual that depends on `num` numbers; returns its cost."""
    for p in range(num):
        gradient[index[p]] += slopes[p] * residual
        for q in range(num):
            hessian[index[p], index[q]] += slopes[p] * slopes[q]
    return 0.5 * residual * residual


@nb.njit(cache=True, error_model="numpy")
def add_points(controls, controls_at, weights, y, std, hessian, gradient):  # type: ignore[no-untyped-def]
    """Add e1 of all points; returns their cost.

    controls (L, n); controls_at (N, 4) those, of all, that count at each point, with weights (N, 4); y (N,)"""
    flat, slopes, cost = controls.reshape(-1), np.empty(ORDER), 0.0
    for i in range(len(y)):
        residual = y[i]
        for q in range(ORDER):
            residual -= weights[i, q] * flat[controls_at[i, q]]
            slopes[q] = -weights[i, q] / std
        cost += add_square(residual / std, controls_at[i], slopes, ORDER, hessian, gradient)
    return cost


@nb.njit(cache=True, error_model="numpy")
def add_neighbours(controls, frames, pairs, at, width, delta, std, hessian, gradient):  # type: ignore[no-untyped-def]
    """Add e2 at `at` (P,) on lane pairs[:, 0] against lane pairs[:, 1]; returns its cost."""
    room, index, slopes, cost = np.empty((4, ORDER)), np.empty(2 * ORDER, np.int64), np.empty(2 * ORDER), 0.0
    for i in range(len(at)):
        d = spline_distance(controls, frames, pairs[i, 0], pairs[i, 1], at[i], room, index, slopes)
        residual, rise = tie(d, width, delta)
        if rise != 0.0 or residual != 0.0:
            for q in range(2 * ORDER):
                slopes[q] *= rise / std
            cost += add_square(residual / std, index, slopes, 2 * ORDER, hessian, gradient)
    return cost
