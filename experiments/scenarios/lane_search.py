"""The way through a map: lanes from a place to a goal, by the shortest path over successors and neighbours.

A route (planning.road.route) is one vector of lanes that follow one another. Where the path changes lanes, it is the
vector of the lane changed to, if that goes back beside the whole path: the change is then made at once, into it. Else a
lane is made that leads over.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from planning.road import Lane, Lanes, even

Floats = NDArray[np.float64]
CHANGE = 30.0  # way that a change of lanes counts for [m]
TURNED = math.pi / 3  # by which a lane may point elsewhere than who drives on it [rad]


def way_of(lane: Lane) -> float:
    """Length along its middle [m]."""
    return float(np.hypot(*np.diff(lane.centre, axis=0).T).sum())


def lanes_at(lanes: Lanes, drivable: Collection[int], place: Floats, heading: float | None) -> list[int]:
    """The lanes that hold a place and, where a heading is told, point there: those that fit best first."""
    found = []
    for key in drivable:
        if not _holds(lanes[key], place):
            continue
        apart, direction = _nearest(lanes[key].centre, place)
        turned = 0.0 if heading is None else abs(math.remainder(direction - heading, 2 * math.pi))
        if turned < TURNED:
            found.append((turned + apart / 10, key))
    return [key for _, key in sorted(found)]


def _holds(lane: Lane, place: Floats) -> bool:
    import shapely

    shape = shapely.Polygon(np.concatenate([lane.left, lane.right[::-1]]))
    return bool(shapely.intersects(shape.buffer(0.0), shapely.Point(place)))


def _nearest(line: Floats, place: Floats) -> tuple[float, float]:
    """Distance of a line, and its direction there."""
    fine = even(line, max(len(line), 50))
    n = int(np.hypot(*(fine - place).T).argmin())
    step = fine[min(n + 1, len(fine) - 1)] - fine[max(n - 1, 0)]
    return float(np.hypot(*(fine[n] - place))), math.atan2(step[1], step[0])


def neighbours(lanes: Lanes, key: int, drivable: Collection[int]) -> list[int]:
    """Lanes beside that are driven the same way."""
    told = zip(lanes[key].beside, lanes[key].opposite, strict=True)
    return [beside for beside, opposite in told if beside is not None and not opposite and beside in drivable]


def search(lanes: Lanes, drivable: Collection[int], start: int, goals: Collection[int]) -> list[int] | None:
    """The shortest path from a lane to any of others (Dijkstra); None where there is none."""
    ways = {key: way_of(lanes[key]) for key in drivable}
    queue: list[tuple[float, int, tuple[int, ...]]] = [(0.0, start, ())]
    done: set[int] = set()
    while queue:
        cost, key, before = heapq.heappop(queue)
        if key in done:
            continue
        done.add(key)
        path = (*before, key)
        if key in goals:
            return list(path)
        for after in lanes[key].successors:
            if after in drivable:
                heapq.heappush(queue, (cost + ways[key], after, path))
        for beside in neighbours(lanes, key, drivable):
            heapq.heappush(queue, (cost + CHANGE, beside, path))
    return None


def route_of(lanes: Lanes, drivable: Collection[int], path: Sequence[int]) -> tuple[dict[int, Lane], list[int]]:
    """The route of a path, and the lanes with those that had to be made for it."""
    route = straightened(lanes, drivable, path)
    return woven(lanes, drivable, path) if route is None else (dict(lanes), route)


def straightened(lanes: Lanes, drivable: Collection[int], path: Sequence[int]) -> list[int] | None:
    """One vector of map lanes, beside the path or on it from beginning to end; None where there is none."""
    route = [path[-1]]
    for before, here in reversed(list(pairwise(path))):
        if here not in lanes[before].successors:  # the path changes lanes: the route stays
            continue
        if here == route[0]:
            route.insert(0, before)
            continue
        joined = [k for k in neighbours(lanes, before, drivable) if route[0] in lanes[k].successors]
        if not joined:
            return None
        route.insert(0, joined[0])
    return route if path[0] == route[0] or route[0] in neighbours(lanes, path[0], drivable) else None


def woven(lanes: Lanes, drivable: Collection[int], path: Sequence[int]) -> tuple[dict[int, Lane], list[int]]:
    """One vector of lanes, with a made one wherever the path changes: from one lane over into the other, begun as far
    back as both go on side by side."""
    columns = [[path[0]]]
    for before, here in pairwise(path):
        if here in lanes[before].successors:
            columns.append([here])
        else:
            columns[-1].append(here)
    out, route, done = dict(lanes), list[int](), len(columns)
    for n in reversed(range(len(columns))):
        if n >= done:
            continue
        first, last = columns[n][0], columns[n][-1]
        done = n
        if first == last:
            route.insert(0, first)
            continue
        own, other = [first], [last]
        while done > 0 and len(columns[done - 1]) == 1:
            before = columns[done - 1][0]
            joined = [k for k in abreast(lanes, before, drivable) if other[0] in lanes[k].successors]
            if not joined or before in joined:
                break
            own, other, done = [before, *own], [joined[0], *other], done - 1
        new = max(out) + 1
        after = (route[0],) if route else lanes[last].successors
        speed = min(lanes[k].speed for k in (*own, *other))
        left, right = (_over(lanes, own, other, side) for side in (0, 1))
        out[new] = Lane(left, right, after, speed=speed)
        route.insert(0, new)
    for before, here in pairwise(route):
        if here not in out[before].successors:
            out[before] = out[before]._replace(successors=(*out[before].successors, here))
    return out, route


def abreast(lanes: Lanes, key: int, drivable: Collection[int]) -> list[int]:
    """All lanes of a direction beside one another, from a lane outwards."""
    found = [key]
    for k in found:
        found += [beside for beside in neighbours(lanes, k, drivable) if beside not in found]
    return found


def _over(lanes: Lanes, own: Sequence[int], other: Sequence[int], side: int) -> Floats:
    """A border that begins as that of some lanes and ends as that of others, u^3 (10 - 15 u + 6 u^2) of the way."""
    told = [np.concatenate([(lanes[k].left, lanes[k].right)[side] for k in keys]) for keys in (own, other)]
    way = float(np.hypot(*np.diff(told[0], axis=0).T).sum())
    num = max(round(way), 5) + 1
    u = np.linspace(0.0, 1.0, num)[:, None]
    share = u**3 * (10 - 15 * u + 6 * u**2)
    return (1 - share) * even(told[0], num) + share * even(told[1], num)


def onwards(lanes: Lanes, drivable: Collection[int], route: Sequence[int], way: float) -> list[int]:
    """A route that goes on, as straight as it can, for a way [m] or to the end of the map."""
    out, left = list(route), way
    while left > 0.0:
        options = [k for k in lanes[out[-1]].successors if k in drivable and k not in out]
        if not options:
            break
        out.append(min(options, key=lambda k: abs(turn_of(lanes[k]))))
        left -= way_of(lanes[out[-1]])
    return out


def backwards(lanes: Lanes, drivable: Collection[int], route: Sequence[int], way: float) -> list[int]:
    """A route that begins earlier, as straight as it can, by a way [m] or at the start of the map."""
    out, left = list(route), way
    while left > 0.0:
        options = [k for k in drivable if out[0] in lanes[k].successors and k not in out]
        if not options:
            break
        out.insert(0, min(options, key=lambda k: abs(turn_of(lanes[k]))))
        left -= way_of(lanes[out[0]])
    return out


def turn_of(lane: Lane) -> float:
    """By how much it turns from its start to its end [rad]."""
    first, last = lane.centre[1] - lane.centre[0], lane.centre[-1] - lane.centre[-2]
    return math.remainder(math.atan2(last[1], last[0]) - math.atan2(first[1], first[0]), 2 * math.pi)
