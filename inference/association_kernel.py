"""Data association of one scan in machine code; `inference.association` has the equations and checks.

Tracks that share measurements, directly or through others, form a group; Z is the product over groups. A track by
itself needs one sum. In a group, measurements that only one track can take are merged with its being missed:

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

from inference.association_exact import Plan, Problem, arrange, backward, forward, sample
from inference.association_gibbs import walk_draw, walk_odds, weigh
from inference.association_loopy import propagate
from inference.association_matching import Matching, match
from inference.association_random import uniform

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
AUTO, LOOPY, GIBBS = 0, 1, 2  # methods
MISSED, IMPOSSIBLE = -1, -2  # in associations; the second where a group has none of positive weight
TINY = 5e-324  # keeps a track that cannot be alone from 0 / 0
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
def sum_exactly(rows, max_shared, room):  # type: ignore[no-untyped-def]
    """Log Z of a group's scaled weights, -inf where it needs more than max_shared bits; for the rest see `_weigh`."""
    problem, across, width = prepare(rows, max_shared, room)
    if width > max_shared:
        return -np.inf
    n, free, spare = len(problem.alone), room.row_vector, room.column_vector
    taken, other_taken = room.entry_vectors[0], room.entry_vectors[1]
    ahead = room.masks if len(room.masks) >= (n + 2) << width else np.empty((n + 2) << width)
    value, reach = ahead[n << width : (n + 1) << width], ahead[(n + 1) << width :]
    log_sum = backward(problem, room.plan, width, ahead, value)
    if log_sum == -np.inf:
        return log_sum
    if not across:
        return log_sum if forward(problem, room.plan, width, ahead, reach, value, taken, free, spare) else -np.inf
    if not forward(problem, room.plan, width, ahead, reach, value, other_taken, spare, free):
        return -np.inf
    for e in range(len(rows.column)):
        taken[room.across_entry[e]] = other_taken[e]
    return log_sum


@nb.njit(error_model="numpy")
def _finite(first, last, groups):  # type: ignore[no-untyped-def]
    """Whether the tracks of a group have weights that can be summed."""
    for i in range(first, last):
        if not 0.0 < groups.total[groups.track[i]] < np.inf:
            return False
    return True


@nb.njit(error_model="numpy")
def _weigh(rows, ratio, method, max_shared, tolerance, max_iterations, num_sweeps, random, room):  # type: ignore[no-untyped-def]
    """(log Z of a group, -inf where it has no association; whether it is approximate; whether it did not converge);
    taken (e,) and alone (n,) are left in room.entry_vectors[0] and room.row_vector."""
    matching, possible = pair(rows, room)
    if not possible:
        return -np.inf, False, False
    shift = scale(rows, ratio, matching)
    if method == AUTO:
        log_sum = sum_exactly(rows, max_shared, room)
        if log_sum > -np.inf:
            return log_sum + shift, False, False
    problem, taken, alone = upright(rows), room.entry_vectors[0], room.row_vector
    if method == GIBBS:
        odds, costs, start = room.entry_vectors[1][: len(rows.column)], (rows.cost, rows.alone_cost), matching.choice
        walk_odds(problem, odds)
        log_sum = weigh(problem, costs, odds, num_sweeps, random, start, matching.holder, taken, alone)
        return log_sum, True, False
    mu, nu, rest = room.entry_vectors[1], room.entry_vectors[2], room.entry_vectors[3]
    log_sum, converged = propagate(problem, tolerance, max_iterations, mu, nu, rest, room.column_vector, taken, alone)
    return log_sum + shift, True, not converged


@nb.njit(cache=True, error_model="numpy")
def associate(  # type: ignore[no-untyped-def]
    offset,
    measurement,
    ratio,
    missed,
    num_measurements,
    method,
    max_shared,
    tolerance,
    max_iterations,
    num_sweeps,
    random,
    taken,
    free,
):
    """Fill taken (E,) and free (T,); returns (log Z, groups approximated, groups of these that did not converge).

    offset (T + 1,) int64, measurement (E,) int64, ratio (E,) and missed (T,) finite and >= 0, a measurement once per
    track; method AUTO, LOOPY or GIBBS; random (1,) uint64, the state of GIBBS, advanced in place. Nothing is checked.

    A group that has no association of positive weight, or a track whose weights are not finite, makes log Z = -inf, and
    its taken and free are all zero. No NaN comes out."""
    groups = split(offset, measurement, ratio, missed, num_measurements)
    room = allocate(groups, offset, measurement)
    log_partition, num_approximate, num_unconverged = 0.0, 0, 0
    for g in range(len(groups.start) - 1):
        first, last = groups.start[g], groups.start[g + 1]
        if not _finite(first, last, groups):
            log_partition = -np.inf
        elif last - first == 1:
            t = groups.track[first]
            log_partition += math.log(groups.total[t])
            free[t] = missed[t] / groups.total[t]
            for k in range(offset[t], offset[t + 1]):
                taken[k] = ratio[k] / groups.total[t]
            continue
        else:
            rows = gather(g, groups, offset, measurement, ratio, missed, False, room)
            log_sum, approximate, unconverged = _weigh(
                rows, ratio, method, max_shared, tolerance, max_iterations, num_sweeps, random, room
            )
            log_partition += log_sum
            if log_sum > -np.inf:
                num_approximate += approximate
                num_unconverged += unconverged
                _spread(g, groups, rows, offset, measurement, ratio, missed, room, taken, free)
                continue
        for i in range(first, last):
            t = groups.track[i]
            free[t] = 0.0
            for k in range(offset[t], offset[t + 1]):
                taken[k] = 0.0
    return log_partition, num_approximate, num_unconverged


@nb.njit(error_model="numpy")
def _spread(g, groups, rows, offset, measurement, ratio, missed, room, taken, free):  # type: ignore[no-untyped-def]
    """Write a group's marginals into those of the table; that of being alone is divided among its parts."""
    chosen, alone = room.entry_vectors[0], room.row_vector
    for i in range(len(rows.alone)):
        t, weight = groups.track[groups.start[g] + i], missed[groups.track[groups.start[g] + i]]
        for k in range(offset[t], offset[t + 1]):
            taken[k] = 0.0
            if ratio[k] > 0.0 and not groups.shared[measurement[k]]:
                weight += ratio[k]
        weight = max(weight, TINY)
        free[t] = missed[t] / weight * alone[i]
        for k in range(offset[t], offset[t + 1]):
            if not groups.shared[measurement[k]]:
                taken[k] = ratio[k] / weight * alone[i]
        for e in range(rows.offset[i], rows.offset[i + 1]):
            taken[rows.entry[e]] = chosen[e]


@nb.njit(error_model="numpy")
def _own(t, groups, offset, measurement, ratio, missed, draw, random):  # type: ignore[no-untyped-def]
    """What a track does that takes no shared measurement: the best of it, or a draw."""
    total, best = missed[t], missed[t]
    for k in range(offset[t], offset[t + 1]):
        if not groups.shared[measurement[k]]:
            total += ratio[k]
    mark, pick = -missed[t], MISSED
    if draw:
        mark += uniform(random) * total
    for k in range(offset[t], offset[t + 1]):
        if groups.shared[measurement[k]] or ratio[k] == 0.0:
            continue
        if draw and mark < 0.0:
            break
        mark -= ratio[k]
        if draw or ratio[k] > best:
            pick, best = measurement[k], ratio[k]
    return pick


@nb.njit(error_model="numpy")
def _settle(g, groups, choice, rows, offset, measurement, ratio, missed, draw, random, theta):  # type: ignore[no-untyped-def]
    """Write a group's choice (n,) of entries into theta (T,)."""
    for i in range(groups.start[g + 1] - groups.start[g]):
        t = groups.track[groups.start[g] + i]
        if choice[i] >= 0:
            theta[t] = measurement[rows.entry[choice[i]]]
        else:
            theta[t] = _own(t, groups, offset, measurement, ratio, missed, draw, random)


@nb.njit(cache=True, error_model="numpy")
def choose(  # type: ignore[no-untyped-def]
    offset, measurement, ratio, missed, num_measurements, max_shared, num_sweeps, random, draw, theta
):
    """Fill theta (S, T) with draws of the association, or its one row with the most probable one (draw False):
    measurements, MISSED, or IMPOSSIBLE for all tracks of a group without an association. Returns how many groups were
    drawn from by Gibbs walks, because they need more than max_shared bits. Arguments as for `associate`."""
    groups = split(offset, measurement, ratio, missed, num_measurements)
    room = allocate(groups, offset, measurement)
    num_approximate, none = 0, np.full(1, -1)
    for g in range(len(groups.start) - 1):
        first, last = groups.start[g], groups.start[g + 1]
        possible = _finite(first, last, groups)
        if possible and last - first > 1:
            rows = gather(g, groups, offset, measurement, ratio, missed, not draw, room)
            matching, possible = pair(rows, room)
        if not possible:
            for i in range(first, last):
                theta[:, groups.track[i]] = IMPOSSIBLE
            continue
        if last - first == 1:
            for s in range(len(theta)):
                _settle(g, groups, none, room.rows, offset, measurement, ratio, missed, draw, random, theta[s])
            continue
        if not draw:
            _settle(g, groups, matching.choice, rows, offset, measurement, ratio, missed, False, random, theta[0])
            continue
        scale(rows, ratio, matching)
        problem, across, width = prepare(rows, max_shared, room)
        pick, exact = room.row_choice[: last - first], width <= max_shared
        if exact:
            n = len(problem.alone)
            ahead = np.empty((n + 1) << width)
            exact = backward(problem, room.plan, width, ahead, ahead[n << width :]) > -np.inf
        num_approximate += not exact
        if not exact:
            problem, odds = upright(rows), room.entry_vectors[0][: len(rows.column)]
            walk_odds(problem, odds)
        for s in range(len(theta)):
            if not exact:
                walk_draw(problem, odds, num_sweeps, random, matching.choice, matching.holder, pick)
            elif across:
                sample(problem, room.plan, width, ahead, random, room.column_choice)
                for i in range(len(pick)):
                    pick[i] = -1
                for j in range(len(problem.alone)):
                    if room.column_choice[j] >= 0:
                        e = room.across_entry[room.column_choice[j]]
                        pick[rows.row[e]] = e
            else:
                sample(problem, room.plan, width, ahead, random, pick)
            _settle(g, groups, pick, rows, offset, measurement, ratio, missed, True, random, theta[s])
    return num_approximate
