"""Normal equations from residuals that are columns of numbers, in machine code."""

import numba as nb
import numpy as np

FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}


@nb.njit(fastmath=FAST, error_model="numpy")
def square_columns(columns, n, block):  # type: ignore[no-untyped-def]
    """Gauss-Newton Hessian J^T J of D numbers and, in the row below, the gradient J^T r: block (D + 1, D).

    columns (D + 1, .): the first n columns hold the slopes of one residual each and, last, the residual itself, all
    times the root of its weight. Only the lower triangle of the Hessian is filled."""
    for i in range(len(columns)):
        left = columns[i, :n]
        for j in range(min(i + 1, len(columns) - 1)):
            right, total = columns[j, :n], 0.0
            for k in range(n):
                total += left[k] * right[k]
            block[i, j] = total


@nb.njit(fastmath=FAST, error_model="numpy")
def add_columns(columns, n, block):  # type: ignore[no-untyped-def]
    """Add what `square_columns` fills. Numbers without a slope in any of the columns cost next to nothing."""
    moving, num = np.empty(len(columns), np.int64), 0
    for i in range(len(columns)):
        for k in range(n):
            if columns[i, k] != 0.0:
                moving[num] = i
                num += 1
                break
    for a in range(num):
        left = columns[moving[a], :n]
        for b in range(a + 1):
            if moving[b] == len(columns) - 1:
                break
            right, total = columns[moving[b], :n], 0.0
            for k in range(n):
                total += left[k] * right[k]
            block[moving[a], moving[b]] += total
