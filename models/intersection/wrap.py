"""Angles on the circle, in machine code."""

from __future__ import annotations

import math

import numba as nb
import numpy as np


@nb.njit
def wrap(angle):  # type: ignore[no-untyped-def]
    """An angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * np.floor(angle / (2.0 * math.pi) + 0.5)
