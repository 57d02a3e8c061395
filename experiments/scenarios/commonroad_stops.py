"""Virtual stopping points of a route through a CommonRoad map: lights, stop and yield signs, lines to wait at.

A line is where the file draws it, else at the end of its lane. Its zone are the places behind it at which lanes of
others cross the route or lead into it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from experiments.scenarios.commonroad import Light, Recording
from experiments.scenarios.lane_search import turn_of
from planning.road import Lanes, Route, StopPoint

STOP, YIELD = {"206", "R1-1"}, {"205", "R1-2"}  # signs: Germany (Zeichen 206, 205), USA (MUTCD)
AHEAD = 40.0  # how far behind a line lanes may cross the route for it [m]
TURNS = 0.6  # by which a lane turns to the left or right [rad]
SMALLEST = 0.5  # of what lanes have in common [m^2]
Lights = dict[str, tuple[tuple[float, str], ...]]


def stops_of(
    told: Recording, lanes: Lanes, drivable: Collection[int], way: Route, since: float, until: float
) -> tuple[tuple[StopPoint, ...], Lights]:
    """Stop points along a route, and the states of their lights from a time `since` on, for `until` [s]."""
    points, lights = [], Lights()
    for n, key in enumerate(way.lanes[:-1]):
        drawn, after = told.stop_lines.get(key), lanes[way.lanes[n + 1]]
        s = float(way.start[n + 1])
        if drawn is not None and drawn.ends is not None:
            s = float(way.line.project([drawn.ends.mean(0)])[0][0, 0])
        codes = {*told.signs.get(key, ()), *(() if drawn is None else drawn.signs)}
        refs = {*told.lane_lights.get(key, ()), *(() if drawn is None else drawn.lights)}
        governing = [told.lights[ref] for ref in sorted(refs) if ref in told.lights]
        governing = [light for light in governing if light.cycle and is_for(light, turn_of(after))]
        kind = "light" if governing else "stop" if codes & STOP else "yield" if codes & YIELD or drawn else ""
        zone = crossings(lanes, drivable, way, n, s)
        if not kind or (zone is None and kind != "light"):
            continue
        if zone is None:
            zone = np.concatenate([after.left, after.right[::-1]])
        name = f"{kind} at lane {key}"
        end = float(way.line.project(zone)[0][:, 0].max())
        points.append(StopPoint(name, kind, s, max(end, s), zone))
        if governing:
            lights[name] = colours_of(governing, since, until)
    return tuple(points), lights


def is_for(light: Light, turn: float) -> bool:
    """Whether a light governs who turns by an angle, to the left where positive [rad]."""
    told = light.direction.lower()
    way = "left" if turn > TURNS else "right" if turn < -TURNS else "straight"
    return told == "all" or way in told


def colours_of(lights: Sequence[Light], since: float, until: float) -> tuple[tuple[float, str], ...]:
    """((from, state), ...) of lights that stand together: green where one is, else yellow where one is, else red."""
    told = [light._replace(offset=light.offset - since).colours(until) for light in lights]
    out: list[tuple[float, str]] = []
    for now in sorted({since for cycle in told for since, _ in cycle}):
        shown = {[colour for since, colour in cycle if since <= now][-1] for cycle in told}
        state = "green" if "green" in shown else "yellow" if "yellow" in shown else "red"
        if not out or out[-1][1] != state:
            out.append((now, state))
    return tuple(out)


def crossings(lanes: Lanes, drivable: Collection[int], way: Route, number: int, s: float) -> Any:
    """The hull (N, 2) of what the lanes of the route behind a line at s have in common with those of others; None where
    that is nothing. Lanes that part from the route, and those beside it, are no others."""
    import shapely

    def shape(key: int) -> Any:
        return shapely.Polygon(np.concatenate([lanes[key].left, lanes[key].right[::-1]])).buffer(0.0)

    own = [key for n, key in enumerate(way.lanes) if n > number and way.start[n] < s + AHEAD]
    parting = {k for key in way.lanes for k in lanes[key].successors}
    beside = {k for key in own for k in lanes[key].beside if k is not None}
    parts = []
    for key in own:
        mine = shape(key)
        for other in drivable:
            if other in parting or other in beside or other in way.lanes:
                continue
            common = mine.intersection(shape(other))
            if common.area > SMALLEST:
                parts.append(common)
    if not parts:
        return None
    hull = shapely.unary_union(parts).convex_hull
    return np.array(hull.exterior.coords)[:-1]
