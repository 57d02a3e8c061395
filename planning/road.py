"""What is known of the world in a planning cycle, in plain arrays: lanes, tracks, stop points; and the route."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from planning.reference import ReferenceLine, from_points

Floats = NDArray[np.float64]


class Lane(NamedTuple):
    """A lane of the map.

    left, right   (N, 2), (M, 2) its borders in driving direction [m]
    successors    lanes that it leads into
    beside        (lane to the left, lane to the right) or None; opposite: whether each of them is driven the other way
    speed         limit [m/s]
    """

    left: Floats
    right: Floats
    successors: tuple[int, ...] = ()
    beside: tuple[int | None, int | None] = (None, None)
    opposite: tuple[bool, bool] = (False, False)
    speed: float = math.inf

    @property
    def centre(self) -> Floats:
        """(K, 2) midway between the borders, at equal shares of their lengths."""
        num = max(len(self.left), len(self.right), 3)
        return (_even(self.left, num) + _even(self.right, num)) / 2


Lanes = Mapping[int, Lane]


class Tracks(NamedTuple):
    """M road users as a tracker tells them.

    label        (M,) integers
    kind         (M,) "car", "bicycle", "pedestrian", ...
    position     (M, 2) of the middle [m], covariance (M, 2, 2) [m^2]
    heading, speed, acceleration, speed_std   (M,) [rad, m/s, m/s^2, m/s]
    size         (M, 2) length, width [m]
    existence    (M,) probability
    """

    label: NDArray[np.int64]
    kind: NDArray[np.str_]
    position: Floats
    covariance: Floats
    heading: Floats
    speed: Floats
    acceleration: Floats
    speed_std: Floats
    size: Floats
    existence: Floats


class StopPoint(NamedTuple):
    """A virtual stopping point of the map ([K15], section IV-A): its line may be passed by permission only.

    name   by which permission is given
    kind   "light", "yield" (intersections, roundabouts), "crosswalk", "stop" (a full stop, then as yield)
    s      of its line on the route, end: s where its zone ends [m]
    zone   (N, 2) polygon that others must keep clear of, or leave, for permission [m]
    """

    name: str
    kind: str
    s: float
    end: float
    zone: Floats


class Route(NamedTuple):
    """The reference line along a vector of lanes.

    line      along their middles
    lanes     their ids
    start     (L,) arc length at which each begins
    speed     (L,) their limits [m/s]
    borders   polylines that must not be touched: the outer borders of what may be driven
    """

    line: ReferenceLine
    lanes: tuple[int, ...]
    start: Floats
    speed: Floats
    borders: tuple[Floats, ...]


def route(lanes: Lanes, ids: Sequence[int], *, std: float = 0.1) -> Route:
    """The route along lanes `ids`, each a successor of the one before.

    Raises InputError for an unknown lane, lanes that do not follow one another, and none at all."""
    if not ids:
        raise InputError("the route has no lanes; name one or more")
    for a in ids:
        if a not in lanes:
            known = ", ".join(map(str, list(lanes)[:8]))
            raise InputError(f"the route names lane {a}, which the map has not; it has {known}, ...")
    for a, b in pairwise(ids):
        if b not in lanes[a].successors:
            raise InputError(f"lane {b} of the route does not follow lane {a}, which leads to {lanes[a].successors}")
    parts = [lanes[a].centre for a in ids]
    points = np.concatenate([parts[0], *(p[1:] for p in parts[1:])])
    line = from_points(points, std=std, name=f"route {', '.join(map(str, ids))}")
    begins, _ = line.project([p[0] for p in parts])
    start = np.maximum.accumulate(begins[:, 0])
    borders = tuple(border for a in ids for border in (lanes[a].left, lanes[a].right))
    return Route(line, tuple(ids), start, np.array([lanes[a].speed for a in ids]), borders)


def _even(line: Floats, num: int) -> Floats:
    """num points at equal shares of its length."""
    way = np.r_[0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))]
    at = np.linspace(0.0, way[-1], num)
    return np.stack([np.interp(at, way, line[:, 0]), np.interp(at, way, line[:, 1])], -1)
