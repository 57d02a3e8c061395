"""Halves that follow the latent centre, as [M20] splits tracks: at the point closest to the centre.

The split is a function of the centre alone (a table on a 2 m grid), never of a search that remembers."""

from __future__ import annotations

import numba as nb
import numpy as np

from models.intersection import moments as mo
from models.intersection.halves import closest_index

CELL = 2.0  # [m]
SIDE = 17  # cells along each axis
REACH = 16.0  # [m] from the origin to the outermost cell
NUM_CELLS = SIDE * SIDE
NUM_SUMS = 8  # 1, x, y, xx, xy, yy, phi, phi phi


@nb.njit
def cell_of(cx, cy):  # type: ignore[no-untyped-def]
    """Grid cell of a centre; centres outside the grid use its border."""
    i = min(max(int(np.rint((cx + REACH) / CELL)), 0), SIDE - 1)
    j = min(max(int(np.rint((cy + REACH) / CELL)), 0), SIDE - 1)
    return i * SIDE + j


@nb.njit(cache=True)
def split_table(path, offsets):  # type: ignore[no-untyped-def]
    """Index within each track of the point closest to each cell, (NUM_CELLS * T,)."""
    num = len(offsets) - 1
    table = np.empty(NUM_CELLS * num, np.int64)
    for cell in range(NUM_CELLS):
        x, y = (cell // SIDE) * CELL - REACH, (cell % SIDE) * CELL - REACH
        for t in range(num):
            table[cell * num + t] = closest_index(path, offsets[t], offsets[t + 1], x, y) - offsets[t]
    return table


@nb.njit(cache=True)
def prefix_sums(points, offsets):  # type: ignore[no-untyped-def]
    """Running sums along each track, (N + T, 8): track t starts with a row of zeros at offsets[t] + t."""
    num = len(offsets) - 1
    sums = np.zeros((offsets[num] + num, NUM_SUMS))
    for t in range(num):
        row = offsets[t] + t
        for i in range(offsets[t], offsets[t + 1]):
            x, y, p = points[0, i], points[1, i], points[2, i]
            terms = (1.0, x, y, x * x, x * y, y * y, p, p * p)
            for f in range(NUM_SUMS):
                sums[row + 1, f] = sums[row, f] + terms[f]
            row += 1
    return sums


@nb.njit
def half_ranges(table, offsets, cell, margin, begin, end):  # type: ignore[no-untyped-def]
    """Points of the 2 T halves for a cell, `margin` points left out on either side of the split."""
    num = len(offsets) - 1
    for t in range(num):
        k = table[cell * num + t]
        begin[t], end[t] = offsets[t], offsets[t] + max(k - margin, 0)
        begin[num + t], end[num + t] = min(offsets[t] + k + margin, offsets[t + 1]), offsets[t + 1]


@nb.njit
def cell_coefficients(sums, offsets, begin, end, position, heading, observed, fixed, out):  # type: ignore[no-untyped-def]
    """Coefficients (19, 2 T) of straight lanes for halves begin:end, from differences of the running sums."""
    num = len(offsets) - 1
    observed[:] = 0.0
    fixed[:] = 0.0
    for h in range(2 * num):
        t = h % num
        first, last = begin[h] + t, end[h] + t
        n = float(last - first)
        fixed[mo.COUNT, h] = n
        if n < 1.0:
            continue
        d = sums[last] - sums[first]
        mx, my, mp = d[1] / n, d[2] / n, d[6] / n
        observed[mo.MX, h], observed[mo.MY, h], observed[mo.MPHI, h] = mx, my, mp
        observed[mo.CXX, h] = d[3] - n * mx * mx
        observed[mo.CXY, h] = d[4] - n * mx * my
        observed[mo.CYY, h] = d[5] - n * my * my
        observed[mo.CPP, h] = d[7] - n * mp * mp
    mo.coefficients(observed, fixed, num, position, np.inf, 0.0, np.inf, heading, out)
