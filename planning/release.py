"""Lateral release ([K15], section IV-B): passing what stands in the own lane, into the lane beside if that is free.

Blockers are standing or slow road users on the own lane, one behind the other as a row. They are passed within the
lane where it is wide enough; else in the lane beside, if nobody is predicted where we would be

    from now to T = t(way to the end of the row and back into the lane) + margin

Who stands before a stop point waits there and is not passed. Once beside the row we go on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from planning.decision import time_of
from planning.frenet import FrenetState
from planning.planner import Planner
from planning.road import Floats, Route, StopPoint
from planning.situation import Along, Predictions

LEFT, RIGHT = 0, 1
SAME = 0.2  # offsets at which a row is passed that differ by less are the same [m]
SPARE = 0.05  # kept beyond what the planner's checks ask for [m]


@dataclass(frozen=True)
class Release:
    """Settings of passing.

    slow          slower than this blocks [m/s], seen so for `patience` [s]
    row           blockers nearer to one another than this are passed together [m]
    early         begun within this time [s] and `near` [m] of the row
    back          way in which the own lane is reached again [m]
    waiting       who stands this near before a stop point waits at it [m]
    speed         while passing [m/s]
    acceleration  with which the time that it takes is told [m/s^2], and its margin [s]
    chance        that somebody comes, from which on it counts
    spread        standard deviations of the way that others may be ahead or behind
    """

    slow: float = 1.5
    patience: float = 2.0
    row: float = 20.0
    early: float = 4.0
    near: float = 10.0
    back: float = 15.0
    waiting: float = 15.0
    speed: float = 9.0
    acceleration: float = 1.5
    margin: float = 1.5
    chance: float = 0.05
    spread: float = 1.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"release: {name} is {getattr(self, name)}, but must be positive and finite")


class Passing(NamedTuple):
    """What passing remembers: the nearest blocker (a label, or -1) and for how long it blocks [s]; whether a row is
    being passed, at which offset [m] and into which side the lane is left (LEFT, RIGHT, or -1: within the lane)."""

    blocker: int = -1
    blocked: float = 0.0
    going: bool = False
    offset: float = 0.0
    side: int = -1


class Extent(NamedTuple):
    """Half of the rectangles' extent (M, L) along and across a route [m]."""

    along: Floats
    across: Floats


def extent(predictions: Predictions, places: Along) -> Extent:
    """Of predictions on a route."""
    length, width = (predictions.tracks.size[predictions.track] / 2).T[..., None]
    cos, sin = np.abs(places.ahead), np.sqrt(np.maximum(1.0 - places.ahead**2, 0.0))
    return Extent(length * cos + width * sin, length * sin + width * cos)


def passing(
    planner: Planner,
    route: Route,
    state: FrenetState,
    predictions: Predictions,
    places: Along,
    stop_points: Sequence[StopPoint],
    memory: Passing,
    settings: Release = Release(),
) -> Passing:
    """Whether, and where, what stands in the own lane is passed."""
    vehicle, far, needed = planner.vehicle, extent(predictions, places), clearances(planner, route, predictions, places)
    rear = state.s + vehicle.front - vehicle.length
    now, pace = places.s[:, 0], predictions.speed[:, 0] * places.ahead[:, 0]
    chance = predictions.probability > settings.chance
    blocks = chance & places.on[:, 0] & (np.abs(pace) < settings.slow) & (predictions.speed[:, 0] < settings.slow)
    blocks &= np.abs(places.d[:, 0]) < far.across[:, 0] + needed
    blocks &= (now + far.along[:, 0] > rear) & (predictions.tracks.kind[predictions.track] != "pedestrian")
    for point in stop_points:
        ahead = point.s - (now + far.along[:, 0])
        blocks &= ~((ahead > -far.along[:, 0]) & (ahead < settings.waiting) & (point.s > state.s + vehicle.front))
    row = _row(blocks, now, far.along[:, 0], settings.row)
    if not len(row):
        return Passing()
    first = int(row[0])
    label = int(predictions.tracks.label[predictions.track[first]])
    since = memory.blocked + planner.fans.cycle if label == memory.blocker or memory.going else 0.0
    waits = Passing(label, since)
    if since < settings.patience:
        return waits
    begin = float((now - far.along[:, 0])[row].min())
    end = float((now + far.along[:, 0])[row].max())
    if begin - (state.s + vehicle.front) > settings.near + settings.early * state.ds:
        return waits
    side_left = float((places.d[:, 0] + far.across[:, 0] + needed)[row].max()) + SPARE
    side_right = float((places.d[:, 0] - far.across[:, 0] - needed)[row].min()) - SPARE
    place = _beside(planner, route, side_left, side_right, begin, end)
    if place is None:
        return waits
    offset, side = place
    out = memory.going and (abs(state.d) > abs(offset) / 2 or state.s + vehicle.front > begin)
    if side >= 0 and not out and not _free(planner, route, state, predictions, places, far, row, end, offset, settings):
        return waits
    if memory.going and abs(offset - memory.offset) < SAME:
        offset = memory.offset  # tracks move a little; goals should not
    return Passing(label, since, True, offset, side)


def _row(blocks: NDArray[np.bool_], now: Floats, half: Floats, gap: float) -> NDArray[np.int64]:
    """Of blockers, the nearest and those that follow closely enough."""
    which = np.flatnonzero(blocks)
    which = which[np.argsort((now - half)[which], kind="stable")]
    reach = -math.inf
    for n, m in enumerate(which):
        if n and now[m] - half[m] - reach > gap:
            return which[:n]
        reach = max(reach, float(now[m] + half[m]))
    return which


def clearances(planner: Planner, route: Route, predictions: Predictions, places: Along) -> Floats:
    """(M,) between the path of the own vehicle's circles and the sides of road users, where they are now, so that the
    planner's chance constraint holds beside them [m]."""
    from scipy.stats import norm

    theta = route.line.at(places.s[:, 0])[:, 2]
    left = np.stack([-np.sin(theta), np.cos(theta)], -1)
    std = np.sqrt(np.maximum(np.einsum("mi,mij,mj->m", left, predictions.covariance, left), 0.0))
    each = planner.risk / max(len(std), 1)
    z = np.maximum(norm.isf(np.minimum(each / np.maximum(predictions.probability, 1e-12), 0.5)), 0.0)
    return np.asarray(planner.radius + z * std, np.float64)


def _beside(
    planner: Planner, route: Route, left: float, right: float, begin: float, end: float
) -> tuple[float, int] | None:
    """The offset at which a row from `begin` to `end` is passed and the side of the lane that is left for it."""
    far_left, own_left, own_right, far_right = route.edges_at(np.arange(begin, end + 1.0, 1.0)).T
    room = planner.radius + SPARE
    if left <= own_left.min() - room:
        return left, -1
    if right >= own_right.max() + room:
        return right, -1
    if (far_left > own_left).all() and left <= far_left.min() - room:
        return left, LEFT
    which = route.opposite[np.clip(np.arange(int(begin), int(end) + 1), 0, len(route.opposite) - 1), RIGHT]
    if (far_right < own_right).all() and right >= far_right.max() + room and not which.any():
        return right, RIGHT
    return None


def _free(
    planner: Planner,
    route: Route,
    state: FrenetState,
    predictions: Predictions,
    places: Along,
    far: Extent,
    row: NDArray[np.int64],
    end: float,
    offset: float,
    settings: Release,
) -> bool:
    """Whether nobody is predicted beside the row while we are there."""
    vehicle = planner.vehicle
    front, rear = state.s + vehicle.front, state.s + vehicle.front - vehicle.length
    leave = end + vehicle.length + settings.back
    limit = min(float(route.limit_at(np.array([state.s]))[0]), settings.speed)
    until = time_of(leave - front, state.ds, settings.acceleration, limit) + settings.margin
    spread = far.along + settings.spread * predictions.std
    meets = places.on & (np.abs(places.d - offset) < far.across + planner.radius) & (predictions.times <= until)
    meets &= (places.s - spread < leave) & (places.s + spread > rear)
    # who follows us in our own lane is no reason to stay in it
    behind = (
        (places.s[:, 0] < state.s) & (places.ahead[:, 0] > 0.5) & (np.abs(places.d[:, 0] - state.d) < vehicle.width)
    )
    met = meets.any(1) & ~behind & ~np.isin(predictions.track, predictions.track[row])
    chance = np.bincount(predictions.track[met], predictions.probability[met], minlength=len(predictions.tracks.label))
    return 1.0 - float(np.prod(1.0 - np.minimum(chance, 1.0))) <= settings.chance
