"""CommonRoad scenarios, versions 2018b and 2020a: lanes, signs, lights, road users and planning problems as plain data.

Althoff, Koschi, Manzinger (2017), "CommonRoad: composable benchmarks for motion planning on roads". Places are of the
middles of vehicles. Where a file gives an interval, its middle is taken and half its length told as `spread`. Road
users whose future is a set of places, and buildings, are no road users that drive: the first are refused, the second
left out.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.scenarios.commonroad_elements import (
    Element,
    Floats,
    child,
    integer,
    key_of,
    name_of,
    number,
    points,
    refs,
    root_of,
    shapes,
    span,
)
from models.program import InputError
from planning.road import Lane

VERSIONS = ("2018b", "2020a")
LIMITS = ("274", "R2-1")  # signs of a speed limit, Germany (Zeichen 274) and USA (MUTCD R2-1) [m/s]
ANY = (-math.inf, math.inf)


class Light(NamedTuple):
    """A traffic light.

    cycle      ((duration [s], colour), ...), over and over; none where it is switched off
    offset     when the cycle began [s]
    direction  "all", "left", "straight", "right", "leftStraight", "straightRight", "leftRight"
    """

    cycle: tuple[tuple[float, str], ...]
    offset: float
    direction: str

    def colours(self, until: float) -> tuple[tuple[float, str], ...]:
        """((from, colour), ...), times rising from 0 [s]."""
        whole = sum(duration for duration, _ in self.cycle)
        if not whole > 0:
            return ((0.0, "inactive"),)
        begin = self.offset - whole * math.ceil(self.offset / whole)
        found: list[tuple[float, str]] = []
        while begin <= until:
            for duration, colour in self.cycle:
                if begin + duration > 1e-9:
                    found.append((max(begin, 0.0), colour))
                begin += duration
        return tuple(told for told in found if told[0] <= until)


class StopLine(NamedTuple):
    """Of a lane: ends (2, 2) or None, which is at the lane's end; ids of its lights; codes of its signs."""

    ends: Floats | None
    lights: tuple[int, ...]
    signs: tuple[str, ...]


class Obstacle(NamedTuple):
    """A road user.

    kind    "car", "truck", "bus", "bicycle", "pedestrian", "parkedVehicle", ...
    size    length, width of the rectangle that holds its shape [m]
    time    (K,) rising [s]
    poses   (K, 5) x, y of its middle, heading, speed, acceleration
    spread  (K, 4) half of the intervals of x, y, heading, speed
    """

    key: int
    kind: str
    static: bool
    size: tuple[float, float]
    time: Floats
    poses: Floats
    spread: Floats


class Goal(NamedTuple):
    """places: polygons (N, 2), lanes: ids, in any of which to be (neither: anywhere); time [s], speed [m/s] and heading
    [rad] as (least, most)."""

    places: tuple[Floats, ...]
    lanes: tuple[int, ...]
    time: tuple[float, float]
    speed: tuple[float, float]
    heading: tuple[float, float]


class Problem(NamedTuple):
    """start: x, y of the middle, heading, speed, acceleration (5,) at `time` [s]; goals, any of which to reach."""

    start: Floats
    time: float
    goals: tuple[Goal, ...]


class Recording(NamedTuple):
    """A scenario.

    step        between states [s]
    lanes       {id: lane}, speed limits from signs where there are any
    kinds       {id of a lane: its types and, as "for car", its users}
    signs       {id of a lane: codes of its traffic signs}
    lane_lights {id of a lane: ids of its lights}
    """

    name: str
    version: str
    step: float
    lanes: dict[int, Lane]
    kinds: dict[int, frozenset[str]]
    signs: dict[int, tuple[str, ...]]
    lane_lights: dict[int, tuple[int, ...]]
    stop_lines: dict[int, StopLine]
    lights: dict[int, Light]
    obstacles: tuple[Obstacle, ...]
    problems: dict[int, Problem]


def read(file: str) -> Recording:
    """A scenario from an .xml or .xml.gz file.

    Raises InputError, with the file, the element and its id: not there, not XML, no scenario, a version that is not
    known, what is missing, what is no number or not finite, lanes that lead to others that are not there."""
    root = root_of(Path(file))
    version = root.get("commonRoadVersion", "none")
    if version not in VERSIONS:
        raise InputError(f"{file}: its commonRoadVersion is {version}; {' and '.join(VERSIONS)} can be read")
    step = number(root.get("timeStepSize"), f"{file}: timeStepSize")
    if not step > 0:
        raise InputError(f"{file}: timeStepSize is {step:g}, but must be positive [s]")
    signs = {key_of(e, file): _codes(e, f"{file}: {name_of(e)}") for e in root.findall("trafficSign")}
    found = {key_of(e, file): e for e in root.findall("lanelet")}
    if not found:
        raise InputError(f"{file}: there are no lanelets in it")
    codes = {key: _codes_at(e, signs, f"{file}: {name_of(e)}") for key, e in found.items()}
    lanes = {key: _lane(e, codes[key], f"{file}: {name_of(e)}") for key, e in found.items()}
    for key, lane in lanes.items():
        for other in (*lane.successors, *(b for b in lane.beside if b is not None)):
            if other not in lanes:
                raise InputError(f"{file}: lanelet {key} refers to lanelet {other}, which is not there")
    return Recording(
        root.get("benchmarkID", Path(file).name),
        version,
        step,
        lanes,
        {key: _kinds(e) for key, e in found.items()},
        {key: tuple(code for code, _ in told) for key, told in codes.items()},
        {key: refs(e, "trafficLightRef", file) for key, e in found.items()},
        {
            key: _stop_line(line, signs, f"{file}: {name_of(e)}, stopLine")
            for key, e in found.items()
            if (line := e.find("stopLine")) is not None
        },
        {key_of(e, file): _light(e, step, f"{file}: {name_of(e)}") for e in root.findall("trafficLight")},
        tuple(
            _obstacle(e, step, f"{file}: {name_of(e)}")
            for e in root
            if e.tag in ("obstacle", "staticObstacle", "dynamicObstacle")
        ),
        {key_of(e, file): _problem(e, step, f"{file}: {name_of(e)}") for e in root.findall("planningProblem")},
    )


def _codes(e: Element, where: str) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """(code, its values) of each element of a sign."""
    return tuple(
        (
            child(part, "trafficSignID", where).text or "",
            tuple(number(v.text, f"{where}: additionalValue") for v in part.findall("additionalValue"))
            if part.findtext("trafficSignID") in LIMITS
            else (),
        )
        for part in e.findall("trafficSignElement")
    )


def _codes_at(e: Element, signs: dict, where: str) -> tuple[tuple[str, tuple[float, ...]], ...]:  # type: ignore[type-arg]
    """Of the signs that an element refers to; stop lines may refer to signs that a file leaves out."""
    return tuple(told for key in refs(e, "trafficSignRef", where) for told in signs.get(key, ()))


def _kinds(e: Element) -> frozenset[str]:
    users = [f"for {u.text}" for tag in ("userOneWay", "userBidirectional") for u in e.findall(tag)]
    return frozenset([*(t.text or "" for t in e.findall("laneletType")), *users])


def _lane(e: Element, codes: tuple[tuple[str, tuple[float, ...]], ...], where: str) -> Lane:
    borders = []
    for tag in ("leftBound", "rightBound"):
        line = points(child(e, tag, where), f"{where}: {tag}")
        if len(line) < 2:
            raise InputError(f"{where}: {tag} has {len(line)} points; give two or more")
        borders.append(line)
    sides = [e.find(tag) for tag in ("adjacentLeft", "adjacentRight")]
    beside = [None if s is None else integer(s.get("ref"), f"{where}: ref of its {s.tag}") for s in sides]
    opposite = [s is not None and s.get("drivingDir") == "opposite" for s in sides]
    limits = [value for code, values in codes if code in LIMITS for value in values[:1]]
    if (told := e.findtext("speedLimit")) is not None:
        limits.append(number(told, f"{where}: speedLimit"))
    return Lane(
        borders[0],
        borders[1],
        refs(e, "successor", where),
        (beside[0], beside[1]),
        (opposite[0], opposite[1]),
        min(limits, default=math.inf),
    )


def _stop_line(e: Element, signs: dict, where: str) -> StopLine:  # type: ignore[type-arg]
    ends = points(e, where)
    if len(ends) not in (0, 2):
        raise InputError(f"{where} has {len(ends)} points, but must have two or none")
    codes = tuple(code for code, _ in _codes_at(e, signs, where))
    return StopLine(ends if len(ends) else None, refs(e, "trafficLightRef", where), codes)


def _light(e: Element, step: float, where: str) -> Light:
    cycle = e.find("cycle")
    direction = e.findtext("direction", "all")
    if cycle is None or e.findtext("active", "true") == "false":
        return Light((), 0.0, direction)
    parts = tuple(
        (step * number(part.findtext("duration"), f"{where}: duration"), child(part, "color", where).text or "")
        for part in cycle.findall("cycleElement")
    )
    return Light(parts, step * number(cycle.findtext("timeOffset", "0"), f"{where}: timeOffset"), direction)


class _State(NamedTuple):
    """Middles and half lengths: time [s]; x, y, heading, speed; acceleration, NaN where it is not told."""

    time: float
    value: Floats
    spread: Floats
    acceleration: float


def _state(e: Element, step: float, where: str, *, moves: bool = True) -> _State:
    time = step * span(child(e, "time", where), f"{where}: time")[0]
    where = f"{where} at {time:g} s"
    place = child(e, "position", where)
    region = [points(place, f"{where}: position")]
    if not len(region[0]):
        region += shapes(place, f"{where}: position")
    corners = np.concatenate(region)
    if not len(corners):
        raise InputError(f"{where}: its position is neither a point nor a shape")
    spans = [*zip(corners.min(0), corners.max(0), strict=True)]
    spans.append(span(child(e, "orientation", where), f"{where}: orientation"))
    speed = e.find("velocity")
    if speed is None and moves:
        raise InputError(f"{where} has no velocity")
    spans.append((0.0, 0.0) if speed is None else span(speed, f"{where}: velocity"))
    rate = e.find("acceleration")
    a = math.nan if rate is None else sum(span(rate, f"{where}: acceleration")) / 2
    low, high = np.array(spans, float).T
    return _State(time, (low + high) / 2, (high - low) / 2, a)


def _obstacle(e: Element, step: float, where: str) -> Obstacle:
    static = "static" in (e.findtext("role", ""), e.tag.removesuffix("Obstacle"))
    if e.find("occupancySet") is not None:
        raise InputError(f"{where}: its future is an occupancySet; only trajectories can be replayed")
    parts = list(shapes(child(e, "shape", where), f"{where}: shape"))
    if not parts:
        raise InputError(f"{where}: its shape is no rectangle, circle or polygon")
    corners = np.concatenate(parts)
    size, middle = corners.max(0) - corners.min(0), (corners.max(0) + corners.min(0)) / 2
    if not (size > 0).all():
        raise InputError(f"{where}: its size is {size.tolist()}, but must be positive [m]")
    elements = [child(e, "initialState", where), *e.findall("trajectory/state")]
    states = [_state(s, step, where, moves=not static) for s in elements]
    time = np.array([s.time for s in states])
    if not (np.diff(time) > 0).all():
        raise InputError(f"{where}: the times of its states must rise")
    told = np.array([s.value for s in states])
    rate = np.array([s.acceleration for s in states])
    slope = np.gradient(told[:, 3], time) if len(time) > 1 else np.zeros(1)
    cos, sin = np.cos(told[:, 2]), np.sin(told[:, 2])
    told[:, 0] += cos * middle[0] - sin * middle[1]
    told[:, 1] += sin * middle[0] + cos * middle[1]
    poses = np.column_stack([told, np.where(np.isnan(rate), slope, rate)])
    kind = child(e, "type", where).text or "unknown"
    key = integer(e.get("id"), where)
    return Obstacle(
        key, kind, static, (float(size[0]), float(size[1])), time, poses, np.array([s.spread for s in states])
    )


def _problem(e: Element, step: float, where: str) -> Problem:
    state = _state(child(e, "initialState", where), step, f"{where}, initialState")
    rate = 0.0 if math.isnan(state.acceleration) else state.acceleration
    goals = tuple(_goal(g, step, f"{where}, goalState") for g in e.findall("goalState"))
    return Problem(np.r_[state.value, rate], state.time, goals)


def _goal(e: Element, step: float, where: str) -> Goal:
    place = e.find("position")
    first, last = span(child(e, "time", where), f"{where}: time")
    speed, heading = (e.find(tag) for tag in ("velocity", "orientation"))
    return Goal(
        () if place is None else tuple(shapes(place, where)),
        () if place is None else refs(place, "lanelet", where),
        (step * first, step * last),
        ANY if speed is None else span(speed, f"{where}: velocity"),
        ANY if heading is None else span(heading, f"{where}: orientation"),
    )
