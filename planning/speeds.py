"""The speed wanted along a route: lane limits, curves, and what must be stood before, reached by comfortable braking.

v(s) = min over s' >= s of sqrt(v_max(s')^2 + 2 b (s' - s - v lag)+),   v_max(s')^2 |kappa(s')| = a_lat
"""

from __future__ import annotations

import math

import numpy as np

from planning.road import Route

SPACING = 1.0  # of the places looked at [m]
STRAIGHT = 1e-6  # curvature below it is none [1/m]


def speed_ahead(
    route: Route, s: float, speed: float, *, braking: float, lag: float, lateral_acceleration: float, ahead: float
) -> float:
    """Wanted at s by one who drives `speed`, from limits and curves up to `ahead` [m]."""
    way = np.arange(0.0, ahead, SPACING)
    kappa = np.abs(route.line.at(np.minimum(s + way, route.line.length))[:, 3])
    most = np.minimum(route.limit_at(s + way), np.sqrt(lateral_acceleration / np.maximum(kappa, STRAIGHT)))
    return float(np.sqrt(most**2 + 2 * braking * np.maximum(way - speed * lag, 0.0)).min())


def speed_before(way: float, speed: float, *, braking: float, lag: float) -> float:
    """From which one who drives `speed` brakes comfortably to rest within a way [m, m/s]."""
    return math.sqrt(2 * braking * max(way - speed * lag, 0.0))
