"""Lanes over all readings of the tracks: how probable each is, and a band that holds them all.

    p(line) = sum over readings k of share_k N(line; line_k, Laplace covariance of reading k)

A lane of one reading is a lane of another one where both hold most of the same tracks: more than half of those that
are on either of them. At most one lane of another reading is. Then

    probability of a lane = sum of the shares of the readings that have it
    its band              = quantiles, at each node, of how far the lines of these readings' draws run to the left

Lanes that other readings have and the best one has not are its alternatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.paths import beside
from models.intersection.course_lines import edges
from models.intersection.routes import Routes

Array = NDArray[np.float64]


class ReadLanes(NamedTuple):
    """The L lanes of one reading.

    share   of the reading
    lines   L centre lines (n, 2) [m]
    across  L arrays (n, D): how far to the left of them the lines of its draws run [m]; D in proportion to share
    routes  their entries and exits, and which track drove which lane
    """

    share: float
    lines: list[Array]
    across: list[Array]
    routes: Routes


class Alternative(NamedTuple):
    """A lane that the best reading has not.

    probability  of it
    reading      the most probable one that has it
    lane         its number there
    """

    probability: float
    reading: int
    lane: int


class Mixture(NamedTuple):
    """The L lanes of the first reading, and what else there may be.

    probability   (L,)
    left, right   L arrays (n,): edges of the band, as in Lanes [m]
    alternatives  most probable first
    """

    probability: Array
    left: list[Array]
    right: list[Array]
    alternatives: list[Alternative]


def mix(readings: Sequence[ReadLanes], level: float) -> Mixture:
    """Lanes of the first reading over all readings; `level` is the probability between the edges of a band."""
    best = readings[0]
    probability = np.full(len(best.lines), best.share)
    samples = [[across] for across in best.across]
    further: list[Alternative] = []
    for number, other in enumerate(readings[1:], start=1):
        for match in range(len(other.lines)):
            tracks = other.routes.track_route == match
            lane = next((i for i in range(len(best.lines)) if is_same(best.routes.track_route == i, tracks)), None)
            if lane is not None:
                probability[lane] += other.share
                offset, place = beside(best.lines[lane], other.lines[match])
                samples[lane].append(offset[:, None] + other.across[match][np.rint(place).astype(int)])
                continue
            theirs = (readings[a.reading].routes.track_route == a.lane for a in further)
            known = next((i for i, those in enumerate(theirs) if is_same(those, tracks)), None)
            if known is None:
                further.append(Alternative(other.share, number, match))
            else:
                further[known] = further[known]._replace(probability=further[known].probability + other.share)
    left, right = edges((np.concatenate(parts, 1) for parts in samples), level)
    return Mixture(probability, left, right, sorted(further, key=lambda one: -one.probability))


def is_same(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> bool:
    """Whether two sets of tracks (T,) are of one lane: more than half of all of them are in both."""
    return bool(2 * (one & other).sum() > (one | other).sum())
