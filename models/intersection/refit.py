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
from models.intersection.density import NO_LANE, lane_number
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
    z_new[:] = z
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


@nb.njit(cache=True, error_model="numpy")
def add_square(block, slopes, first, last, residual, weight):  # type: ignore[no-untyped-def]
    """Add weight / 2 residual^2, sloping in unknowns first:last of an arm, to its block: hessian, gradient on top."""
    for i in range(first, last):
        pull = weight * slopes[i]
        block[LOCAL, i] += residual * pull
        for j in range(first, i + 1):
            block[i, j] += pull * slopes[j]


@nb.njit(cache=True, error_model="numpy")
def add_half(coef, h, lane, z, arm, dx, dy, block, slopes):  # type: ignore[no-untyped-def]
    """Add the cost of one half track on one lane of an arm with direction (dx, dy) to the arm's block.

    block (LOCAL + 1, LOCAL) lower triangle over (c; angle, gap, width, bend, shift), then the gradient"""
    o = HEAD + arm * ARM
    bend, side = z[o + BEND], coef[mo.SIDE, h]
    rx, ry = coef[mo.X, h] - z[1], coef[mo.Y, h] - z[2]
    across, along = -dy * rx + dx * ry, dx * rx + dy * ry
    slopes[0], slopes[1], slopes[2] = dy, -dx, -along
    slopes[3], slopes[4], slopes[5], slopes[6] = -0.5 * side, -side * (lane + 0.5), -coef[mo.T, h], -1.0
    target = z[o + SHIFT] + bend * coef[mo.T, h] + side * (0.5 * z[o + GAP] + (lane + 0.5) * z[o + WIDTH])
    add_square(block, slopes, 0, LOCAL, across - target, coef[mo.W_ACROSS, h])
    if coef[mo.W_ALONG, h] > 0.0:
        slopes[0], slopes[1], slopes[2] = -dx, -dy, across
        add_square(block, slopes, 0, 3, along - coef[mo.S, h], coef[mo.W_ALONG, h])
    if coef[mo.W_HEADING, h] > 0.0:
        lever = coef[mo.S, h] - 0.5 * CHORD
        slopes[2], slopes[3], slopes[4], slopes[5] = -1.0, 0.0, 0.0, -lever
        turn = wrap(coef[mo.OUTGOING, h] - z[o + ANGLE] - bend * lever)
        add_square(block, slopes, 2, 6, turn, coef[mo.W_HEADING, h])
    a, b = 2, 5  # scatter: angle and bend
    twist = dx * coef[mo.A_KY, h] + dy * coef[mo.A_KX, h]
    block[LOCAL, a] += 2 * dx * dy * (coef[mo.A_YY, h] - coef[mo.A_XX, h]) + (dx * dx - dy * dy) * coef[mo.A_XY, h]
    block[LOCAL, a] += dx * coef[mo.A_Y, h] - dy * coef[mo.A_X, h] + bend * twist
    block[LOCAL, b] += dy * coef[mo.A_KY, h] - dx * coef[mo.A_KX, h] + coef[mo.A_K, h] + 2 * bend * coef[mo.A_KK, h]
    curve = 2 * (dx * dx - dy * dy) * (coef[mo.A_YY, h] - coef[mo.A_XX, h]) - 4 * dx * dy * coef[mo.A_XY, h]
    curve -= dx * coef[mo.A_X, h] + dy * coef[mo.A_Y, h]
    block[a, a] += max(curve, 0.0)
    block[b, a] += twist
    block[b, b] += 2 * coef[mo.A_KK, h]


@nb.njit(cache=True, error_model="numpy")
def assemble(blocks, hessian, gradient):  # type: ignore[no-untyped-def]
    """The model of all unknowns, (c; five of every arm), from the blocks of the arms."""
    hessian[:] = 0.0
    gradient[:] = 0.0
    for a in range(len(blocks)):
        for i in range(LOCAL):
            row = i if i < 2 else i + FREE * a
            gradient[row] += blocks[a, LOCAL, i]
            for j in range(i + 1):
                hessian[row, j if j < 2 else j + FREE * a] += blocks[a, i, j]


@nb.njit(cache=True, error_model="numpy")
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


@nb.njit(cache=True, error_model="numpy")
def hold(hessian, gradient, i):  # type: ignore[no-untyped-def]
    """Take an unknown out of the system: its step is zero."""
    hessian[i, :i] = 0.0
    hessian[i + 1 :, i] = 0.0
    hessian[i, i], gradient[i] = 1.0, 0.0


@nb.njit(cache=True, error_model="numpy")
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


@nb.njit(cache=True, error_model="numpy")
def quadratic_model(z, coef, stray, rows, pick, floats, hessian, gradient):  # type: ignore[no-untyped-def]
    """Hessian (lower triangle) and gradient of -log p at z, halves on their closest lanes; stray halves say nothing."""
    num = int(z[0])
    blocks, slopes, directions = np.zeros((num, LOCAL + 1, LOCAL)), np.empty(LOCAL), np.empty((num, 2))
    for a in range(num):
        angle = z[HEAD + a * ARM + ANGLE]
        directions[a, 0], directions[a, 1] = math.cos(angle), math.sin(angle)
    for h in range(coef.shape[1]):
        low, arm = NO_LANE, num
        for a in range(num):
            if rows[int(pick[a]), a, h] < low:
                low, arm = rows[int(pick[a]), a, h], a
        if low < NO_LANE and low < stray[h]:
            lane = lane_number(coef, h, z[1], z[2], z[HEAD + arm * ARM : HEAD + (arm + 1) * ARM])
            dx, dy = directions[arm, 0], directions[arm, 1]
            add_half(coef, h, lane, z, arm, dx, dy, blocks[arm], slopes)
    assemble(blocks, hessian, gradient)
    add_prior(z, floats, hessian, gradient)


@nb.njit(cache=True, error_model="numpy")
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
