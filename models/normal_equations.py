"""Normal equations from residuals that are columns of numbers, in machine code."""

import numba as nb

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
