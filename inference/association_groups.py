"""Groups of tracks that share measurements, and the problem that each is.

Tracks that share measurements, directly or through others, form a group; Z is the product over groups. In a group,
measurements that only one track can take are merged with its being missed:

    alone_t = missed_t + sum over own measurements ratio_(t, j)

so that a group is a matching of rows (tracks) to columns (shared measurements). Its weights are scaled by the powers of
two next to the prices of its best matching, which changes Z by a known factor and keeps every sum near one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from inference.association_exact import Plan, Problem, arrange
from inference.association_matching import Matching, match

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
MASKS = 4
NARROW = 3  # bits that are few enough not to look at the transpose


class Groups(NamedTuple):
    """Of T tracks, E entries and M measurements.

    start   (G + 1,) of the tracks of a group
    track   (T,) by group
    total   (T,) weight of a track: missed and all of its ratios
    shared  (M,) whether several tracks can take a measurement
    """

    start: Ints
    track: Ints
    total: Array
    shared: NDArray[np.bool_]


class Rows(NamedTuple):
    """A group of n tracks, m shared measurements and e entries, in numbers of its own.

    offset (n + 1,); row, column, entry (e,), the entry's number in the table; cost, weight (e,), -log2 of the ratio and
    the scaled ratio; alone_cost, alone (n,); unused (m,) scaled
    """

    offset: Ints
    row: Ints
    column: Ints
    entry: Ints
    cost: Array
    weight: Array
    alone_cost: Array
    alone: Array
    unused: Array


class Room(NamedTuple):
    """Work arrays for the largest group, allocated once per call."""

    local: Ints  # (M,) column of a measurement, -1 outside the present group
    measurement: Ints  # of a column
    rows: Rows
    matching: Matching
    across: Problem  # the transpose
    across_entry: Ints
    plan: Plan
    row_vector: Array
    column_vector: Array
    entry_vectors: Array  # (4, .)
    row_choice: Ints
    column_choice: Ints
    masks: Array  # for groups of up to MASKS bits


@nb.njit(error_model="numpy")
def _root(parent, t):  # type: ignore[no-untyped-def]
    while parent[t] != t:
        parent[t] = parent[parent[t]]
        t = parent[t]
    return t


@nb.njit(error_model="numpy")
def split(offset, measurement, ratio, missed, num_measurements):  # type: ignore[no-untyped-def]
    """The groups, by union-find; entries of ratio zero join nothing."""
    num_tracks = len(missed)
    parent, total = np.arange(num_tracks), np.empty(num_tracks)
    first, shared = np.full(num_measurements, -1), np.zeros(num_measurements, np.bool_)
    for t in range(num_tracks):
        weight = missed[t]
        for k in range(offset[t], offset[t + 1]):
            weight += ratio[k]
            if ratio[k] > 0.0:
                j = measurement[k]
                if first[j] < 0:
                    first[j] = t
                else:
                    shared[j] = True
                    a, b = _root(parent, t), _root(parent, first[j])
                    parent[max(a, b)] = min(a, b)
        total[t] = weight
    count = np.zeros(num_tracks + 1, np.int64)
    for t in range(num_tracks):
        parent[t] = _root(parent, t)
        count[parent[t]] += 1
    start, track, place, num = np.zeros(num_tracks + 1, np.int64), np.empty(num_tracks, np.int64), 0, 0
    for t in range(num_tracks):  # a root is the smallest of its group: place of the group, then of its next track
        if parent[t] == t:
            start[num], num = place, num + 1
            place, count[t] = place + count[t], place
        track[count[parent[t]]] = t
        count[parent[t]] += 1
    start[num] = num_tracks
    return Groups(start[: num + 1], track, total, shared)


@nb.njit(error_model="numpy")
def allocate(groups, offset, measurement):  # type: ignore[no-untyped-def]
    """Room for the largest group."""
    n, e = 0, 0
    for g in range(len(groups.start) - 1):
        size = groups.start[g + 1] - groups.start[g]
        if size == 1:
            continue
        num = 0
        for i in range(groups.start[g], groups.start[g + 1]):
            t = groups.track[i]
            for k in range(offset[t], offset[t + 1]):
                num += groups.shared[measurement[k]]
        n, e = max(n, size), max(e, num)
    m, local = min(e, len(groups.shared)), np.empty(0, np.int64)
    if n > 0:
        local = np.full(len(groups.shared), -1)
    long = max(n, m)
    ints, floats = np.empty((6, e), np.int64), np.empty((8, e))
    short, reals = np.empty((9, long + 1), np.int64), np.empty((9, long))
    rows = Rows(short[0], ints[0], ints[1], ints[2], floats[0], floats[1], reals[0], reals[1], reals[2])
    passed = np.empty(m, np.bool_)
    matching = Matching(short[1], short[2], reals[3], reals[4], reals[5], short[3], passed)
    across = Problem(short[4], ints[3], floats[2], reals[2], reals[1])
    plans = np.empty((5, long + 1), np.int64)
    plan = Plan(plans[0], plans[1], plans[2], plans[3], plans[4])
    return Room(
        local,
        short[5],
        rows,
        matching,
        across,
        ints[4],
        plan,
        reals[6],
        reals[7],
        floats[3:7],
        short[6],
        short[7],
        np.empty((long + 2) << MASKS if n > 0 else 0),
    )


@nb.njit(error_model="numpy")
def gather(g, groups, offset, measurement, ratio, missed, peak, room):  # type: ignore[no-untyped-def]
    """The group's entries and costs; being alone weighs as much as its parts together, or as its best part (peak)."""
    tracks, local, names, rows = groups.track, room.local, room.measurement, room.rows
    first, m, e = groups.start[g], 0, 0
    n = groups.start[g + 1] - first
    for i in range(n):
        t = tracks[first + i]
        alone, rows.offset[i] = missed[t], e
        for k in range(offset[t], offset[t + 1]):
            j = measurement[k]
            if ratio[k] > 0.0 and groups.shared[j]:
                if local[j] < 0:
                    local[j], names[m] = m, j
                    m += 1
                rows.row[e], rows.column[e], rows.entry[e], rows.cost[e] = i, local[j], k, -np.log2(ratio[k])
                e += 1
            else:
                alone = max(alone, ratio[k]) if peak else alone + ratio[k]
        rows.alone[i], rows.alone_cost[i] = alone, -np.log2(alone)
    rows.offset[n] = e
    for j in range(m):
        local[names[j]] = -1
    return Rows(
        rows.offset[: n + 1],
        rows.row[:e],
        rows.column[:e],
        rows.entry[:e],
        rows.cost[:e],
        rows.weight[:e],
        rows.alone_cost[:n],
        rows.alone[:n],
        rows.unused[:m],
    )


@nb.njit(error_model="numpy")
def pair(rows, room):  # type: ignore[no-untyped-def]
    """The best matching of the group, and whether there is one of positive weight."""
    n, m, f = len(rows.alone), len(rows.unused), room.matching
    found = Matching(
        f.choice[:n], f.holder[:m], f.row_price[:n], f.column_price[:m], f.distance[:m], f.arrival[:m], f.passed[:m]
    )
    return found, match(rows.offset, rows.row, rows.column, rows.cost, rows.alone_cost, found)


@nb.njit(error_model="numpy")
def scale(rows, ratio, matching):  # type: ignore[no-untyped-def]
    """Fill the scaled weights; log of what the scale has to be multiplied by."""
    shift = 0.0
    for i in range(len(rows.alone)):
        price = round(matching.row_price[i])
        rows.alone[i] = math.ldexp(rows.alone[i], price)
        shift += price
        for e in range(rows.offset[i], rows.offset[i + 1]):
            rows.weight[e] = math.ldexp(ratio[rows.entry[e]], price + round(matching.column_price[rows.column[e]]))
    for j in range(len(rows.unused)):
        price = round(matching.column_price[j])
        rows.unused[j] = math.ldexp(1.0, price)
        shift += price
    return -math.log(2.0) * shift


@nb.njit(error_model="numpy")
def transpose(rows, room):  # type: ignore[no-untyped-def]
    """The problem with measurements as rows; room.across_entry holds the number of its entries in `rows`."""
    m, e = len(rows.unused), len(rows.column)
    offset, column, weight = room.across.offset[: m + 1], room.across.column[:e], room.across.weight[:e]
    for j in range(m + 1):
        offset[j] = 0
    for k in range(e):
        offset[rows.column[k]] += 1
    place = 0
    for j in range(m):
        place += offset[j]
        offset[j] = place
    offset[m] = place
    for k in range(e - 1, -1, -1):
        j = rows.column[k]
        offset[j] -= 1
        column[offset[j]], weight[offset[j]], room.across_entry[offset[j]] = rows.row[k], rows.weight[k], k
    return Problem(offset, column, weight, rows.unused, rows.alone)


@nb.njit(error_model="numpy")
def upright(rows):  # type: ignore[no-untyped-def]
    """The problem with tracks as rows."""
    return Problem(rows.offset, rows.column, rows.weight, rows.alone, rows.unused)


@nb.njit(error_model="numpy")
def prepare(rows, max_shared, room):  # type: ignore[no-untyped-def]
    """The group as the problem, upright or transposed, that needs fewer bits, with room.plan laid out for it:
    (problem, whether it is transposed, bits or more than max_shared)."""
    problem = upright(rows)
    width = arrange(problem, max_shared, room.plan)
    if width <= min(NARROW, max_shared):
        return problem, False, width
    other = transpose(rows, room)
    other_width = arrange(other, min(width - 1, max_shared), room.plan)
    if other_width < width and other_width <= max_shared:
        return other, True, other_width
    return problem, False, arrange(problem, max_shared, room.plan)


@nb.njit(error_model="numpy")
def finite(first, last, groups):  # type: ignore[no-untyped-def]
    """Whether the tracks of a group have weights that can be summed."""
    for i in range(first, last):
        if not 0.0 < groups.total[groups.track[i]] < np.inf:
            return False
    return True
