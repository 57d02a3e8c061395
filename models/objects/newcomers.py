"""Machine code that lays out the components of newcomers: where they are, every kind at every heading that is
possible."""

from __future__ import annotations

import math

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


@njit(cache=True, error_model="numpy")
def from_polar(values, noise, at):  # type: ignore[no-untyped-def]
    """Positions (M, 2) in the world of what is at ranges and bearings, the first of values (M, d), from a pose (3,),
    and their covariances (M, 2, 2) = J R J' where those of the values are noise (M, d, d)."""
    num = len(values)
    position, covariance = np.empty((num, 2)), np.empty((num, 2, 2))
    for i in range(num):
        distance, angle = values[i, 0], values[i, 1] + at[2]
        cos, sin = math.cos(angle), math.sin(angle)
        a, b, c, d = cos, -distance * sin, sin, distance * cos  # J, by rows
        R, S, T = noise[i, 0, 0], noise[i, 0, 1], noise[i, 1, 1]
        position[i, 0], position[i, 1] = at[0] + distance * cos, at[1] + distance * sin
        covariance[i, 0, 0] = a * a * R + 2.0 * a * b * S + b * b * T
        covariance[i, 1, 1] = c * c * R + 2.0 * c * d * S + d * d * T
        covariance[i, 0, 1] = covariance[i, 1, 0] = a * c * R + (a * d + b * c) * S + b * d * T
    return position, covariance
