"""Routes: which entry lane and which exit lane each track drove."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
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
from models.program import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
SHORT = 8  # points at the end of a track that has no half there


@dataclass(frozen=True)
class Routing:
    """Thresholds of routes and of merging them (models.intersection.same_lane); `python -m benchmarks.lane_thresholds`
    varies them on the real junctions that are not marked clean. With --seeds 8, no other value it tries is better there
    by twice its standard error; shorter windows and a smaller `same` are worse.

    reluctance  of calling a half stray: one that turns early still tells its lane, though it scatters [nats]
    close       the end of a track that has no half there is on a lane at most this far from its middle ... [m]
    along       ... and off its direction [rad]
    same        routes nearer than this on average in every stretch are one lane [m]
    window      length of a stretch [m]

    Raises InputError for one that is not positive."""

    reluctance: float = 60.0
    close: float = 4.0
    along: float = 0.9
    same: float = 1.35
    window: float = 24.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise InputError(f"{name} of the routes must be positive, but is {value}; choose a larger one")


ROUTING = Routing()


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
def closest_lanes(z, floats, ints, cache, reluctance, arm, lane):  # type: ignore[no-untyped-def]
    """Arm and lane (H,) of every half for the state evaluated last; -1 where being stray costs `reluctance` less."""
    which, _, _, _, rows, _, _ = memory(cache, ints[NUM_HALVES])
    coef, stray = exact_data(floats, ints[NUM_HALVES])
    for h in range(ints[NUM_HALVES]):
        low, arm[h], lane[h] = stray[h] + reluctance, -1, -1
        for a in range(int(z[0])):
            if rows[int(which[1, a]), a, h] < low:
                low, arm[h] = rows[int(which[1, a]), a, h], a
        if arm[h] >= 0:
            own = z[HEAD + arm[h] * ARM : HEAD + (arm[h] + 1) * ARM]
            lane[h] = lane_number(coef, h, z[1], z[2], math.cos(own[0]), math.sin(own[0]), own)


def find_routes(
    model: Junction, evidence: JunctionEvidence, estimate: Mapping[str, NDArray[Any]], routing: Routing = ROUTING
) -> Routes:
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
    closest_lanes(z, kernel.floats, kernel.ints, cache, routing.reluctance, arm, lane)
    ends = np.full((evidence.num_tracks, 4), -1)
    entry = np.arange(evidence.num_halves) < evidence.num_entries
    for side, first in ((entry, 0), (~entry, 2)):
        ends[evidence.track[side], first], ends[evidence.track[side], first + 1] = arm[side], lane[side]
    complete_ends(model, evidence, estimate, ends, routing)
    whole = (ends[:, ::2] >= 0).all(1)
    connections, route = distinct(ends[whole])
    track_route = np.full(len(ends), -1)
    track_route[whole] = route
    return Routes(connections, track_route)


def distinct(rows: Ints) -> tuple[Ints, Ints]:
    """The different ones among rows (N, P) of small whole numbers, in their order, and which of them each is, (N,).

    As numpy.unique, which is slow along an axis."""
    least = rows.min(0, initial=0)
    spans = rows.max(0, initial=0) - least + 1
    _, first, which = np.unique((rows - least) @ np.cumprod([1, *spans[:0:-1]])[::-1], True, True)
    return rows[first], which.reshape(-1)


def complete_ends(
    model: Junction, evidence: JunctionEvidence, estimate: Mapping[str, NDArray[Any]], ends: Ints, routing: Routing
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
        x, y = pieces.mean(1).T[..., None, None]
        apart = np.hypot(lines[..., 0] - x, lines[..., 1] - y)  # (M, lanes, n)
        inner = np.minimum(apart.argmin(-1), lines.shape[1] - 2)
        lane = np.arange(len(lines))
        steps = lines[lane, inner + 1] - lines[lane, inner]  # (M, lanes, 2) outwards
        aligned = (steps * course[:, None]).sum(-1)  # |step| |course| cos(turn)
        lengths = np.linalg.norm(steps, axis=-1) * np.linalg.norm(course, axis=-1)[:, None]
        cost = np.where(aligned > math.cos(routing.along) * lengths, apart.min(-1), np.inf)
        best = cost.argmin(1)
        found = cost.min(1) < routing.close
        ends[missing[found], end : end + 2] = names[best[found]]


def _arm_lanes(model: Junction, estimate: Mapping[str, NDArray[Any]], side: Literal[1, -1]) -> tuple[Ints, Array]:
    """(arm, lane) of all lanes of a side, one more on either edge included, and their centre lines outwards, a point
    each metre, (lanes, n, 2): a pocket for turning may lie beside what half tracks show."""
    counts = np.asarray(estimate["entries" if side == 1 else "exits"])[: int(estimate["num_arms"])]
    names = np.array([(arm, lane) for arm, count in enumerate(counts) for lane in range(-1, int(count) + 1)])
    s = np.arange(0.0, 80.0)
    return names, lane_points(estimate, names[:, 0], names[:, 1], side, s, model.width)
