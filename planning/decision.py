"""Manoeuvre permissions ([K15], section IV-A): which virtual stopping points of the route may be passed.

    light      green for as long as the line takes to reach; yellow and red refuse
    yield      nobody is predicted in the zone, more likely than a threshold, from margin before our own arrival to
               margin after our own leaving: gap acceptance
    crosswalk  no pedestrian or bicycle is in or at the zone, or predicted there before we have left it
    stop       stood before it once, then as yield

A permission is used once no comfortable stop before the line is possible any more, or the front is past it: it then
stays, unless a light is red before the line. What cannot be told (a light without a state) refuses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from planning.frenet import FrenetState
from planning.road import Floats, Route, StopPoint
from planning.shapes import Vehicle
from planning.situation import Along, Predictions, along

PAST = 0.1  # the front is past a line by more than this [m]
LIGHT, YIELD, CROSSWALK, STOP = KINDS = ("light", "yield", "crosswalk", "stop")
WALKING = ("pedestrian", "bicycle")


@dataclass(frozen=True)
class Rules:
    """Settings of decisions.

    margin        before arriving and after leaving a zone [s]
    chance        that somebody is in the zone, from which on it counts
    braking       of a comfortable stop [m/s^2], reaction before it [s]
    acceleration  with which zones are driven to and left [m/s^2]
    spread        standard deviations of the way that others may be ahead or behind
    waiting       how near to a crosswalk's zone a pedestrian waits for it [m]
    standing      slower than this stands [m/s], as far as `before` a line stands at it [m]
    """

    margin: float = 1.5
    chance: float = 0.1
    braking: float = 2.5
    reaction: float = 0.3
    acceleration: float = 1.5
    spread: float = 1.0
    waiting: float = 1.0
    standing: float = 0.1
    before: float = 2.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"rules: {name} is {getattr(self, name)}, but must be positive and finite")


class Light(NamedTuple):
    """state "green", "yellow", "red"; remaining until it changes [s], infinite where nobody knows."""

    state: str
    remaining: float = math.inf


class Decided(NamedTuple):
    """What decisions remember: names of permissions given, used, and of stop points that were stood at."""

    granted: frozenset[str] = frozenset()
    used: frozenset[str] = frozenset()
    stood: frozenset[str] = frozenset()


class Permissions(NamedTuple):
    """granted  names of stop points that may be passed
    reasons  {name: why, or why not}
    memory   for the next cycle
    """

    granted: frozenset[str]
    reasons: dict[str, str]
    memory: Decided


def decide(
    route: Route,
    state: FrenetState,
    vehicle: Vehicle,
    predictions: Predictions,
    stop_points: Sequence[StopPoint],
    lights: Mapping[str, str | Light] | None = None,
    memory: Decided = Decided(),
    rules: Rules = Rules(),
    *,
    places: Along | None = None,
) -> Permissions:
    """Whether each stop point of the route may be passed.

    lights  {name of the stop point: its state}; memory  of the cycle before
    places  of the predictions along the route, where they are at hand

    Raises InputError for a kind that is none."""
    told = along(route, predictions) if places is None else places
    front, rear = state.s + vehicle.front, state.s + vehicle.front - vehicle.length
    granted, used, stood, reasons = set(), set(), set(), {}
    for point in stop_points:
        if point.kind not in KINDS:
            raise InputError(f"stop point {point.name} is a {point.kind!r}, but must be one of {', '.join(KINDS)}")
        left = point.s - front
        if left < -PAST:
            granted.add(point.name)
            used.add(point.name)
            reasons[point.name] = "the front is past the line"
            continue
        limit = max(float(np.min(route.limit_at(np.array([state.s, point.s])))), 1.0)
        arrival = time_of(max(left, 0.0), state.ds, rules.acceleration, limit)
        leaving = time_of(max(point.end - rear, 0.0), state.ds, rules.acceleration, limit)
        at_line = state.ds < rules.standing and left < rules.before
        if at_line or point.name in memory.stood:
            stood.add(point.name)
        light = _light(point.name, lights or {})
        if point.kind == LIGHT:
            may, why = _by_light(light, arrival)
        elif point.kind == STOP and point.name not in stood:
            may, why = False, "stand before it first"
        else:
            may, why = _by_zone(point, predictions, told, arrival, leaving, rules)
        committed = left < state.ds * rules.reaction + state.ds**2 / (2 * rules.braking)
        red = point.kind == LIGHT and light.state not in ("green", "yellow")
        if not may and committed and not red and point.name in memory.granted:
            may, why = True, f"no comfortable stop is possible any more ({why})"
        if may:
            granted.add(point.name)
            if committed and not at_line:
                used.add(point.name)
        reasons[point.name] = why
    return Permissions(frozenset(granted), reasons, Decided(frozenset(granted), frozenset(used), frozenset(stood)))


def time_of(way: float, speed: float, acceleration: float, limit: float) -> float:
    """Seconds that a way takes from a speed on, with an acceleration up to a limit; who is faster stays so."""
    if speed >= limit:
        return way / speed
    rise = (limit**2 - speed**2) / (2 * acceleration)
    if way <= rise:
        return (math.sqrt(speed**2 + 2 * acceleration * way) - speed) / acceleration
    return (limit - speed) / acceleration + (way - rise) / limit


def _light(name: str, lights: Mapping[str, str | Light]) -> Light:
    told = lights.get(name, "unknown")
    return told if isinstance(told, Light) else Light(told)


def _by_light(light: Light, arrival: float) -> tuple[bool, str]:
    if light.state == "green":
        if light.remaining < arrival:
            return False, f"green ends in {light.remaining:.1f} s, but the line is {arrival:.1f} s away"
        return True, "green"
    if light.state in ("yellow", "red"):
        return False, light.state
    return False, f"nobody tells the light's state (it is {light.state!r})"


def _by_zone(
    point: StopPoint, predictions: Predictions, places: Along, arrival: float, leaving: float, rules: Rules
) -> tuple[bool, str]:
    """Gap acceptance at a zone."""
    kind = predictions.tracks.kind[predictions.track]
    if point.kind == CROSSWALK:
        who, since, until = np.isin(kind, WALKING), 0.0, leaving + rules.margin
    else:
        # whoever comes along the own route before the line drives ahead or behind, not across
        own = places.on[:, 0] & (places.ahead[:, 0] > 0.5) & (np.abs(places.d[:, 0]) < 1.5) & (places.s[:, 0] < point.s)
        who, since, until = ~own, arrival - rules.margin, leaving + rules.margin
    hit = in_zone(point.zone, predictions, who, max(since, 0.0), until, spread=rules.spread)
    if point.kind == CROSSWALK:
        hit[:, 0] |= in_zone(point.zone, predictions, who & (kind == "pedestrian"), 0.0, 0.0, wider=rules.waiting)[:, 0]
    met = hit.any(1)
    chance = np.bincount(predictions.track[met], predictions.probability[met], minlength=len(predictions.tracks.label))
    total = 1.0 - float(np.prod(1.0 - np.minimum(chance, 1.0)))
    if total <= rules.chance:
        return True, "the zone stays free"
    worst = int(chance.argmax())
    when = predictions.times[hit[predictions.track == worst].any(0)]
    name = f"{predictions.tracks.kind[worst]} {predictions.tracks.label[worst]}"
    return False, f"{name} is in the zone in {when[0]:.1f} to {when[-1]:.1f} s (chance {total:.2f})"


def in_zone(
    zone: Floats,
    predictions: Predictions,
    who: NDArray[np.bool_],
    since: float,
    until: float,
    *,
    spread: float = 0.0,
    wider: float = 0.0,
) -> NDArray[np.bool_]:
    """(M, L) whether hypotheses `who` (M,) are in a polygon at each time from `since` to `until`, as rectangles made
    longer by `spread` standard deviations of their way each way, and all around by `wider` [m]."""
    import shapely

    hit = np.zeros(predictions.pose.shape[:2], bool)
    # nobody is predicted after the last time: where the window reaches beyond, the last time speaks for the rest
    times = (predictions.times >= min(since, predictions.times[-1])) & (predictions.times <= until)
    middle = (zone.min(0) + zone.max(0)) / 2
    half = predictions.tracks.size[predictions.track] / 2
    ahead = half[:, :1] + spread * predictions.std + wider
    reach = np.hypot(*(zone - middle).T).max() + ahead + half[:, 1:] + wider
    near = np.hypot(*(predictions.pose[..., :2] - middle).transpose(2, 0, 1)) <= reach
    m, k = np.nonzero(near & times & who[:, None])
    if len(m):
        x, y, heading = predictions.pose[m, k].T
        cos, sin = np.cos(heading), np.sin(heading)
        a, b = ahead[m, k], half[m, 1] + wider
        corners = np.stack(
            [
                np.stack([x + u * a * cos - v * b * sin, y + u * a * sin + v * b * cos], -1)
                for u, v in ((1, 1), (-1, 1), (-1, -1), (1, -1))
            ],
            1,
        )
        hit[m, k] = shapely.intersects(shapely.Polygon(zone), shapely.polygons(corners))
    return hit
