"""Merging: where the route goes on in a lane with traffic, between which two of its vehicles.

A gap is told by the vehicle ahead and the one behind, either of which may be missing. With room r and headway h the own
middle may be in

    [front of the one behind + r + h v_behind + L / 2,   rear of the one ahead - r - h v_ahead - L / 2]

The gap is taken that is reached soonest, driving faster or slower than it; another only if it is by `hold` sooner.
Traffic of a
lane that joins further on is told as if it drove on the route already, the way that it still has to go before it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from models.program import InputError
from planning.candidates import Goal, Keep, Reach
from planning.frenet import FrenetState
from planning.planner import Planner
from planning.release import extent
from planning.road import Route
from planning.situation import Along, Predictions

SLOWEST = 0.1  # that one is faster than a gap one catches up with, for the time it takes [m/s]
ALIGNED = 0.7  # cos of the direction against the route's, from which on somebody drives along it


@dataclass(frozen=True)
class Gaps:
    """Settings of merging.

    room, headway  kept to both vehicles of a gap [m, s]
    acceleration   with which one gets as fast as a gap's vehicles [m/s^2]
    shift, within  faster or slower than the gap [m/s], by what is missing within a time [s]
    hold           [s]
    chance         that a vehicle is there, from which on it counts
    far            how far ahead a lane that joins is looked at; who is in no gap stands `stop` before it [m]
    """

    room: float = 2.0
    headway: float = 0.6
    acceleration: float = 1.5
    shift: float = 3.0
    within: float = 3.0
    hold: float = 3.0
    chance: float = 0.3
    far: float = 150.0
    stop: float = 15.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"gaps: {name} is {getattr(self, name)}, but must be positive and finite")


class Mover(NamedTuple):
    """A vehicle of the lane: label, s of its middle [m], half its length [m], speed [m/s]; joins: not here yet."""

    label: int
    s: float
    half: float
    speed: float
    joins: bool = False


class Gap(NamedTuple):
    """Between two vehicles, or before the first, or behind the last."""

    ahead: Mover | None
    behind: Mover | None

    @property
    def labels(self) -> tuple[int, int]:
        """Of both, -1 for none."""
        return (-1 if self.ahead is None else self.ahead.label, -1 if self.behind is None else self.behind.label)

    def span(self, length: float, settings: Gaps) -> tuple[float, float]:
        """In which the own middle may be; empty where least > largest."""
        low, high = -math.inf, math.inf
        if self.behind is not None:
            _, s, half, v, _ = self.behind
            low = s + half + settings.room + settings.headway * v + length / 2
        if self.ahead is not None:
            _, s, half, v, _ = self.ahead
            high = s - half - settings.room - settings.headway * v - length / 2
        return low, high

    def open(self, middle: float, speed: float, length: float, settings: Gaps) -> bool:
        """Whether one is in it, and still is when one has got as fast as its vehicles."""
        low, high = self.span(length, settings)
        if self.behind is not None:
            low += max(self.behind.speed - speed, 0.0) ** 2 / (2 * settings.acceleration)
        if self.ahead is not None:
            high -= max(speed - self.ahead.speed, 0.0) ** 2 / (2 * settings.acceleration)
        return low <= middle <= high

    def missing(self, middle: float, length: float, settings: Gaps) -> float:
        """How far one has to shift into it, ahead where positive [m]."""
        low, high = self.span(length, settings)
        return max(low - middle, 0.0) - max(middle - high, 0.0)

    def goal(self, state: FrenetState, middle: float, length: float, speed: float, settings: Gaps) -> Goal | None:
        """Faster or slower than the gap until one is in it, then as fast as its vehicles, if it has both.

        middle  ahead of the reference point [m]; speed  wanted if there were no gap [m/s]"""
        shift = self.missing(state.s + middle, length, settings)
        ahead, behind = self.ahead, self.behind
        if shift > 0.0 and behind is not None:
            return Keep(min(speed, behind.speed + min((shift + settings.room) / settings.within, settings.shift)))
        if shift < 0.0 and ahead is not None:
            slower = min((settings.room - shift) / settings.within, settings.shift)
            return Keep(min(speed, max(ahead.speed - slower, 0.0)))
        if ahead is None or behind is None:
            return None
        # where one is, a little inside: to go for its middle would mean to be slower or faster for longer
        low, high = self.span(length, settings)
        inset = min(settings.room, (high - low) / 2)
        place = min(max(state.s + middle, low + inset), high - inset)
        pace = (ahead.speed + behind.speed) / 2
        return Reach(place - middle, pace) if pace <= speed + SLOWEST else Keep(speed)


def choose_gap(
    movers: list[Mover],
    middle: float,
    length: float,
    speed: float,
    before: tuple[int, int],
    settings: Gaps = Gaps(),
    *,
    way: float = math.inf,
) -> Gap:
    """The gap that is reached soonest; there is always one before the first vehicle and behind the last.

    middle  own [m]; speed  the highest wanted [m/s]; before  labels of the gap taken in the last cycle
    way     within which one must be in it, where one has to catch up with it [m]"""
    order = sorted(movers, key=lambda mover: -mover.s)
    gaps = [Gap(a, b) for a, b in pairwise([None, *order, None])]

    def time(gap: Gap) -> float:
        low, high = gap.span(length, settings)
        if low > high:
            return math.inf
        shift = gap.missing(middle, length, settings)
        faster = settings.shift
        if shift > 0.0 and gap.behind is not None:
            faster = max(min(speed - gap.behind.speed, faster), SLOWEST)
            if shift / faster * (gap.behind.speed + faster) > way:
                return math.inf
        return abs(shift) / faster - (settings.hold if gap.labels == before else 0.0)

    return min(gaps, key=time)


def movers_of(
    planner: Planner, route: Route, state: FrenetState, predictions: Predictions, places: Along, settings: Gaps = Gaps()
) -> list[Mover]:
    """Vehicles of the lane that the route goes on in: of the route's lane where we are not on it yet, of a lane that
    joins where ours gives way to it; none where nothing is to be merged into."""
    _, left, right, _ = route.edges_at(np.array([state.s]))[0]
    beside = not right < state.d < left
    joins = route.joins[(route.joins > state.s) & (route.joins < state.s + settings.far)]
    if not beside and not len(joins):
        return []
    half = extent(predictions, places)
    edges = route.edges_at(places.s)
    on = places.on & (places.ahead > ALIGNED) & (places.d < edges[..., 1]) & (places.d > edges[..., 2])
    now = on[:, 0] & (beside | (places.s[:, 0] > state.s))
    chances: dict[int, float] = {}
    found: dict[int, Mover] = {}
    for m in range(len(on)):
        late = 0
        if not now[m]:
            if on[m, 0] or not len(joins):
                continue
            then = np.flatnonzero(on[m] & (places.s[m] > joins[0]))
            if not len(then):
                continue
            late = int(then[0])
        label = int(predictions.tracks.label[predictions.track[m]])
        chances[label] = chances.get(label, 0.0) + float(predictions.probability[m])
        s = float(places.s[m, late] - predictions.way[m, late])
        found[label] = Mover(label, s, float(half.along[m, late]), float(predictions.speed[m, 0]), late > 0)
    return [mover for label, mover in found.items() if chances[label] > settings.chance]


class Merging(NamedTuple):
    """The gap, whether one goes into it, s before which one stands while one does not (of a lane that joins, [m]), and
    the labels of those who drive on another lane yet."""

    gap: Gap | None = None
    into: bool = False
    line: float = math.inf
    joining: tuple[int, ...] = ()

    @property
    def labels(self) -> tuple[int, int]:
        """Of the gap's vehicles."""
        return (-1, -1) if self.gap is None else self.gap.labels


def merging(
    planner: Planner,
    route: Route,
    state: FrenetState,
    movers: list[Mover],
    before: tuple[tuple[int, int], bool],
    braking: float,
    settings: Gaps = Gaps(),
) -> Merging:
    """The gap between movers that is gone for; who went into one goes on as long as it is there.

    before  labels of the gap of the last cycle and whether one went into it; braking  of a comfortable stop [m/s^2]"""
    if not movers:
        return Merging()
    vehicle, limit = planner.vehicle, float(route.limit_at(np.array([state.s]))[0])
    middle, front = state.s + vehicle.middle, state.s + vehicle.front
    line = min((float(s) - settings.stop for s in route.joins if s - settings.stop > front), default=math.inf)
    gap = choose_gap(movers, middle, vehicle.length, limit, before[0], settings, way=line - front)
    near = abs(gap.missing(middle, vehicle.length, settings)) < settings.room
    into = gap.open(middle, state.ds, vehicle.length, settings) or (before == (gap.labels, True) and near)
    if into or line - front < state.ds**2 / (2 * braking):
        line = math.inf
    return Merging(gap, into, line, tuple(mover.label for mover in movers if mover.joins))
