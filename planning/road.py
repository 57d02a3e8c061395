"""What is known of the world in a planning cycle, in plain arrays: lanes, tracks, stop points; and the route."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.program import InputError
from planning.reference import ReferenceLine, from_points

Floats = NDArray[np.float64]
SMOOTH = 6  # points of a lane's middle at least: a quintic
CROSSED = 0.1  # by which the borders of a lane that opens may cross [m]
EDGE = 1.0  # between the offsets of borders along a route [m]


class Lane(NamedTuple):
    """A lane of the map.

    left, right   (N, 2), (M, 2) its borders in driving direction [m]
    successors    lanes that it leads into
    beside        (lane to the left, lane to the right) or None; opposite: whether each of them is driven the other way
    speed         limit [m/s]
    gives_way     whether it leads into the lane of others, who go first (a ramp)
    """

    left: Floats
    right: Floats
    successors: tuple[int, ...] = ()
    beside: tuple[int | None, int | None] = (None, None)
    opposite: tuple[bool, bool] = (False, False)
    speed: float = math.inf
    gives_way: bool = False

    @property
    def centre(self) -> Floats:
        """(K, 2) midway between the borders, at equal shares of their lengths."""
        num = max(len(self.left), len(self.right), SMOOTH)
        return (even(self.left, num) + even(self.right, num)) / 2


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


def no_tracks() -> Tracks:
    """None of them."""
    none, pairs = np.zeros(0), np.zeros((0, 2))
    label, kind = np.zeros(0, np.int64), np.zeros(0, np.str_)
    return Tracks(label, kind, pairs, np.zeros((0, 2, 2)), none, none, none, none, pairs, none)


def check_tracks(tracks: Tracks) -> None:
    """Raises InputError for wrong shapes, NaN, sizes that are not positive, and probabilities outside [0, 1]."""
    num = len(tracks.label)
    shapes = {"kind": (num,), "position": (num, 2), "covariance": (num, 2, 2), "size": (num, 2)}
    for name, value in tracks._asdict().items():
        shape = shapes.get(name, (num,))
        if np.shape(value) != shape:
            raise InputError(f"tracks: {name} has shape {np.shape(value)}, but must be {shape}")
        if name in ("label", "kind"):
            continue
        bad = np.argwhere(~np.isfinite(value))
        if len(bad):
            raise InputError(
                f"track {tracks.label[bad[0, 0]]}: its {name} is not finite; leave the track out or mend it"
            )
    for row in np.flatnonzero((tracks.size <= 0).any(1)):
        raise InputError(
            f"track {tracks.label[row]}: its size is {tracks.size[row].tolist()}, but must be positive [m]"
        )
    for row in np.flatnonzero((tracks.existence < 0) | (tracks.existence > 1)):
        raise InputError(f"track {tracks.label[row]}: its existence is {tracks.existence[row]}, outside [0, 1]")


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
    borders   polylines that must not be touched: left and right border of each lane, in turn
    outer     (left, right) of each lane: the far border of the lane beside it, or None
    edges     (N, 4) offsets at s = 0, 1, 2, ... m: far border of the lane to the left (its own where there is none),
              left border, right border, far border of the lane to the right [m]
    opposite  (N, 2) whether the lanes beside are driven the other way
    joins     (J,) where lanes that give way lead into those of others [m]
    """

    line: ReferenceLine
    lanes: tuple[int, ...]
    start: Floats
    speed: Floats
    borders: tuple[Floats, ...]
    outer: tuple[tuple[Floats | None, Floats | None], ...]
    edges: Floats
    opposite: NDArray[np.bool_]
    joins: Floats

    def edges_at(self, s: ArrayLike) -> Floats:
        """(*, 4) at arc lengths (*,)."""
        grid = EDGE * np.arange(len(self.edges))
        return np.stack([np.interp(np.asarray(s, float), grid, column) for column in self.edges.T], -1)

    def limit_at(self, s: ArrayLike) -> Floats:
        """Speed limit (*,) at arc lengths (*,) [m/s]."""
        return self.speed[np.clip(np.searchsorted(self.start, s, "right") - 1, 0, len(self.speed) - 1)]


def read_route(path: str | Path) -> tuple[int, ...]:
    """The vector of lane ids in a text file, in driving order, separated by blanks, commas or line ends ([K15], IV-A: a
    router may take its place). Raises InputError for a file that is not there, is empty or holds other words."""
    try:
        words = Path(path).read_text().replace(",", " ").split()
    except (OSError, UnicodeDecodeError) as absent:
        raise InputError(f"route file {path} cannot be read: {absent}") from absent
    if wrong := [word for word in words if not re.fullmatch(r"-?[0-9]{1,18}", word)]:
        raise InputError(f"route file {path} has '{wrong[0]}' where a lane id should be; write integers only")
    if not words:
        raise InputError(f"route file {path} is empty; write lane ids in driving order")
    return tuple(map(int, words))


def route(lanes: Lanes, ids: Sequence[int], *, std: float = 0.1) -> Route:
    """The route along lanes `ids`, each a successor of the one before.

    Raises InputError for an unknown lane, lanes that do not follow one another, none at all, a speed limit that is no
    positive number, and a left border to the right of the right one."""
    if not isinstance(ids, Sequence) or not ids:
        raise InputError(f"the route is {ids!r}; give a tuple or list of one or more lanes")
    for a in ids:
        if a not in lanes:
            known = ", ".join(map(repr, list(lanes)[:8])) + (", ..." if len(lanes) > 8 else "")
            raise InputError(f"the route names lane {a!r}, which the map has not; it has {known or 'none'}")
        if not lanes[a].speed > 0.0:
            raise InputError(
                f"lane {a}: its speed limit is {lanes[a].speed}, but must be positive; infinity means none"
            )
    for a, b in pairwise(ids):
        if b not in lanes[a].successors:
            raise InputError(f"lane {b} of the route does not follow lane {a}, which leads to {lanes[a].successors}")
    parts = [lanes[a].centre for a in ids]
    points = np.concatenate([parts[0], *(p[1:] for p in parts[1:])])
    line = from_points(points, std=std, name=f"route {', '.join(map(str, ids))}")
    begins, _ = line.project([p[0] for p in parts])
    start = np.maximum.accumulate(begins[:, 0])
    borders = tuple(border for a in ids for border in (lanes[a].left, lanes[a].right))
    outer = tuple((_far_border(lanes, a, 0), _far_border(lanes, a, 1)) for a in ids)
    grid = EDGE * np.arange(int(line.length / EDGE) + 1)
    which = np.clip(np.searchsorted(start, grid, "right") - 1, 0, len(ids) - 1)
    edges = np.zeros((len(grid), 4))
    for n, a in enumerate(ids):
        here = which == n
        far_left, far_right = outer[n]
        left, right = lanes[a].left, lanes[a].right
        for column, border in enumerate(
            (left if far_left is None else far_left, left, right, right if far_right is None else far_right)
        ):
            edges[here, column] = _offsets(line, border, grid[here])
        if here.any() and np.median(edges[here, 1] - edges[here, 2]) < -CROSSED:
            raise InputError(f"lane {a}: its left border lies to the right of its right one; exchange them")
    opposite = np.array([lanes[a].opposite for a in ids])[which]
    speed = np.array([lanes[a].speed for a in ids])
    joins = start[1:][[lanes[a].gives_way for a in ids[:-1]]]
    return Route(line, tuple(ids), start, speed, borders, outer, edges, opposite, joins)


def _far_border(lanes: Lanes, a: int, side: int) -> Floats | None:
    """Of the lane beside lane a, to the left (0) or right (1)."""
    beside = lanes[a].beside[side]
    if beside is None:
        return None
    if beside not in lanes:
        raise InputError(f"lane {a} has lane {beside} beside it, which the map has not; leave it out or add it")
    # the left border of a lane to the left is the far one, but its right border where it is driven the other way
    return lanes[beside].left if (side == 0) != lanes[a].opposite[side] else lanes[beside].right


def _offsets(line: ReferenceLine, border: Floats, s: Floats) -> Floats:
    """Of a border at arc lengths s."""
    way = float(np.hypot(*np.diff(border, axis=0).T).sum())
    found, _ = line.project(even(border, max(int(way / EDGE), 1) + 1))
    order = np.argsort(found[:, 0], kind="stable")
    return np.interp(s, found[order, 0], found[order, 1])


def even(line: Floats, num: int) -> Floats:
    """num points at equal shares of its length."""
    way = np.r_[0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))]
    at = np.linspace(0.0, way[-1], num)
    return np.stack([np.interp(at, way, line[:, 0]), np.interp(at, way, line[:, 1])], -1)
