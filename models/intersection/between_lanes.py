"""Groups of tracks that are no lanes: vehicles that change lanes, or drive between two.

Beside the course of a group run those of others, a on one side and b on the other, at lateral positions y_a < y_b.
Where they are less than two lanes apart there is no room for a third between them, and the group's own place is a share

    u = (y - y_a) / (y_b - y_a)

of the way: about 0 or 1 for those who keep to a or b. Who is near a in BINS bins or more and near b in as many has
changed lanes; who is in the middle in as many straddles, or takes long to change. A connection that leads from one lane
into the next does so too, but is driven as often as others: only groups with at most half as many tracks as either
neighbour are in between. Lanes into a new pocket never are: no other lane runs before where they go.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.intersection.laid_tracks import FEW, Laid, profiles
from models.intersection.track_groups import SAME

Ints = NDArray[np.int64]
RARER = 0.5  # tracks, of those of either neighbour
BINS = 2
MIDDLE = 0.3  # to 1 - MIDDLE is between; a track keeps within about 1 m of the middle of lanes 3 m apart
ROOM = 2 * SAME, 4 * SAME  # [m] between neighbours: closer ones are no two lanes, farther ones have room for a third


def in_between(group: Ints, laid: list[Laid]) -> list[int]:
    """Numbers of the groups that run between two others; group (T,), all tracks along each of the G groups."""
    size = np.bincount(group, minlength=len(laid))
    return [number for number in range(len(laid)) if _squeezed(number, group, laid[number], size)]


def _squeezed(number: int, group: Ints, laid: Laid, size: Ints) -> bool:
    others = [other for other in range(len(size)) if other != number and size[number] <= RARER * size[other]]
    count, total = profiles(laid, group, [number, *others])
    beside = np.where(count >= FEW, total / np.maximum(count, 1.0), np.nan)
    own, beside = beside[0], beside[1:]
    apart = beside[:, None] - beside  # (b, a, B)
    room = (apart > ROOM[0]) & (apart < ROOM[1])
    share = np.where(room, own - beside, np.nan) / np.where(room, apart, 1.0)
    near_a, middle, near_b = (
        ((share > low) & (share < high)).sum(-1) >= BINS
        for low, high in ((-MIDDLE, MIDDLE), (MIDDLE, 1 - MIDDLE), (1 - MIDDLE, 1 + MIDDLE))
    )
    return bool((middle | (near_a & near_b)).any())
