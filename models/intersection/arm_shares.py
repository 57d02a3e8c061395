"""Where lanes of an arm run together: the axis of the arm, and how far in from outside each lane shares its course.

All lanes of an arm are looked at from outside inwards, along an axis that is the course of the one of them that turns
least. Lanes on the same stub (the same arm, side and number in `connections`) are one lane out there. A lane leaves
its stub where its course, averaged over WINDOW metres, is more than APART beside that of the others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from models.intersection.reference import arc_length, curvatures, direction, tangents

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
WINDOW = 9  # [m]
APART = 0.3  # [m]
ASLANT = 0.15  # slope of a lane to the axis where it still runs along it
BENT = 0.03  # curvature of an axis that is still an arm's [1/m]


class Profile(NamedTuple):
    """One end of a lane along the axis of its arm.

    inwards  (n, 2) the lane's course from outside [m]
    along    (k,) of its first points, along the axis from its outer end; across (k,) to the left of it [m]
    """

    inwards: Array
    along: Array
    across: Array


def axis_of(lines: list[Array], spacing: float) -> Array:
    """The axis (n, 2) of an arm from the courses of its lanes inwards: that of the lane that turns least, with
    straight pieces at both ends, so that all lanes lie beside it."""
    line = min(lines, key=turning)
    reach = max(float((line[0] - other[0]) @ direction(line[0], line[4])) for other in lines)
    before = np.arange(max(int(np.ceil(reach / spacing)), 0), 0, -1)[:, None] * spacing
    behind = np.arange(1, 21)[:, None] * spacing
    return np.vstack([line[0] - before * direction(line[0], line[4]), line, line[-1] + behind * direction(*line[-2:])])


def turning(line: Array) -> float:
    """How far a line turns from its beginning to its end [rad]."""
    first, last = direction(line[0], line[4]), direction(line[-5], line[-1])
    return float(np.arccos(np.clip(first @ last, -1.0, 1.0)))


def profile(inwards: Array, axis: Array) -> Profile:
    """Where a lane runs along the axis of its arm, as far in as it goes along with it."""
    nearest = ((inwards[:, None] - axis[None]) ** 2).sum(-1).argmin(1)
    tangent, gap = tangents(axis)[nearest], inwards - axis[nearest]
    along = arc_length(axis)[nearest] + (gap * tangent).sum(1)
    across = tangent[:, 0] * gap[:, 1] - tangent[:, 1] * gap[:, 0]
    num = len(inwards) // 2  # the other half belongs to the other end
    rise, run = (uniform_filter1d(np.diff(values), WINDOW) for values in (across, along))
    astray = (np.abs(rise) > ASLANT * run) | (np.abs(curvatures(axis)) > BENT)[nearest[:-1]]
    astray[:WINDOW] = False  # ends of curves are loose
    astray |= np.diff(along) <= 0.0
    end = int(np.append(np.flatnonzero(astray[:num]), num)[0])
    return Profile(inwards, along[: end + 1], across[: end + 1])


def together(profiles: list[Profile], weights: Array, position_std: float) -> Array:
    """(P,) how far in along the axis each lane of one stub shares its course with the others [m].

    weights  (P,) numbers of tracks

    The stub follows the lane that others leave last; each shares as much as it runs along with that one, and that one
    as much as the last of the others. A lane alone keeps all that runs along the axis."""
    ends = np.array([each.along[-1] for each in profiles])
    if len(profiles) == 1:
        return ends
    grid = np.arange(0.0, ends.max() + 1.0)
    table = np.stack([np.interp(grid, each.along, each.across, np.nan, np.nan) for each in profiles])
    leaves = np.minimum(*np.meshgrid(ends, ends))
    for i in range(len(table)):
        for j in range(len(table)):
            apart = np.nan_to_num(table[i] - table[j])
            noise = position_std * math.sqrt((1.0 / weights[i] + 1.0 / weights[j]) / WINDOW)
            far = np.abs(uniform_filter1d(apart, WINDOW)) > APART + 2.0 * noise
            far &= grid >= max(profiles[i].along[0], profiles[j].along[0]) + WINDOW
            leaves[i, j] = min(leaves[i, j], grid[far.argmax()]) if far.any() else leaves[i, j]
    np.fill_diagonal(leaves, 0.0)
    leader = int((leaves @ weights).argmax())
    out = leaves[:, leader]
    out[leader] = out.max()
    return np.asarray(out)
