"""Names for lanes that were found as curves: which arm and which lane of it each begins and ends on.

An end of a lane is on an arm if it is FROM metres or more from where the tracks meet and points away from there; a lane
that was seen on one side only has no arm on the other. Arms are the outward directions of such ends, gathered greedily
and weighted by tracks: no structure is estimated, and none is needed. Lanes whose outer ends run together on an arm
share a stub. Stubs are numbered from the middle of the arm outwards, as in right-hand traffic.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from models.intersection.packing import MAX_ARMS
from models.intersection.start import group_directions
from models.intersection.track_groups import SAME
from models.intersection.wrap import wrap

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
FROM = 15.0  # [m] from the centre: closer in, lanes turn
POINTING = math.radians(60.0)  # between an end's direction and the way it lies, at most
END = 10  # points of a curve, a metre apart, that show its outward direction, or all where it is shorter
TOGETHER = 18.0  # [m] of the outer ends of lanes of one stub
AT = 25.0  # [m] along the arm where stubs are counted, or as near to it as they were seen


def name_lanes(curves: list[Array], weights: Ints, centre: Array) -> tuple[Ints, Array]:
    """Entry arm and lane, exit arm and lane (L, 4) of L curves (n, 2) in driving order, a point every metre; directions
    (K,) of the arms [rad].

    weights  (L,) tracks on each
    centre   (2,) where the tracks meet [m]

    An end on no arm has arm -1 and a number of its own for a lane, so that no two lanes share it."""
    connections = np.empty((len(curves), 4), dtype=np.int64)
    outwards = [[curve, curve[::-1]] for curve in curves]  # both from the outer end on
    pointing = np.array([[_direction(line[: END + 1][-1], line[0]) for line in pair] for pair in outwards])  # (L, 2)
    place = np.array([[line[0] - centre for line in pair] for pair in outwards])  # (L, 2, 2)
    off = np.abs(wrap(np.arctan2(place[..., 1], place[..., 0]) - pointing))
    on_arm = (np.linalg.norm(place, axis=-1) >= FROM) & (off <= POINTING)
    slots = np.zeros(MAX_ARMS)
    ends = np.repeat(pointing, weights, axis=0)[np.repeat(on_arm, weights, axis=0)]
    angle = slots[: group_directions(ends, slots)]
    for side in range(2):
        arm = np.full(len(curves), -1)
        if len(angle):
            nearest = np.abs(wrap(pointing[:, side, None] - angle)).argmin(1)
            arm = np.where(on_arm[:, side], nearest, -1)
        connections[:, 2 * side] = arm
        connections[arm < 0, 2 * side + 1] = np.arange((arm < 0).sum())
        for number in np.unique(arm[arm >= 0]):
            lanes = np.flatnonzero(arm == number)
            lines = [outwards[lane][side] for lane in lanes]
            sign = 1.0 if side == 0 else -1.0
            connections[lanes, 2 * side + 1] = _count(lines, centre, angle[number], sign)
    return connections, angle


def _count(lines: list[Array], centre: Array, angle: float, sign: float) -> Ints:
    """Numbers of the stubs that lines from the outer end of one arm on belong to."""
    stub = np.arange(len(lines))
    for i, line in enumerate(lines):
        mates = [j for j in range(i) if share_end(line, lines[j])]
        stub[i] = stub[mates[0]] if mates else i
    across = np.array([_across(line - centre, angle) for line in lines])
    middle = {name: sign * float(across[stub == name].mean()) for name in np.unique(stub)}
    ranked = sorted(middle, key=lambda name: middle[name])
    return np.array([ranked.index(name) for name in stub])


def share_end(one: Array, other: Array) -> bool:
    """Whether two lines from their outer ends on run within SAME metres over the first TOGETHER metres of both."""
    apart = np.linalg.norm(one[:, None] - other, axis=-1)  # (n, m)
    nearest = apart.argmin(1)
    beside = np.flatnonzero((nearest > 0) & (nearest < len(other) - 1))[: round(TOGETHER)]
    return len(beside) >= TOGETHER / 2 and float(apart.min(1)[beside].mean()) < SAME


def _across(points: Array, angle: float) -> float:
    """Lateral position of a line where it is AT along an arm."""
    along = points @ np.array([math.cos(angle), math.sin(angle)])
    nearest = points[np.abs(along - AT).argmin()]
    return float(nearest @ np.array([-math.sin(angle), math.cos(angle)]))


def _direction(inner: Array, outer: Array) -> float:
    return math.atan2(outer[1] - inner[1], outer[0] - inner[0])
