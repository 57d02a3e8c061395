"""Data association of one scan in machine code; `inference.association` has the equations and checks.

A track by itself needs one sum. Groups (`inference.association_groups`) are summed over by one of the methods.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from inference.association_exact import backward, forward, sample
from inference.association_gibbs import walk_draw, walk_odds, weigh
from inference.association_groups import allocate, finite, gather, pair, prepare, scale, split, upright
from inference.association_loopy import propagate
from inference.association_random import uniform

AUTO, LOOPY, GIBBS = 0, 1, 2  # methods
MISSED, IMPOSSIBLE = -1, -2  # in associations; the second where a group has none of positive weight
TINY = 5e-324  # keeps a track that cannot be alone from 0 / 0


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
        if not finite(first, last, groups):
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
        possible = finite(first, last, groups)
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
