"""Gibbs walks over the associations of a group: the reference method, and draws from groups that are too large.

A sweep draws the choice of every row given those of the others (Vo, Vo and Hoang 2017; Reuter et al. 2017), in the
scaled weights of a `Problem`:

    odds of entry (i, j) = weight_ij / unused_j where column j is not held,   odds of none = alone_i

`weigh` counts each distinct association that was met once, by its own weight. Then log Z is a lower bound, and
marginals are exact once all associations that matter were met; how often the walk meets them does not matter.
`walk_draw` picks one state out of the walk. Departure from the papers: the walk takes alone and unused for FLOOR at
least, or tracks that cannot be missed could never swap measurements; both functions weigh with the true ones.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from inference.association_random import scramble, uniform

FLOOR = 0.05  # next to the weights of the best association, which are one
START = np.uint64(1)


@nb.njit(error_model="numpy")
def sweep(offset, column, odds, alone, random, choice, holder):  # type: ignore[no-untyped-def]
    """Draw the choice (n,) of every row anew, in place; holder (m,) is the row that has a column, -1 for none."""
    for i in range(len(alone)):
        if choice[i] >= 0:
            holder[column[choice[i]]] = -1
        total = max(alone[i], FLOOR)
        mark = -total
        for e in range(offset[i], offset[i + 1]):
            if holder[column[e]] < 0:
                total += odds[e]
        mark += uniform(random) * total
        choice[i] = -1
        if mark >= 0.0:
            for e in range(offset[i], offset[i + 1]):
                if holder[column[e]] < 0 and odds[e] > 0.0:
                    mark -= odds[e]
                    choice[i] = e
                    if mark < 0.0:
                        break
            if choice[i] >= 0:
                holder[column[choice[i]]] = i


@nb.njit(error_model="numpy")
def log2_weight(cost, alone_cost, choice):  # type: ignore[no-untyped-def]
    """Of one association; costs are -log2 of the weights."""
    total = 0.0
    for i in range(len(choice)):
        total -= alone_cost[i] if choice[i] < 0 else cost[choice[i]]
    return total


@nb.njit(error_model="numpy")
def walk_odds(problem, odds):  # type: ignore[no-untyped-def]
    """Fill the odds (e,) of entries."""
    for e in range(len(odds)):
        odds[e] = problem.weight[e] / max(problem.unused[problem.column[e]], FLOOR)


@nb.njit(error_model="numpy")
def weigh(  # type: ignore[no-untyped-def]
    problem, costs, odds, num_sweeps, random, choice, holder, taken, free
):
    """Fill the probabilities that an entry is taken (e,) and a row is alone (n,) from the distinct associations met by
    a walk that starts at choice, the most probable one; returns the log of their summed weight, costs being -log2 of
    the weights that count, of entries (e,) and of being alone (n,)."""
    cost, alone_cost = costs
    n, size = len(choice), 2
    while size < 2 * (num_sweeps + 1):
        size *= 2
    keys, total, best = np.zeros(size, np.uint64), 0.0, log2_weight(cost, alone_cost, choice)
    for e in range(len(odds)):
        taken[e] = 0.0
    for i in range(n):
        free[i] = 0.0
    for _ in range(num_sweeps + 1):
        key = START
        for i in range(n):
            key = scramble(key + np.uint64(choice[i] + 2))
        key |= START  # zero marks an empty place
        place = key >> np.uint64(1)
        while keys[np.int64(place & np.uint64(size - 1))] not in (np.uint64(0), key):
            place += START
        slot = np.int64(place & np.uint64(size - 1))
        if keys[slot] == 0:
            keys[slot] = key
            weight = 2.0 ** (log2_weight(cost, alone_cost, choice) - best)
            total += weight
            for i in range(n):
                if choice[i] < 0:
                    free[i] += weight
                else:
                    taken[choice[i]] += weight
        sweep(problem.offset, problem.column, odds, problem.alone, random, choice, holder)
    for e in range(len(odds)):
        taken[e] /= total
    for i in range(n):
        free[i] /= total
    return math.log(2.0) * best + math.log(total)


@nb.njit(error_model="numpy")
def walk_draw(problem, odds, num_sweeps, random, choice, holder, pick):  # type: ignore[no-untyped-def]
    """Fill pick (n,) with one of the states of num_sweeps sweeps on from choice, chosen by what the floor got wrong."""
    total = 0.0
    for i in range(len(choice)):
        pick[i] = choice[i]
    for _ in range(num_sweeps):
        sweep(problem.offset, problem.column, odds, problem.alone, random, choice, holder)
        weight = 1.0
        for i in range(len(choice)):
            if choice[i] < 0:
                weight *= problem.alone[i] / max(problem.alone[i], FLOOR)
        for j in range(len(holder)):
            if holder[j] < 0:
                weight *= problem.unused[j] / max(problem.unused[j], FLOOR)
        total += weight
        if uniform(random) * total < weight:
            for i in range(len(choice)):
                pick[i] = choice[i]
