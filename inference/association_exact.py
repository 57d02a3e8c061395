"""Sums over all matchings of a group, exactly: forward-backward over bit masks.

    Z = sum over matchings  prod matched weight_(i, j)  prod unmatched rows alone_i  prod unmatched columns unused_j

Rows are passed one by one. What the rows to come need to know of those passed is which columns are taken, and only of
columns that have rows on both sides: a column gets a bit at its first row and gives it back after its last. With b bits
in use at most, time is (number of entries) 2^b. The order of the rows decides on b: the next row is one that needs no
new bit, or the one after which the fewest stay in use. A chain of any length needs two bits.

Rows and columns play the same part in Z, so that a problem may be solved by its transpose where this needs fewer bits:
many rows on few columns, or few rows on many columns.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from inference.association_random import uniform

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Problem(NamedTuple):
    """A group of n rows and m columns, e entries in the order of rows.

    offset  (n + 1,); column (e,), a row has a column once; weight (e,); alone (n,); unused (m,): all weights >= 0
    """

    offset: Ints
    column: Ints
    weight: Array
    alone: Array
    unused: Array


class Plan(NamedTuple):
    """In which order rows are passed, and the bits of the columns.

    order  (n,) rows
    live   (n + 1,) mask of the bits in use before a step, and after the last
    size   (n,) masks of the bits in use during a step are below it
    bit    (m,) of a column, as a mask
    last   (m,) step after which a column gives its bit back
    """

    order: Ints
    live: Ints
    size: Ints
    bit: Ints
    last: Ints


@nb.njit(error_model="numpy")
def arrange(problem, max_bits, plan):  # type: ignore[no-untyped-def]
    """Fill the plan; the number of bits that it needs, max_bits + 1 where these are more than max_bits."""
    offset, column = problem.offset, problem.column
    order, live, size, bit, last = plan
    n, m, width = len(problem.alone), len(problem.unused), 0
    left = last  # entries of a column in the rows to come, until its last step is known
    for j in range(m):
        left[j], bit[j] = 0, 0
    for e in range(offset[n]):
        left[column[e]] += 1
    for i in range(n):
        order[i] = i
    live[0] = 0
    for k in range(n):
        pick, fewest = k, np.iinfo(np.int64).max
        for q in range(k, n):
            i, new, gone = order[q], 0, 0
            for e in range(offset[i], offset[i + 1]):
                new += bit[column[e]] == 0
                gone += left[column[e]] == 1
            score = (new - gone) * (m + 1) + new
            if score < fewest:
                pick, fewest = q, score
            if new == 0:
                break  # needs no bit, now or later
        order[k], order[pick] = order[pick], order[k]
        i, used, after = order[k], live[k], live[k]
        for e in range(offset[i], offset[i + 1]):
            j = column[e]
            if bit[j] == 0:
                b = 0
                while (used >> b) & 1:
                    b += 1
                if b >= max_bits:
                    return max_bits + 1
                bit[j], width = 1 << b, max(width, b + 1)
                used |= bit[j]
        after, size[k] = used, 1
        while size[k] <= used:
            size[k] *= 2
        for e in range(offset[i], offset[i + 1]):
            j = column[e]
            if left[j] == 1:
                last[j] = k
                after &= ~bit[j]
            else:
                left[j] -= 1
        live[k + 1] = after
    return width


@nb.njit(error_model="numpy")
def backward(problem, plan, width, ahead, value):  # type: ignore[no-untyped-def]
    """Fill ahead (n << width), by step and mask s after the row's choice: the sum over all that the rows to come can
    do, up to a factor of the step. Returns log Z, -inf where numbers leave their range. value (1 << width,) is room."""
    offset, column, weight, alone, unused = problem
    order, live, size, bit, last = plan
    n, log_sum = len(alone), 0.0
    value[0] = 1.0
    for k in range(n - 1, -1, -1):
        i, here = order[k], ahead[k << width : (k + 1) << width]
        for s in range(size[k]):
            here[s] = value[s & live[k + 1]]
        for e in range(offset[i], offset[i + 1]):
            j = column[e]
            if last[j] == k:
                for s in range(size[k]):
                    if not s & bit[j]:
                        here[s] *= unused[j]
        top, other = 0.0, ~live[k]
        for s in range(size[k]):
            if s & other:
                continue
            v = alone[i] * here[s]
            for e in range(offset[i], offset[i + 1]):
                b = bit[column[e]]
                if not s & b:
                    v += weight[e] * here[s | b]
            value[s], top = v, max(top, v)
        if not 0.0 < top < np.inf:
            return -np.inf
        log_sum += math.log(top)
        for s in range(size[k]):
            value[s] /= top
    return log_sum + math.log(value[0])


@nb.njit(error_model="numpy")
def forward(problem, plan, width, ahead, reach, room, taken, free, spare):  # type: ignore[no-untyped-def]
    """Fill the probabilities that an entry is taken (e,), a row is alone (n,), a column is unused (m,); False where
    numbers leave their range. reach and room (1 << width,) are room: weights of the masks before and after a step."""
    offset, column, weight, alone, unused = problem
    order, _, size, bit, last = plan
    full = 1 << width
    for s in range(full):
        reach[s] = 0.0
    reach[0] = 1.0
    for k in range(len(alone)):
        i, here = order[k], ahead[k << width : (k + 1) << width]
        v = 0.0
        for s in range(size[k]):
            v += reach[s] * here[s]
            room[s] = reach[s] * alone[i]
        for s in range(size[k], full):
            room[s] = 0.0
        free[i] = v * alone[i]
        total = free[i]
        for e in range(offset[i], offset[i + 1]):
            b, v = bit[column[e]], 0.0
            for s in range(size[k]):
                if not s & b:
                    v += reach[s] * here[s | b]
                    room[s | b] += reach[s] * weight[e]
            taken[e] = v * weight[e]
            total += taken[e]
        if not 0.0 < total < np.inf:
            return False
        free[i] /= total
        for e in range(offset[i], offset[i + 1]):
            taken[e] /= total
            j = column[e]
            if last[j] == k:
                v = 0.0
                for s in range(size[k]):
                    if not s & bit[j]:
                        v += room[s] * here[s]
                spare[j] = v / total
        for e in range(offset[i], offset[i + 1]):
            j = column[e]
            if last[j] == k:
                for s in range(size[k]):
                    if not s & bit[j]:
                        room[s] = unused[j] * room[s] + room[s | bit[j]]
                        room[s | bit[j]] = 0.0
        total = 0.0
        for s in range(size[k]):
            total += room[s]
        for s in range(size[k]):
            room[s] /= total
        reach, room = room, reach
    return True


@nb.njit(error_model="numpy")
def sample(problem, plan, width, ahead, random, choice):  # type: ignore[no-untyped-def]
    """Fill choice (n,) with an exact draw: the entry that each row takes, -1 for none; `ahead` is from `backward`."""
    offset, column, weight, alone, _ = problem
    order, live, _, bit, _ = plan
    s = 0
    for k in range(len(alone)):
        i, here = order[k], ahead[k << width : (k + 1) << width]
        total = alone[i] * here[s]
        for e in range(offset[i], offset[i + 1]):
            if not s & bit[column[e]]:
                total += weight[e] * here[s | bit[column[e]]]
        mark = uniform(random) * total - alone[i] * here[s]
        choice[i], after = -1, s
        if mark >= 0.0:
            for e in range(offset[i], offset[i + 1]):
                b = bit[column[e]]
                if not s & b and weight[e] * here[s | b] > 0.0:
                    mark -= weight[e] * here[s | b]
                    choice[i], after = e, s | b
                    if mark < 0.0:
                        break
        s = after & live[k + 1]
