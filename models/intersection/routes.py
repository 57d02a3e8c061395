"""Routes: which entry lane and which exit lane each track drove."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from models.intersection.density import lane_number
from models.intersection.evidence import JunctionEvidence
from models.intersection.kernel import NUM_HALVES, exact_data, junction_kernel, memory
from models.intersection.packing import ARM, HEAD
from models.intersection.tracks import Tracks

if TYPE_CHECKING:
    from models.intersection.state import Junction

Ints = NDArray[np.int64]
RELUCTANCE = 60.0  # nats: a half that turns early still tells its lane, though it scatters like a stray one


class Routes(NamedTuple):
    """What tracks drove.

    connections  (L, 4) entry arm, entry lane, exit arm, exit lane; lanes from the middle of the arm outwards
    track_route  (T,) row of `connections` of every track, -1 for one that has no entry or no exit
    """

    connections: Ints
    track_route: Ints


class RoutedTracks(NamedTuple):
    """Tracks with the structure they were found to drive on.

    structure  {site: (*event)} of an intersection, as `Junction` estimates it
    """

    tracks: Tracks
    structure: Mapping[str, NDArray[Any]]
    routes: Routes


@nb.njit(cache=True)
def closest_lanes(z, floats, ints, cache, arm, lane):  # type: ignore[no-untyped-def]
    """Arm and lane (H,) of every half for the state evaluated last; -1 where being stray costs RELUCTANCE less."""
    which, _, _, _, rows, _, _ = memory(cache, ints[NUM_HALVES])
    coef, stray = exact_data(floats, ints[NUM_HALVES])
    for h in range(ints[NUM_HALVES]):
        low, arm[h], lane[h] = stray[h] + RELUCTANCE, -1, -1
        for a in range(int(z[0])):
            if rows[int(which[1, a]), a, h] < low:
                low, arm[h] = rows[int(which[1, a]), a, h], a
        if arm[h] >= 0:
            own = z[HEAD + arm[h] * ARM : HEAD + (arm[h] + 1) * ARM]
            lane[h] = lane_number(coef, h, z[1], z[2], math.cos(own[0]), math.sin(own[0]), own)


def find_routes(model: Junction, evidence: JunctionEvidence, estimate: Mapping[str, NDArray[Any]]) -> Routes:
    """Every track on its most probable entry and exit lane; a track without one of them is on no route.

    The model must have the exact likelihood. Raises ValueError otherwise."""
    if model.likelihood != "exact":
        raise ValueError(f"routes need likelihood 'exact', but this model has '{model.likelihood}'")
    kernel = junction_kernel(model, evidence)
    z = kernel.pack({name: np.asarray(value)[None] for name, value in estimate.items()})[0]
    cache, out = np.zeros(kernel.cache_size), np.empty(2)
    kernel.evaluate(z, kernel.floats, kernel.ints, cache, out)
    arm, lane = np.empty(evidence.num_halves, np.int64), np.empty(evidence.num_halves, np.int64)
    closest_lanes(z, kernel.floats, kernel.ints, cache, arm, lane)
    ends = np.full((evidence.num_tracks, 4), -1)
    entry = np.arange(evidence.num_halves) < evidence.num_entries
    for side, first in ((entry, 0), (~entry, 2)):
        ends[evidence.track[side], first], ends[evidence.track[side], first + 1] = arm[side], lane[side]
    whole = (ends >= 0).all(1)
    connections, route = np.unique(ends[whole], axis=0, return_inverse=True)
    track_route = np.full(len(ends), -1)
    track_route[whole] = route.reshape(-1)
    return Routes(connections, track_route)
