"""Machine code of boundary lines: which segments a circle may touch, cell by cell, and whether it does."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(error_model="numpy")
def squared_distance(segment, n, x, y):  # type: ignore[no-untyped-def]
    """From (x, y) to segment n [m^2]."""
    ax, ay = segment[n, 0], segment[n, 1]
    ux, uy = segment[n, 2] - ax, segment[n, 3] - ay
    length2 = ux * ux + uy * uy
    t = ((x - ax) * ux + (y - ay) * uy) / length2 if length2 > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    dx, dy = x - ax - t * ux, y - ay - t * uy
    return dx * dx + dy * dy


@njit(cache=True, error_model="numpy")
def bucket(segment, origin, shape, cell, reach):  # type: ignore[no-untyped-def]
    """offset, member: a segment is a member of each cell whose middle is within reach + half a diagonal."""
    far = (reach + cell * math.sqrt(0.5)) ** 2
    offset = np.zeros(shape[0] * shape[1] + 1, np.int64)
    member = np.empty(0, np.int64)
    for fill in range(2):
        if fill:
            for c in range(len(offset) - 1):
                offset[c + 1] += offset[c]
            member = np.empty(offset[-1], np.int64)
        for n in range(len(segment)):
            lower, upper = np.empty(2, np.int64), np.empty(2, np.int64)
            for k in range(2):
                low, high = min(segment[n, k], segment[n, k + 2]), max(segment[n, k], segment[n, k + 2])
                lower[k] = max(int((low - reach - origin[k]) / cell) - 1, 0)
                upper[k] = min(int((high + reach - origin[k]) / cell) + 1, shape[k] - 1)
            for i in range(lower[0], upper[0] + 1):
                for j in range(lower[1], upper[1] + 1):
                    x, y = origin[0] + (i + 0.5) * cell, origin[1] + (j + 0.5) * cell
                    if squared_distance(segment, n, x, y) <= far:
                        c = i * shape[1] + j
                        if fill:
                            offset[c + 1] -= 1  # from the end of cell c's members to their start
                            member[offset[c + 1]] = n
                        else:
                            offset[c + 1] += 1
    return np.append(offset[1:], len(member)), member


@njit(error_model="numpy")
def first_line(pose, lines, circles, radius):  # type: ignore[no-untyped-def]
    """The first step at which a circle touches a line, or K.

    pose (4, K): x, y, cos and sin of the heading; lines: of planning.shapes.Boundary, without its reach; circles (n,)
    ahead along the heading, of radius <= reach."""
    segment, origin, shape, offset, member, cell = lines
    if len(segment) == 0:
        return pose.shape[1]
    x0, y0, columns, rows = origin[0], origin[1], shape[0], shape[1]
    for k in range(pose.shape[1]):
        for n in range(len(circles)):
            x, y = pose[0, k] + circles[n] * pose[2, k], pose[1, k] + circles[n] * pose[3, k]
            u, v = (x - x0) / cell, (y - y0) / cell
            if u >= 0.0 and v >= 0.0 and u < columns and v < rows:
                c = int(u) * rows + int(v)
                for q in range(offset[c], offset[c + 1]):
                    if squared_distance(segment, member[q], x, y) <= radius * radius:
                        return k
    return pose.shape[1]
