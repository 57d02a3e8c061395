"""Gauss-Newton on the continuous numbers of an intersection, and edits of its structure, in machine code.

With every half track on its closest lane, the cost is a sum of squares of

    across   n . (mean - c) - shift - bend T - side (gap / 2 + (lane + 1/2) width)
    along    d . (mean - c) - S
    heading  phi - alpha - (pi if incoming) - bend (S - CHORD / 2)

and of the scatter cost of moments.py, all functions of (c; alpha, gap, width, bend, shift of each arm). Edits
change lane counts the way a wrong inner or outer lane would be mended; a refit then lets all else follow."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.intersection import moments as mo
from models.intersection.density import lane_number
from models.intersection.moments import CHORD
from models.intersection.moves import LEVER
from models.intersection.packing import ANGLE, ARM, BEND, ENTRIES, EXITS, GAP, HEAD, SHIFT, WIDTH
from models.intersection.prior import (
    BEND_STD,
    CENTRE_STD,
    GAP_MAX,
    LOG_WIDTH,
    SHIFT_STD,
    WIDTH_SPREAD,
    lanes_fit,
)
from models.intersection.wrap import wrap
from models.normal_equations import square_columns
from models.overwrite import overwrite

FREE = 5  # continuous numbers of an arm
LOCAL = 2 + FREE  # those that the cost of a half on an arm depends on
FREE_FIELDS = np.array([ANGLE, GAP, WIDTH, BEND, SHIFT])
LEAST_WIDTH = 0.5  # [m]
FARTHEST = np.array([0.1, 1.5, 0.5, 0.005, 1.0])  # largest step of each

# (entries, exits, gap in widths, axis in widths, keep the span) of the edits of an arm: outer lanes, inner lanes,
# lanes that change sides, and lanes that share the width that the side had before
EDITS = np.array(
    [
        (1, 0, 0, 0, 0),
        (-1, 0, 0, 0, 0),
        (0, 1, 0, 0, 0),
        (0, -1, 0, 0, 0),
        (1, 0, -1, -0.5, 0),
        (-1, 0, 1, 0.5, 0),
        (0, 1, -1, 0.5, 0),
        (0, -1, 1, -0.5, 0),
        (1, -1, 0, -1, 0),
        (-1, 1, 0, 1, 0),
        (-1, -1, 2, 0, 0),
        (1, 0, 0, 0, 1),
        (-1, 0, 0, 0, 1),
        (0, 1, 0, 0, 1),
        (0, -1, 0, 0, 1),
    ],
    dtype=np.float64,
)
EDITS_PER_ARM = len(EDITS)


def edit(index, z, floats, z_new):  # type: ignore[no-untyped-def]
    """Edit number `index` of a state; False where it does not apply."""
    arm, kind = index // EDITS_PER_ARM, index % EDITS_PER_ARM
    if arm >= int(z[0]):
        return False
    overwrite(z_new, z)
    o = HEAD + arm * ARM
    change = EDITS[kind]
    z_new[o + ENTRIES] += change[0]
    z_new[o + EXITS] += change[1]
    z_new[o + GAP] = min(max(z[o + GAP] + change[2] * z[o + WIDTH], 0.0), floats[GAP_MAX])
    axis = change[3] * z[o + WIDTH]
    if change[4] > 0.0:
        side = o + ENTRIES if change[0] != 0.0 else o + EXITS
        if floats[WIDTH_SPREAD] == 0.0 or z[side] * z_new[side] < 0.5:
            return False
        z_new[o + WIDTH] *= z[side] / z_new[side]
    if abs(axis) < 2.0 * floats[SHIFT_STD]:
        z_new[o + SHIFT] += axis
    else:
        z_new[o + ANGLE] = wrap(z[o + ANGLE] + axis / LEVER)
    return lanes_fit(z_new[o + ENTRIES], z_new[o + EXITS], floats)


@nb.njit(error_model="numpy")
def write_residuals(coef, h, cx, cy, dx, dy, arm, columns, n):  # type: ignore[no-untyped-def]
    """Write the three residuals of one half track on its lane of an arm of direction (dx, dy) as columns n to n + 2.

    columns (LOCAL + 1, .): slopes in (c; angle, gap, width, bend, shift), then the residual itself, all times the
    root of the weight"""
    bend, side = arm[BEND], coef[mo.SIDE, h]
    middle = lane_number(coef, h, cx, cy, dx, dy, arm) + 0.5
    rx, ry = coef[mo.X, h] - cx, coef[mo.Y, h] - cy
    across, along = -dy * rx + dx * ry, dx * rx + dy * ry
    target = arm[SHIFT] + bend * coef[mo.T, h] + side * (0.5 * arm[GAP] + middle * arm[WIDTH])
    root = math.sqrt(coef[mo.W_ACROSS, h])
    columns[0, n], columns[1, n], columns[2, n], columns[3, n] = (
        root * dy,
        -root * dx,
        -root * along,
        -0.5 * root * side,
    )
    columns[4, n], columns[5, n], columns[6, n] = -root * side * middle, -root * coef[mo.T, h], -root
    columns[7, n] = root * (across - target)
    for i in range(3, LOCAL):
        columns[i, n + 1] = columns[i, n + 2] = 0.0
    root = math.sqrt(coef[mo.W_ALONG, h])
    columns[0, n + 1], columns[1, n + 1], columns[2, n + 1] = -root * dx, -root * dy, root * across
    columns[7, n + 1] = root * (along - coef[mo.S, h])
    root, lever = math.sqrt(coef[mo.W_HEADING, h]), coef[mo.S, h] - 0.5 * CHORD
    columns[0, n + 2], columns[1, n + 2], columns[2, n + 2], columns[5, n + 2] = 0.0, 0.0, -root, -root * lever
    columns[7, n + 2] = root * wrap(coef[mo.OUTGOING, h] - arm[ANGLE] - bend * lever)


@nb.njit(error_model="numpy")
def add_scatter(coef, h, bend, dx, dy, block):  # type: ignore[no-untyped-def]
    """Add the scatter cost of one half to the block of its arm: in the angle and the bend."""
    a, b = 2, 5
    twist = dx * coef[mo.A_KY, h] + dy * coef[mo.A_KX, h]
    block[LOCAL, a] += 2 * dx * dy * (coef[mo.A_YY, h] - coef[mo.A_XX, h]) + (dx * dx - dy * dy) * coef[mo.A_XY, h]
    block[LOCAL, a] += dx * coef[mo.A_Y, h] - dy * coef[mo.A_X, h] + bend * twist
    block[LOCAL, b] += dy * coef[mo.A_KY, h] - dx * coef[mo.A_KX, h] + coef[mo.A_K, h] + 2 * bend * coef[mo.A_KK, h]
    curve = 2 * (dx * dx - dy * dy) * (coef[mo.A_YY, h] - coef[mo.A_XX, h]) - 4 * dx * dy * coef[mo.A_XY, h]
    curve -= dx * coef[mo.A_X, h] + dy * coef[mo.A_Y, h]
    block[a, a] += max(curve, 0.0)
    block[b, a] += twist
    block[b, b] += 2 * coef[mo.A_KK, h]


@nb.njit(error_model="numpy")
def add_block(block, arm, hessian, gradient):  # type: ignore[no-untyped-def]
    """Add the block of an arm to the model of all unknowns, (c; five of every arm)."""
    for i in range(LOCAL):
        row = i if i < 2 else i + FREE * arm
        gradient[row] += block[LOCAL, i]
        for j in range(i + 1):
            hessian[row, j if j < 2 else j + FREE * arm] += block[i, j]


@nb.njit(error_model="numpy")
def add_prior(z, floats, hessian, gradient):  # type: ignore[no-untyped-def]
    """Add the negative log prior of the continuous numbers; the row of a constant becomes that of the identity."""
    for j in range(2):
        hessian[j, j] += 1.0 / floats[CENTRE_STD] ** 2
        gradient[j] += z[1 + j] / floats[CENTRE_STD] ** 2
    for a in range(int(z[0])):
        o, first = HEAD + a * ARM, 2 + FREE * a
        hessian[first, first] += 1e-2
        hessian[first + 1, first + 1] += 1e-2
        width, spread = z[o + WIDTH], floats[WIDTH_SPREAD]
        if spread > 0.0:
            hessian[first + 2, first + 2] += 1.0 / (width * spread) ** 2
            gradient[first + 2] += ((math.log(width) - floats[LOG_WIDTH]) / spread**2 + 1.0) / width
        else:
            hold(hessian, gradient, first + 2)
        for j, field, std in ((3, BEND, floats[BEND_STD]), (4, SHIFT, floats[SHIFT_STD])):
            if std > 0.0:
                hessian[first + j, first + j] += 1.0 / std**2
                gradient[first + j] += z[o + field] / std**2
            else:
                hold(hessian, gradient, first + j)


@nb.njit(error_model="numpy")
def hold(hessian, gradient, i):  # type: ignore[no-untyped-def]
    """Take an unknown out of the system: its step is zero."""
    hessian[i, :i] = 0.0
    hessian[i + 1 :, i] = 0.0
    hessian[i, i], gradient[i] = 1.0, 0.0


@nb.njit(error_model="numpy")
def solve_spd(matrix, vector, n):  # type: ignore[no-untyped-def]
    """Solve a symmetric positive definite system of size n in place by Cholesky; False where it is not."""
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                if value <= 0.0:
                    return False
                matrix[i, i] = math.sqrt(value)
            else:
                matrix[i, j] = value / matrix[j, j]
    for i in range(n):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]
    return True


@nb.njit(error_model="numpy")
def quadratic_model(z, coef, stray, rows, pick, floats, hessian, gradient):  # type: ignore[no-untyped-def]
    """Hessian (lower triangle) and gradient of -log p at z, halves on their closest lanes; stray halves say nothing."""
    num, halves = int(z[0]), coef.shape[1]
    columns, block, owner = np.empty((LOCAL + 1, 3 * halves)), np.empty((LOCAL + 1, LOCAL)), np.empty(halves, np.int64)
    hessian[:] = 0.0
    gradient[:] = 0.0
    for h in range(halves):
        low, owner[h] = stray[h], num
        for a in range(num):
            if rows[int(pick[a]), a, h] < low:
                low, owner[h] = rows[int(pick[a]), a, h], a
    for a in range(num):
        arm, n = z[HEAD + a * ARM : HEAD + (a + 1) * ARM], np.int64(0)  # of one type from the start: compiled once
        dx, dy = math.cos(arm[ANGLE]), math.sin(arm[ANGLE])
        for h in range(halves):
            if owner[h] == a:
                write_residuals(coef, h, z[1], z[2], dx, dy, arm, columns, n)
                n += 3
        square_columns(columns, n, block)
        for h in range(halves):
            if owner[h] == a:
                add_scatter(coef, h, arm[BEND], dx, dy, block)
        add_block(block, a, hessian, gradient)
    add_prior(z, floats, hessian, gradient)


@nb.njit(error_model="numpy")
def take_step(z, step, gap_max):  # type: ignore[no-untyped-def]
    """z minus the Newton step, every number within its largest step."""
    for j in range(2):
        z[1 + j] -= min(max(step[j], -3.0), 3.0)
    for a in range(int(z[0])):
        for j in range(FREE):
            i = HEAD + a * ARM + FREE_FIELDS[j]
            z[i] -= min(max(step[2 + FREE * a + j], -FARTHEST[j]), FARTHEST[j])
        o = HEAD + a * ARM
        z[o + ANGLE] = wrap(z[o + ANGLE])
        z[o + GAP] = min(max(z[o + GAP], 0.0), gap_max)
        z[o + WIDTH] = max(z[o + WIDTH], LEAST_WIDTH) if step[4 + FREE * a] != 0.0 else z[o + WIDTH]
