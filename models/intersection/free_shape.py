"""The nodes of a lane's reference curve: on its stubs beside the axes of the arms, between them its own first course.

Along a lane the parameter t of its spline counts metres: on its entry stub from the outer end of the arm's axis, then
on its own course in knots that are equal among themselves, then on its exit stub. Within BLEND metres of a stub the
reference goes over into the lane's own course.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from models.intersection.reference import arc_length
from models.intersection.stubs import Side, Stubs, beside

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
BLEND = 12.0  # [m]


class Shape(NamedTuple):
    """The reference curve of a lane: nodes (n, 2) at t (n,) of its spline, and how many of its pieces are on the entry
    stub, free and on the exit stub (3,)."""

    nodes: Array
    t: Array
    pieces: Ints


def shape(line: Array, pair: tuple[Side, Side], stubs: Stubs, knots: float, spacing: float) -> Shape:
    """The reference curve of a lane with first course `line` (n, 2)."""
    s = arc_length(line)
    first, last = pair[0].own, s[-1] - pair[1].own
    inner = max(math.ceil((last - first) / knots - 1e-6), 1)
    steps = np.linspace(0.0, 1.0, inner * max(round(knots / spacing), 1) + 1)
    own = first + steps * (last - first)
    course = np.asarray(CubicSpline(s, line)(own))
    t = (pair[0].pieces + steps * inner) * knots
    total = (pair[0].pieces + inner + pair[1].pieces) * knots
    nodes, times = [course], [t]
    for end, side in enumerate(pair):
        if side.stub >= 0:
            leaves = side.pieces * knots
            past = own - first if end == 0 else last - own
            beyond = beside(stubs, side.stub, leaves + past)
            course += _fade(past / BLEND)[:, None] * (beyond - course)
            outer = np.arange(math.ceil(side.begins / spacing - 1e-6) * spacing, leaves - 0.5 * spacing, spacing)
            points = beside(stubs, side.stub, outer)
            nodes = [points, *nodes] if end == 0 else [*nodes, points[::-1]]
            times = [outer, *times] if end == 0 else [*times, total - outer[::-1]]
    pieces = np.array([pair[0].pieces, inner, pair[1].pieces])
    return Shape(np.concatenate(nodes), np.concatenate(times), pieces)


def _fade(x: Array) -> Array:
    """1 at 0, 0 from 1 on, with two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(1.0 - x**3 * (10.0 - 15.0 * x + 6.0 * x**2))
