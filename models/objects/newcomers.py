"""Machine code that lays out the components of newcomers: every kind at every heading that is possible."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def lay_out(number, position, covariance, heading, heading_std, entry, loc, std, share):  # type: ignore[no-untyped-def]
    """Components (offset, weight, kind, mean, covariance) of B newcomers, C kinds and H headings each, in this order.

    number      (B,) that their weights sum to, shared out by `share` (C,), and by headings alike
    position    (B, 2) and covariance (B, 2, 2)
    heading     (B, H) and its standard deviation (B,), of entry `entry` of the state; not used where that is -1
    loc, std    (C, B, n) of the rest of the state, or (C, 1, n) for all"""
    B, H, C, n = len(number), heading.shape[1], len(share), loc.shape[2]
    own = 1 if loc.shape[1] > 1 else 0
    total = B * C * H
    offset, kind, weight = C * H * np.arange(B + 1), np.empty(total, np.int64), np.empty(total)
    mean, spread = np.empty((total, n)), np.zeros((total, n, n))
    at = 0
    for b in range(B):
        for k in range(C):
            for h in range(H):
                weight[at], kind[at] = number[b] * share[k] / H, k
                for i in range(n):
                    mean[at, i] = loc[k, b * own, i]
                    spread[at, i, i] = std[k, b * own, i] ** 2
                for i in range(2):
                    mean[at, i] = position[b, i]
                    for j in range(2):
                        spread[at, i, j] = covariance[b, i, j]
                if entry >= 0:
                    mean[at, entry], spread[at, entry, entry] = heading[b, h], heading_std[b] ** 2
                at += 1
    return offset, weight, kind, mean, spread
