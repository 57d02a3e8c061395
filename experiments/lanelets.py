"""Lanelets of a junction: centre lines that run together share them, and each is alone where it differs.

[M20] section IV ends by merging lanes that converged onto one centre line into a single lanelet. Two lanes seldom
coincide throughout, so merging is partial here. Lanes of one entry share lanelets until they are more than `apart`
from one another, lanes of one exit from where they come within it, each of several lanes that part one after another
as long as it can (a tree). Between the two every lane has a lanelet of its own, at least SHORTEST long, so that no
vehicle can change from one route to another on the way.

The centre of a shared lanelet is the mean m_G of the lanes G that run on it. Where they leave the larger group F at
arc length s0, d = m_F - m_G fades away,

    c(s) = m_G(s) + (1 - u)^2 ((1 + 2 u) d(s0) + u SHORTEST d'(s0)),    u = clip((s - s0) / SHORTEST, 0, 1)

so that centres have no kink at s0 and are back on the mean of their own lanes after SHORTEST. Exits are the entries
of the reversed lanes.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import Akima1DInterpolator
from scipy.spatial.distance import cdist

from experiments.scenarios.paths import arc_length
from models.program import InputError

Floats = NDArray[np.float64]
STEP = 0.5  # between the points of a lanelet [m]
SHORTEST = 5.0  # lanelet [m]
CLEAR = 0.02  # what a border may lack of half a width [m]


class Lanelet(NamedTuple):
    """Borders and centre, each (n, 2) with its own n, of a piece of road, in driving order [m]."""

    left: Floats
    right: Floats
    centre: Floats


class LaneletMap(NamedTuple):
    """Lanelets of a junction and how vehicles pass them.

    lanelets   each
    followers  pairs (before, after) that a vehicle drives one after the other; all points at their common end are equal
    routes     the lanelets that each connection drives, in driving order
    """

    lanelets: list[Lanelet]
    followers: list[tuple[int, int]]
    routes: list[list[int]]


class Branch(NamedTuple):
    """Lanes that run together from `since` to `until` [m], and those that ran with them up to `since`.

    Of a lane that is alone `until` is infinite: it goes on until it joins others."""

    lanes: list[int]
    before: list[int]
    since: float
    until: float


def lanelet_map(
    lines: list[Floats], connections: NDArray[np.int64], width: ArrayLike = 2.7, *, apart: float = 0.5
) -> LaneletMap:
    """Split and merge L centre lines (n, 2) in driving order into lanelets.

    connections  (L, 4) entry arm, entry lane, exit arm, exit lane of each line
    width        of all lanes or of each (L,) [m]
    apart        how far from one another lanes of one entry or exit may run and still be one [m]

    Raises InputError for lines that are not finite, have no length or do not match the connections or widths."""
    strands = _strands(lines, connections, width)
    stubs = connections[:, :2], connections[:, 2:]
    for stub in stubs:  # first all begin, then all end, where the first of their stub does
        strands = [strand[::-1] for strand in _begin_together(strands, stub, apart)]
    ways = strands, [strand[::-1] for strand in strands]
    together = [_together(way, stub, apart) for way, stub in zip(ways, stubs, strict=True)]

    twin = np.isinf(np.maximum(*together)).argmax(1)  # the first lane that each coincides with throughout
    kept, place = np.unique(twin, return_inverse=True)
    if len(kept) < len(lines):
        widths = np.broadcast_to(width, len(lines))[kept]
        merged = lanelet_map([strands[lane][:, :2] for lane in kept], connections[kept], widths, apart=apart)
        return merged._replace(routes=[merged.routes[lane] for lane in place])

    _leave_middles(together, strands)
    centres, routes, num_entries = _pieces(ways, [list(branches(each, list(range(len(lines))))) for each in together])
    followers = sorted({pair for route in routes for pair in pairwise(route)})
    lanelets = [_borders(centre) for centre in centres]
    for before, after in followers:
        for one, other in zip(lanelets[before], lanelets[after], strict=True):
            if before < num_entries:  # the shared lanelet says where their common end is
                other[0] = one[-1]
            else:
                one[-1] = other[0]
    lanelets = [Lanelet(_clear(left, centre), _clear(right, centre), centre) for left, right, centre in lanelets]
    return LaneletMap(lanelets, followers, routes)


def branches(
    together: Floats, lanes: list[int], before: list[int] | None = None, since: float = 0.0
) -> Iterator[Branch]:
    """The tree of lanes that run together, from the beginning on; every lane ends as a branch of its own.

    together  (L, L) how far from their beginning two lanes are one [m]; infinite on the diagonal

    Lanes part together where they would otherwise have to part again within SHORTEST."""
    groups: list[list[int]] = []
    for lane in lanes:
        mates = (group for group in groups if together[lane, group].min() >= since + SHORTEST)
        home = next(mates, None)
        if home is None:
            groups.append([lane])
        else:
            home.append(lane)
    for group in groups:
        until = float(together[np.ix_(group, group)].min())
        yield Branch(group, before or group, since, until)
        if len(group) > 1:
            yield from branches(together, group, group, until)


def _strands(lines: list[Floats], connections: NDArray[np.int64], width: ArrayLike) -> list[Floats]:
    """Centre lines with half their width as a third column, (n, 3), smooth between points as borders bend more."""
    if not lines or connections.shape != (len(lines), 4):
        raise InputError(
            f"a map needs lines and connections (lines, 4), but has {len(lines)} lines and connections "
            f"{connections.shape}; give each line its entry arm, entry lane, exit arm and exit lane"
        )
    widths = np.asarray(width, dtype=np.float64)
    if widths.shape not in ((), (len(lines),)) or not (widths > 0).all():
        raise InputError(f"the width must be a positive number, or one for each of {len(lines)} lines, but is {widths}")
    strands = []
    for number, (line, half) in enumerate(zip(lines, np.broadcast_to(widths / 2, len(lines)), strict=True)):
        if line.ndim != 2 or line.shape[1] != 2 or not np.isfinite(line).all() or not np.ptp(line, axis=0).any():
            raise InputError(f"line {number} must be (n, 2) finite points of a path with a length; leave it out")
        along, first = np.unique(arc_length(line), return_index=True)
        smooth = Akima1DInterpolator(along, line[first])(_stations(0.0, along[-1]))
        strands.append(np.column_stack([smooth, np.full(len(smooth), half)]))
    return strands


def _begin_together(strands: list[Floats], stub: NDArray[np.int64], apart: float) -> list[Floats]:
    """Strands that were seen from farther in on begin like the closest one of their stub."""
    out = list(strands)
    for name in np.unique(stub, axis=0):
        lanes = np.flatnonzero((stub == name).all(1))
        behind = [sum(_closest(strands[other], strands[lane][0])[0] for other in lanes) for lane in lanes]
        done: list[int] = []
        for lane in lanes[np.argsort(behind, kind="stable")]:
            found = [(*_closest(out[other], out[lane][0])[::-1], other) for other in done]
            distance, s, other = min(found, default=(np.inf, 0.0, -1))
            if distance <= apart and s > 0:
                out[lane] = _prolonged(out[lane], out[other], s)
            done.append(lane)
    return out


def _prolonged(strand: Floats, other: Floats, s: float) -> Floats:
    """`other` up to arc length s, then `strand`, moved over where it begins."""
    along = arc_length(other[:, :2])
    gate = _at(other, np.array([s]))[0]
    moved = strand + _fading(arc_length(strand[:, :2]), gate - strand[0])
    return np.concatenate([other[along < s], moved])


def _together(strands: list[Floats], stub: NDArray[np.int64], apart: float) -> Floats:
    """(L, L) how far from their beginning two lanes run together [m]: 0 if from two stubs, infinite if throughout."""
    longest = max(arc_length(strand[:, :2])[-1] for strand in strands)
    s = np.arange(0.0, longest + STEP, STEP)
    points = np.stack([_at(strand, s)[:, :2] for strand in strands])  # (L, M, 2)
    parted = np.linalg.norm(points[:, None] - points[None], axis=-1) > apart  # (L, L, M)
    last = STEP * np.maximum(parted.argmax(-1) - 1, 0)
    last[~parted.any(-1)] = np.inf
    last[(stub[:, None] != stub[None]).any(-1)] = 0.0
    return last


def _leave_middles(together: list[Floats], strands: list[Floats]) -> None:
    """Shorten in place what is shared, in proportion, until SHORTEST of every lane is not."""
    for each in together:
        np.fill_diagonal(each, 0.0)
    lengths = np.array([arc_length(strand[:, :2])[-1] for strand in strands])
    ends = [each.max(1) for each in together]
    room = np.clip((lengths - SHORTEST) / np.maximum(ends[0] + ends[1], 1e-9), 0.0, 1.0)
    for each, end in zip(together, ends, strict=True):
        limit = room * end
        each[:] = np.minimum(each, np.minimum(limit[:, None], limit))
        np.fill_diagonal(each, np.inf)


def _pieces(ways: tuple[list[Floats], ...], trees: list[list[Branch]]) -> tuple[list[Floats], list[list[int]], int]:
    """Centres with half widths (n, 3) of all lanelets, the route of every lane, and how many of entries come first.

    ways   strands in driving order, and reversed
    trees  branches from the entries and from the exits"""
    shared = [[branch for branch in tree if len(branch.lanes) > 1] for tree in trees]
    alone = [{branch.lanes[0]: branch for branch in tree if len(branch.lanes) == 1} for tree in trees]
    pieces = []
    for branch in shared[0]:
        pieces.append((branch.lanes, _course(ways[0], branch, _stations(branch.since, branch.until))))
    for lane, strand in enumerate(ways[0]):
        start, end, length = alone[0][lane], alone[1][lane], arc_length(strand[:, :2])[-1]
        s = _stations(start.since, length - end.since)
        pieces.append(([lane], _course(ways[0], start, s) + _course(ways[1], end, length - s) - _at(strand, s)))
    for branch in reversed(shared[1]):
        pieces.append((branch.lanes, _course(ways[1], branch, _stations(branch.since, branch.until))[::-1]))
    routes = [[number for number, (lanes, _) in enumerate(pieces) if lane in lanes] for lane in range(len(ways[0]))]
    return [centre for _, centre in pieces], routes, len(shared[0])


def _course(strands: list[Floats], branch: Branch, s: Floats) -> Floats:
    """Centre and half width of a branch at arc lengths s (m,), (m, 3): the equation above."""
    gate = np.array([branch.since - STEP, branch.since])
    gap = _mean(strands, branch.before, gate) - _mean(strands, branch.lanes, gate)  # (2, 3)
    return _mean(strands, branch.lanes, s) + _fading(s - branch.since, gap[1], (gap[1] - gap[0]) / STEP)


def _mean(strands: list[Floats], lanes: list[int], s: Floats) -> Floats:
    return np.mean([_at(strands[lane], s) for lane in lanes], axis=0, dtype=np.float64)


def _fading(t: Floats, gap: Floats, slope: Floats | float = 0.0) -> Floats:
    """What is left of a gap (3,) of some slope at t (m,) metres behind it, (m, 3)."""
    u = np.clip(t / SHORTEST, 0.0, 1.0)[:, None]
    return np.asarray((1 - u) ** 2 * ((1 + 2 * u) * gap + u * SHORTEST * slope))


def _stations(since: float, until: float) -> Floats:
    return np.linspace(since, until, max(int(np.ceil((until - since) / STEP)), 1) + 1)


def _at(strand: Floats, s: Floats) -> Floats:
    along = arc_length(strand[:, :2])
    return np.stack([np.interp(s, along, column) for column in strand.T], axis=1)


def _closest(strand: Floats, point: Floats) -> tuple[float, float]:
    """Arc length of the place on a strand that is closest to a point, and its distance [m]."""
    path, along = strand[:, :2], arc_length(strand[:, :2])
    steps = np.diff(path, axis=0)
    ratio = np.einsum("ij,ij->i", point[:2] - path[:-1], steps) / np.maximum((steps**2).sum(1), 1e-12)
    ratio = np.clip(ratio, 0.0, 1.0)
    distance = np.linalg.norm(path[:-1] + ratio[:, None] * steps - point[:2], axis=1)
    best = int(distance.argmin())
    return float(along[best] + ratio[best] * (along[best + 1] - along[best])), float(distance[best])


def _borders(centre: Floats) -> Lanelet:
    """Borders half a width to both sides of a centre with half widths, (n, 3)."""
    path, half = centre[:, :2], centre[:, 2:]
    tangent = np.gradient(path, axis=0)
    left = half * np.stack([-tangent[:, 1], tangent[:, 0]], 1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    return Lanelet(path + left, path - left, path.copy())


def _clear(border: Floats, centre: Floats) -> Floats:
    """A border (n, 2) without the points that would make it run backwards.

    They are those that come closer to another part of the same turn of the centre, or next to the border's ends."""
    half, along = np.linalg.norm(border - centre, axis=1), arc_length(centre)
    turn = np.abs(along[:, None] - along) < np.pi * half[:, None]
    keep = np.where(turn, cdist(border, centre), np.inf).min(1) > half - CLEAR
    keep &= cdist(border, border[[0, -1]]).min(1) > STEP / 2
    keep[[0, -1]] = True
    return border[keep]
