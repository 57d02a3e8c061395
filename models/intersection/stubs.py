"""Stubs: the parts of lanes on arms that several lanes share, found from first courses of the lanes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from models.intersection.arm_shares import Profile, axis_of, profile, together
from models.intersection.reference import arc_length

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
MARGIN = 4.0  # [m] from where a lane is free to where it is seen to leave its stub
INSIDE = 4  # pieces of a lane that are free, at least
SHARED = 2  # pieces on a stub, at least


class Side(NamedTuple):
    """One end of a lane.

    stub    number of its stub, -1 where the lane shares nothing
    pieces  how many pieces of the stub's spline are the lane's
    begins  where the lane begins along the axis of the arm, from outside [m]
    own     where it leaves the stub, along its own course from that end [m]
    """

    stub: int
    pieces: int
    begins: float
    own: float


ALONE = Side(-1, 0, 0.0, 0.0)


class Stub(NamedTuple):
    """Which axis a stub lies beside, how far to the left of it, seen inwards [m], and how many pieces it is long."""

    arm: int
    offset: float
    pieces: int


class Stubs(NamedTuple):
    """Entry and exit side of every lane, the stubs, and the axes of arms inwards, each (n, 2)."""

    sides: list[tuple[Side, Side]]
    stubs: list[Stub]
    axes: list[Array]


def find_stubs(
    lines: list[Array], connections: Ints, weights: Array, knots: float, spacing: float, position_std: float
) -> Stubs:
    """Stubs of lanes with first courses `lines`, each (n, 2), by the arms and lanes of their `connections` (L, 4).

    weights  (L,) numbers of tracks. An arm of -1 has no stub."""
    sides = [[ALONE, ALONE] for _ in lines]
    stubs: list[Stub] = []
    axes: list[Array] = []
    for arm in np.unique(connections[:, ::2][connections[:, ::2] >= 0]):
        ends = [(int(lane), int(end)) for lane, end in np.argwhere(connections[:, ::2] == arm)]
        axis = axis_of([lines[lane][:: 1 - 2 * end] for lane, end in ends], spacing)
        known = len(stubs)
        for key in sorted({(end, int(connections[lane, 2 * end + 1])) for lane, end in ends}):
            members = [lane for lane, end in ends if (end, connections[lane, 2 * end + 1]) == key]
            profiles = [profile(lines[lane][:: 1 - 2 * key[0]], axis) for lane in members]
            shares = together(profiles, weights[members], position_std)
            found = [_side(len(stubs), *pair, knots) for pair in zip(profiles, shares, strict=True)]
            if any(side.pieces for side in found):
                across = [p.across[p.along <= s.pieces * knots] for p, s in zip(profiles, found, strict=True)]
                offset = float(np.median(np.concatenate(across)))
                stubs.append(Stub(len(axes), offset, max(side.pieces for side in found)))
                for lane, side in zip(members, found, strict=True):
                    sides[lane][key[0]] = side
        axes += [axis] if len(stubs) > known else []
    lengths = [float(arc_length(line)[-1]) for line in lines]
    return Stubs([apart(pair, length, knots) for pair, length in zip(sides, lengths, strict=True)], stubs, axes)


def _side(stub: int, lane: Profile, share: float, knots: float) -> Side:
    pieces = math.floor((min(share, float(lane.along[-1])) - MARGIN) / knots)
    if pieces * knots - lane.along[0] < SHARED * knots:
        return ALONE
    own = np.interp(pieces * knots, lane.along, arc_length(lane.inwards)[: len(lane.along)])
    return Side(stub, pieces, max(float(lane.along[0]), 0.0), float(own))


def apart(pair: list[Side], length: float, knots: float) -> tuple[Side, Side]:
    """Both ends of a lane with enough between them: the longer one gives way."""
    pair = list(pair)
    while length - pair[0].own - pair[1].own < INSIDE * knots and pair != [ALONE, ALONE]:
        longer = int(pair[1].own > pair[0].own)
        side = pair[longer]._replace(pieces=pair[longer].pieces - 1, own=pair[longer].own - knots)
        pair[longer] = side if side.pieces * knots - side.begins >= SHARED * knots else ALONE
    return pair[0], pair[1]


def beside(stubs: Stubs, stub: int, along: Array) -> Array:
    """Points (n, 2) at the offset of a stub beside the axis of its arm, `along` (n,) it from its outer end."""
    axis = stubs.axes[stubs.stubs[stub].arm]
    curve = CubicSpline(arc_length(axis), axis)
    slope = curve(along, 1)
    normal = np.stack([-slope[:, 1], slope[:, 0]], 1) / np.linalg.norm(slope, axis=1)[:, None]
    return np.asarray(curve(along) + stubs.stubs[stub].offset * normal)
