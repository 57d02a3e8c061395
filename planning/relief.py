"""Relief at borders: who is across one already, or cannot help crossing it, may come back.

A plan that must not touch a line cannot begin on it: such a vehicle would stand for ever. The border is then told
farther out by what is needed, e, and back in its place some way ahead:

    e = max over the circles of (|d| + R - |d of the border|) + max(d'^2 / (2 a), slope^2 / (2 kappa))

with the way that turning back takes to the side, at lateral acceleration a and curvature kappa. Kerbs and walls
(Scene.boundary from elsewhere) get no relief.
"""

from __future__ import annotations

import math

import numpy as np

from planning.frenet import FrenetState
from planning.planner import Planner
from planning.road import Floats, Route

LEFT, RIGHT = 0, 1
LATERAL, CURVATURE = 1.2, 0.12  # of turning back [m/s^2, 1/m]
SPARE = 0.1  # [m]
SPACING = 1.0  # of a border's points [m]


def needed(planner: Planner, route: Route, state: FrenetState, side: int, column: int) -> float:
    """By how much a border, told by a column of Route.edges, is too near [m]; not positive where it is not."""
    turn, sign = math.atan(state.slope), 1.0 if side == LEFT else -1.0
    reach = planner.vehicle.circles
    edges = route.edges_at(state.s + reach * math.cos(turn))[:, column]
    beyond = float((sign * (state.d + reach * math.sin(turn) - edges)).max()) + planner.radius
    if sign * state.slope <= 0:
        return beyond
    return beyond + max((state.slope * state.ds) ** 2 / (2 * LATERAL), state.slope**2 / (2 * CURVATURE))


def eased(route: Route, state: FrenetState, side: int, column: int, relief: float, reach: float) -> Floats:
    """The border (N, 2), farther out by a relief near the vehicle, from behind it to a reach ahead [m]."""
    s = np.arange(max(state.s - 10.0, 0.0), min(state.s + reach, route.line.length), SPACING)
    whole = 10.0 + 1.5 * state.ds
    share = np.interp(s - state.s, [whole, 2 * whole], [1.0, 0.0])
    outwards = (relief + SPARE) * share * (1.0 if side == LEFT else -1.0)
    return route.line.place(s, route.edges_at(s)[:, column] + outwards)
