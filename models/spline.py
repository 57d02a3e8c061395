"""Uniform cubic B-splines: values and slopes (de Boor 1978, chapter IX).

    f(x) = sum_i c_i N_i(x),   knots first + k spacing

n controls make n - 3 pieces. On piece k, u = (x - first) / spacing - k in [0, 1], four controls count, k to k + 3:

    N = ((1 - u)^3, 3 u^3 - 6 u^2 + 4, -3 u^3 + 3 u^2 + 3 u + 1, u^3) / 6

The outer pieces go on beyond the first and the last knot.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
ORDER = 4  # controls that count on a piece


@nb.njit(error_model="numpy")
def spline_weights(x, first, spacing, num, weights, slopes):  # type: ignore[no-untyped-def]
    """N (4,) and dN/dx (4,) of the controls that count at x, of `num`; returns the first of these controls."""
    piece = min(max(int(math.floor((x - first) / spacing)), 0), num - ORDER)  # noqa: RUF046
    u = (x - first) / spacing - piece
    w = 1.0 - u
    weights[0], weights[3] = w * w * w / 6.0, u * u * u / 6.0
    weights[1] = (3.0 * u * u * (u - 2.0) + 4.0) / 6.0
    weights[2] = (3.0 * w * w * (w - 2.0) + 4.0) / 6.0
    slopes[0], slopes[3] = -0.5 * w * w / spacing, 0.5 * u * u / spacing
    slopes[1], slopes[2] = (1.5 * u - 2.0) * u / spacing, (2.0 - 1.5 * w) * w / spacing
    return piece


@nb.njit(error_model="numpy")
def spline_bows(x, first, spacing, num, bows):  # type: ignore[no-untyped-def]
    """d2N/dx2 (4,) of the controls that count at x."""
    u = (x - first) / spacing - min(max(int(math.floor((x - first) / spacing)), 0), num - ORDER)  # noqa: RUF046
    bows[0], bows[1], bows[2], bows[3] = 1.0 - u, 3.0 * u - 2.0, 1.0 - 3.0 * u, u
    for k in range(ORDER):
        bows[k] /= spacing**2


@nb.njit(cache=True, error_model="numpy")
def _fill(x, first, spacing, num, pieces, weights, slopes):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        pieces[i] = spline_weights(x[i], first, spacing, num, weights[i], slopes[i])


def basis(x: Array, first: float, spacing: float, num: int) -> tuple[Ints, Array, Array]:
    """For x (N,): the first of the four controls that count (N,), their weights (N, 4) and slopes (N, 4)."""
    pieces, weights, slopes = np.empty(len(x), np.int64), np.empty((len(x), ORDER)), np.empty((len(x), ORDER))
    _fill(np.ascontiguousarray(x, dtype=np.float64), float(first), float(spacing), num, pieces, weights, slopes)
    return pieces, weights, slopes


def evaluate(controls: Array, first: float, spacing: float, x: Array) -> Array:
    """f at x (N,) of a spline with controls (n,)."""
    pieces, weights, _ = basis(x, first, spacing, len(controls))
    return np.asarray((controls[pieces[:, None] + np.arange(ORDER)] * weights).sum(1))
