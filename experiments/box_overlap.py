"""How much upright boxes overlap: intersection over union of their volumes, in machine code.

    IoU(a, b) = V / (V_a + V_b - V),   V = (area both bottoms share) (height both share)

The bottoms are rectangles turned against each other. That of b is laid into the frame of a, where a's sides are
parallel to the axes, and cut at each of them (Sutherland and Hodgman 1974); the shoelace formula gives what is left.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MOST_CORNERS = 9  # of two rectangles' intersection: 8, and one more while it is cut


@nb.njit(error_model="numpy")
def cut(points, n, axis, sign, limit, out):  # type: ignore[no-untyped-def]
    """Corners of a convex polygon with sign * coordinate <= limit, into out; how many there are."""
    m = 0
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        here, there = limit - sign * points[i, axis], limit - sign * points[j, axis]
        if here >= 0.0:
            out[m, 0], out[m, 1] = points[i, 0], points[i, 1]
            m += 1
        if (here >= 0.0) != (there >= 0.0):
            t = here / (here - there)
            out[m, 0] = points[i, 0] + t * (points[j, 0] - points[i, 0])
            out[m, 1] = points[i, 1] + t * (points[j, 1] - points[i, 1])
            m += 1
    return m


@nb.njit(error_model="numpy")
def shared_area(a, b, one, two):  # type: ignore[no-untyped-def]
    """Area that the bottoms of two boxes share [m^2]; one and two are (MOST_CORNERS, 2) of scratch."""
    c, s = math.cos(a[6]), math.sin(a[6])
    dx, dz = b[3] - a[3], b[5] - a[5]
    x, z = c * dx - s * dz, s * dx + c * dz  # b's middle along a's length and width
    c, s = math.cos(b[6] - a[6]), math.sin(b[6] - a[6])
    for i in range(4):
        along = 0.5 * b[2] if i < 2 else -0.5 * b[2]
        across = 0.5 * b[1] if i == 1 or i == 2 else -0.5 * b[1]
        one[i, 0], one[i, 1] = x + c * along + s * across, z - s * along + c * across
    n = cut(one, 4, 0, 1.0, 0.5 * a[2], two)
    n = cut(two, n, 0, -1.0, 0.5 * a[2], one)
    n = cut(one, n, 1, 1.0, 0.5 * a[1], two)
    n = cut(two, n, 1, -1.0, 0.5 * a[1], one)
    twice = 0.0
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        twice += one[i, 0] * one[j, 1] - one[j, 0] * one[i, 1]
    return 0.5 * abs(twice)


@nb.njit(cache=True, error_model="numpy")
def fill_overlap(a, b, out):  # type: ignore[no-untyped-def]
    """IoU of each box of a (N, 7) with each of b (M, 7) into out (N, M)."""
    one, two = np.empty((MOST_CORNERS, 2)), np.empty((MOST_CORNERS, 2))
    for i in range(len(a)):
        for j in range(len(b)):
            out[i, j] = 0.0
            reach = 0.5 * (math.hypot(a[i, 1], a[i, 2]) + math.hypot(b[j, 1], b[j, 2]))
            tall = min(a[i, 4], b[j, 4]) - max(a[i, 4] - a[i, 0], b[j, 4] - b[j, 0])
            if tall <= 0.0 or math.hypot(b[j, 3] - a[i, 3], b[j, 5] - a[i, 5]) >= reach:
                continue
            shared = tall * shared_area(a[i], b[j], one, two)
            union = a[i, 0] * a[i, 1] * a[i, 2] + b[j, 0] * b[j, 1] * b[j, 2] - shared
            out[i, j] = min(shared / union, 1.0)


def overlap(a: Floats, b: Floats) -> Floats:
    """IoU (N, M) of boxes a (N, 7) and b (M, 7), rows of experiments.kitti_boxes in one frame."""
    out = np.empty((len(a), len(b)))
    fill_overlap(np.ascontiguousarray(a, dtype=np.float64), np.ascontiguousarray(b, dtype=np.float64), out)
    return out
