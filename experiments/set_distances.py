"""Distances between sets of points, and between sets of paths, of which neither size nor order need agree.

d is Euclidean, c the cut-off: d_c = min(d, c), and pi assigns each member of the smaller set one of the larger.

Of libraries, Stone Soup has OSPA and GOSPA, but weighs a tracking framework; assigns by d where the definition asks for
d^p, so that its OSPA is right for p = 1 only; and finds GOSPA by an auction that may miss the optimum. trackeval has
neither. Hence own code, with the assignment of scipy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Gospa(NamedTuple):
    """GOSPA with alpha = 2 and its parts:  distance^p = localisation^p + c^p (missed + false) / 2.

    localisation  of the assigned pairs, (sum d^p)^(1/p) [m]
    missed        members of the first set, the truth, without a partner nearer than c
    false         members of the second set, the estimate, without
    pairs         (K, 2) the assigned members of both
    """

    distance: float
    localisation: float
    missed: int
    false: int
    pairs: Ints


def ospa(first: Floats, second: Floats, *, cutoff: float, order: float = 1.0) -> float:
    """OSPA distance [m] of points (n, D) and (m, D), n <= m; 0 between empty sets:

        ( (min_pi sum_i d_c(x_i, y_pi(i))^p + c^p (m - n)) / m )^(1/p)

    Schuhmacher, Vo, Vo (2008), eq. 3. Raises InputError for a cut-off that is not positive and an order below 1."""
    _check(cutoff, order)
    return _ospa(_capped(first, second, cutoff), cutoff, order)


def gospa(truth: Floats, estimate: Floats, *, cutoff: float, order: float = 2.0) -> Gospa:
    """GOSPA distance [m] of points (n, D) and (m, D), over assignments of any number of pairs:

        ( min sum over pairs d^p + c^p (n + m - 2 pairs) / 2 )^(1/p)

    Rahmathullah, Garcia-Fernandez, Svensson (2017), proposition 1. Raises InputError as ospa."""
    _check(cutoff, order)
    capped = _capped(truth, estimate, cutoff)
    rows, columns = linear_sum_assignment(capped**order)
    near = capped[rows, columns] < cutoff
    pairs = np.stack([rows[near], columns[near]], -1)
    located = float((capped[rows[near], columns[near]] ** order).sum())
    missed, false = len(truth) - len(pairs), len(estimate) - len(pairs)
    distance = located + 0.5 * cutoff**order * (missed + false)
    return Gospa(distance ** (1.0 / order), located ** (1.0 / order), missed, false, pairs)


def ospa2(first: Floats, second: Floats, *, cutoff: float, order: float = 1.0, window: int = 10) -> Floats:
    """OSPA(2) distance (T,) [m] of paths (n, T, D) and (m, T, D), NaN where a path is absent, over the last `window` of
    the T times up to each: the OSPA distance of the paths that are there in the window, with the mean over the times at
    which one of two paths is there of

        d_c where both are, c where one is

    as the distance between them. Beard, Vo, Vo (2020), with equal weights and q = 1. Raises InputError as ospa."""
    _check(cutoff, order)
    if window < 1:
        raise InputError(f"window of OSPA(2) is {window}; give 1 scan or more")
    there, seen = ~np.isnan(first[..., 0]), ~np.isnan(second[..., 0])
    out = np.zeros(first.shape[1])
    for t in range(len(out)):
        part = slice(max(0, t + 1 - window), t + 1)
        a, b = there[:, part].any(1), seen[:, part].any(1)
        out[t] = _ospa(_between_paths(first[a, part], second[b, part], cutoff), cutoff, order)
    return out


def _between_paths(first: Floats, second: Floats, cutoff: float) -> Floats:
    """(n, m) mean distances of paths (n, W, D) and (m, W, D), each there at some time."""
    there, seen = ~np.isnan(first[..., 0]), ~np.isnan(second[..., 0])
    gap = np.minimum(np.linalg.norm(first[:, None] - second, axis=-1), cutoff)  # (n, m, W)
    either = there[:, None] | seen
    gap = np.where(there[:, None] & seen, gap, np.where(either, cutoff, 0.0))
    return np.asarray(gap.sum(-1) / either.sum(-1))


def _ospa(capped: Floats, cutoff: float, order: float) -> float:
    """From the distances d_c (n, m) of all pairs."""
    few, many = sorted(capped.shape)
    if many == 0:
        return 0.0
    cost = capped**order
    total = float(cost[linear_sum_assignment(cost)].sum()) + cutoff**order * (many - few)
    return float((total / many) ** (1.0 / order))


def _capped(first: Floats, second: Floats, cutoff: float) -> Floats:
    return np.minimum(np.linalg.norm(first[:, None] - second[None], axis=-1), cutoff)


def _check(cutoff: float, order: float) -> None:
    if not 0.0 < cutoff < np.inf:
        raise InputError(f"cutoff is {cutoff} m; give a positive distance beyond which an object counts as another")
    if not 1.0 <= order < np.inf:
        raise InputError(f"order is {order}; distances between sets need a finite one of 1 or more")
