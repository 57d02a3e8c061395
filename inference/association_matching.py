"""The most probable matching of a group and its prices, by shortest augmenting paths (Jonker and Volgenant 1987).

Rows take one column each, or none at a cost of their own. With cost = -log2 weight the cheapest matching minimises

    sum over matched rows cost_(i, j) + sum over the others alone_i

Its prices, row_price and column_price <= 0, tell how cheap it is:

    cost_(i, j) >= row_price_i + column_price_j,   alone_i >= row_price_i

with equality on the matching, and column_price_j = 0 for columns that it leaves. Weights times 2^prices are therefore
at most one everywhere and one on the best matching: no sum over matchings can overflow or vanish, whatever the range
of the weights (`inference.association_groups`).
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Matching(NamedTuple):
    """Of n rows to m columns.

    choice        (n,) the entry that a row takes, -1 for none
    holder        (m,) the row that has a column, -1 for none
    row_price     (n,) in log2; column_price (m,)
    distance, arrival, passed
                  (m,) room for the search: length of the shortest path to a column, its last entry, whether it is final
    """

    choice: Ints
    holder: Ints
    row_price: Array
    column_price: Array
    distance: Array
    arrival: Ints
    passed: NDArray[np.bool_]


@nb.njit(error_model="numpy")
def match(offset, row, column, cost, alone, found):  # type: ignore[no-untyped-def]
    """Fill `found` with the cheapest matching; False where there is none of finite cost.

    offset (n + 1,) of the entries of a row, row (e,), column (e,), cost (e,) finite, alone (n,) may be infinite"""
    n, m = len(alone), len(found.holder)
    for j in range(m):
        found.holder[j], found.column_price[j] = -1, 0.0
    for i in range(n):
        found.choice[i], found.row_price[i] = -1, 0.0
    for i in range(n):
        if not _insert(i, offset, row, column, cost, alone, found):
            return False
    return True


@nb.njit(error_model="numpy")
def _insert(start, offset, row, column, cost, alone, found):  # type: ignore[no-untyped-def]
    """Match one more row: Dijkstra's shortest path to a column that is not held, or to a row that goes without."""
    choice, holder, row_price, column_price, distance, arrival, passed = found
    m = len(holder)
    for j in range(m):
        distance[j], passed[j] = np.inf, False
    i, length, least, leaver = start, 0.0, np.inf, -1
    while True:
        if length + alone[i] - row_price[i] < least:
            least, leaver = length + alone[i] - row_price[i], i
        for e in range(offset[i], offset[i + 1]):
            j = column[e]
            d = length + cost[e] - row_price[i] - column_price[j]
            if not passed[j] and d < distance[j]:
                distance[j], arrival[j] = d, e
        end, length = -1, least
        for j in range(m):
            if not passed[j] and distance[j] < length:
                end, length = j, distance[j]
        if length == np.inf:
            return False
        if end < 0 or holder[end] < 0:
            break
        passed[end], i = True, holder[end]
    row_price[start] += length
    for j in range(m):
        if passed[j]:
            row_price[holder[j]] += length - distance[j]
            column_price[j] -= length - distance[j]
    e = -1 if end < 0 else arrival[end]
    i = leaver if end < 0 else row[e]
    while True:
        before, choice[i] = choice[i], e
        if e >= 0:
            holder[column[e]] = i
        if i == start:
            return True
        e = arrival[column[before]]
        i = row[e]
