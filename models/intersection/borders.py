"""Where the borders of neighbouring arms meet: there the interior of an intersection begins."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
BEYOND = 2.0  # from where borders meet to the interior [m]
NEAREST, FARTHEST = 8.0, 32.0  # [m]


def interior_radius(angle: Floats, left: Floats, right: Floats) -> Floats:
    """Where the interior begins on each arm, (K,) [m]: 2 m beyond the farthest point where its
    border meets a neighbour's, within 8 to 32 m.

    left, right  (K,) distance from the axis of the arm to its borders, looking outward [m]

    With th the angle between an arm and the next one counter-clockwise, the left border of the one
    meets the right border of the other at (right + left cos th) / sin th along the one and
    (left + right cos th) / sin th along the other."""
    order = np.argsort(angle % (2 * np.pi))
    radius = np.full(len(angle), NEAREST)
    for a, b in zip(order, np.roll(order, -1), strict=True):
        between = (angle[b] - angle[a]) % (2 * np.pi)
        if 0.0 < between < np.pi - 0.05:  # borders of opposite arms do not meet
            sin, cos = np.sin(between), np.cos(between)
            radius[a] = max(radius[a], (right[b] + left[a] * cos) / sin)
            radius[b] = max(radius[b], (left[a] + right[b] * cos) / sin)
    return np.clip(radius + BEYOND, NEAREST, FARTHEST)
