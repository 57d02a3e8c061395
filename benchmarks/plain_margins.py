"""The kernel of limits written by hand, as one would without a formula: what the emitted one is compared with."""

from __future__ import annotations

import math

from numba import njit


@njit(error_model="numpy")
def margins(ds, dds, kappa, slope, d, dd, ddd, speed, acceleration, power, braking, lateral, curvature):  # type: ignore[no-untyped-def]
    """The same twelve numbers as planning.kinematics.MARGINS."""
    w = 1.0 - kappa * d
    turn = kappa * ds
    vx = ds * w
    ax = dds * w - ds * (slope * ds * d + kappa * dd) - turn * dd
    ay = ddd + turn * vx
    squared = vx * vx + dd * dd + 1e-12
    v = math.sqrt(squared)
    along = (vx * ax + dd * ay) / v
    cross = vx * ay - dd * ax
    cube = squared * v
    slack = 1e-6
    sides, bends = lateral * v + slack, curvature * cube + slack
    return (
        ds + slack,
        w - 0.1 + slack,
        speed - v + slack,
        acceleration - along + slack,
        power - along * v + slack,
        braking + along + slack,
        sides - cross,
        sides + cross,
        bends - cross,
        bends + cross,
        v,
        cross / cube,
    )
