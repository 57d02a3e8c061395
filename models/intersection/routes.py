"""Routes: which entry lane and which exit lane each track drove."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from models.intersection.density import lane_number
from models.intersection.evidence import JunctionEvidence
from models.intersection.kernel import NUM_HALVES, exact_data, junction_kernel, memory
from models.intersection.packing import ARM, HEAD
from models.intersection.state import Junction, lane_points
from models.intersection.tracks import Tracks

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
SHORT = 8  # points at the end of a track that has no half there
CLOSE = 4.0  # [m] from the middle of a lane that such an end is on, at most ...
ALONG = 0.9  # ... and off its direction [rad]
RELUCTANCE = 60.0  # nats: a half that turns early still tells its lane, though it scatters like a stray one


class Routes(NamedTuple):
    """What tracks drove.

    connections  (L, 4) entry arm, entry lane, exit arm, exit lane; lanes from the middle of the arm outwards;
                 -1 is a lane inside the innermost one, E or O one outside the outermost
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

    A track with no half track on an arm, too short there or stray, goes by its last points (`complete_ends`).

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
    complete_ends(model, evidence, estimate, ends)
    whole = (ends[:, ::2] >= 0).all(1)
    connections, route = np.unique(ends[whole], axis=0, return_inverse=True)
    track_route = np.full(len(ends), -1)
    track_route[whole] = route.reshape(-1)
    return Routes(connections, track_route)


def complete_ends(
    model: Junction, evidence: JunctionEvidence, estimate: Mapping[str, NDArray[Any]], ends: Ints
) -> None:
    """Fill in lanes of track ends without a half: tracks that begin or end where the arms do not yet run straight.

    ends  (T, 4) entry arm, entry lane, exit arm, exit lane, -1 where unknown; each goes to the lane closest to the
    mean of the track's last SHORT points whose direction is theirs"""
    assert evidence.tracks is not None
    points, offsets = evidence.tracks.points, evidence.tracks.offsets
    for end, side in ((0, 1), (2, -1)):
        missing = np.flatnonzero((ends[:, end] < 0) & (np.diff(offsets) >= SHORT))
        if len(missing) == 0:
            continue
        names, lines = _arm_lanes(model, estimate, side)  # type: ignore[arg-type]
        outer = offsets[missing] if side == 1 else offsets[missing + 1] - SHORT
        pieces = points[outer[:, None] + np.arange(SHORT)]  # (M, SHORT, 2)
        half = SHORT // 2
        course = side * (pieces[:, :half].mean(1) - pieces[:, half:].mean(1))  # outwards
        apart = np.linalg.norm(lines[None] - pieces.mean(1)[:, None, None], axis=-1)  # (M, lanes, n)
        nearest = apart.argmin(-1)
        steps = np.gradient(lines, axis=1)[np.arange(len(lines)), nearest]  # (M, lanes, 2) outwards
        aligned = (steps * course[:, None]).sum(-1)  # |step| |course| cos(turn)
        lengths = np.linalg.norm(steps, axis=-1) * np.linalg.norm(course, axis=-1)[:, None]
        cost = np.where(aligned > math.cos(ALONG) * lengths, apart.min(-1), np.inf)
        best = cost.argmin(1)
        found = cost.min(1) < CLOSE
        ends[missing[found], end : end + 2] = names[best[found]]


def _arm_lanes(model: Junction, estimate: Mapping[str, NDArray[Any]], side: Literal[1, -1]) -> tuple[Ints, Array]:
    """(arm, lane) of all lanes of a side, one more on either edge included, and their centre lines outwards, a point
    each metre, (lanes, n, 2): a pocket for turning may lie beside what half tracks show."""
    counts = np.asarray(estimate["entries" if side == 1 else "exits"])[: int(estimate["num_arms"])]
    names = np.array([(arm, lane) for arm, count in enumerate(counts) for lane in range(-1, int(count) + 1)])
    s = np.arange(0.0, 80.0)
    return names, np.stack([lane_points(estimate, arm, lane, side, s, model.width) for arm, lane in names])
