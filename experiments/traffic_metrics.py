"""How far lanes from recorded traffic run from those of a map that somebody drew.

The map is no exact truth: vehicles keep to it within 0.3 to 0.9 m, and where they turn they cut across it by more. The
same distances of the raw tracks say what part of an error is the map's.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from experiments.scenarios import paths
from experiments.scenarios.protocol import LINE_STEP
from experiments.scenarios.scene import JunctionTruth, Scene
from inference.posterior import Posterior

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
STEP = 1.0  # between the points that are measured [m]
NEAR = 1.0  # [m]
ALIGNED = math.radians(45.0)  # between the directions of a point and of a map lane that is its own
VEHICLES = 2  # that make a place of a map lane driven, as many as make a lane
DRIVEN = 0.5  # of the places of a driven map lane
FOUND = 0.8  # of the driven places of a map lane that is found


def metrics(posterior: Posterior, scene: Scene) -> dict[str, float]:
    """Distances to the nearest map lane of the same direction (within 45 degrees); nothing without lanes or a map.

    traffic_m            median distance of the estimated lanes' points, one every metre, to the nearest map lane
    traffic_p90_m        their 90 % quantile
    traffic_precision_1m  share of them within 1 m
    traffic_arms_precision_1m  the same outside the crossing area, farther from the centre than its radius
    traffic_recall_driven  share of the driven map lanes that are found
    traffic_raw_m        median distance of the points of the tracks, for comparison
    traffic_raw_p90_m    their 90 % quantile

    All lanes count alike, whether two vehicles drove them or forty, and half lanes too. Points beyond the end of their
    nearest map lane are left out: the map says nothing there. A place of a map lane, one every metre, is driven if two
    vehicles or more passed within 1 m in its direction; a map lane is driven if half of its places are, and found if an
    estimated lane of its direction runs within 1 m of 80 % of these. So only driven arms are asked for."""
    lanes = getattr(posterior, "lanes", None)
    if lanes is None or scene.truth is None:
        return {}
    truth, tracks = scene.truth, np.split(scene.data.points, scene.data.offsets[1:-1])
    lines = [paths.resample(line, STEP) for line in lanes.lines]
    points = np.concatenate(lines)
    apart, beyond = map_distance(lines, truth)
    raw, outside = map_distance(tracks, truth)
    arms = np.linalg.norm(points - truth.centre, axis=1) > truth.radius.max()
    return {
        "traffic_m": _quantile(apart[~beyond], 0.5),
        "traffic_p90_m": _quantile(apart[~beyond], 0.9),
        "traffic_precision_1m": _share(apart[~beyond] <= NEAR),
        "traffic_arms_precision_1m": _share(apart[~beyond & arms] <= NEAR),
        "traffic_recall_driven": recall(lines, tracks, truth),
        "traffic_raw_m": _quantile(raw[~outside], 0.5),
        "traffic_raw_p90_m": _quantile(raw[~outside], 0.9),
    }


def map_distance(lines: list[Floats], truth: JunctionTruth) -> tuple[Floats, Flags]:
    """Of all points of lines (n, 2): distance to the nearest map lane of their direction, infinite without one, and
    whether they lie beyond its end."""
    points = np.concatenate(lines)
    heading = np.concatenate([paths.headings(line) for line in lines])
    least, beyond = np.full(len(points), np.inf), np.zeros(len(points), dtype=bool)
    for lane in truth.lines:
        apart, end = _beside(points, heading, lane)
        beyond = np.where(apart < least, end, beyond)
        least = np.minimum(apart, least)
    return least, beyond


def recall(lines: list[Floats], tracks: list[Floats], truth: JunctionTruth) -> float:
    """Share of the driven map lanes that estimated lines find; nan where none is driven."""
    found = []
    for lane in truth.lines:
        places = paths.resample(lane, STEP)
        heading = paths.headings(places)
        passed = sum(_runs_past(places, heading, track).astype(int) for track in tracks)
        driven = np.asarray(passed >= VEHICLES)
        if driven.mean() >= DRIVEN:
            met = np.any([_runs_past(places, heading, line) for line in lines], axis=0)
            found.append(met[driven].mean() >= FOUND)
    return _share(np.array(found))


def _runs_past(places: Floats, heading: Floats, line: Floats) -> Flags:
    """Whether a line runs within NEAR of each place, in its direction."""
    return np.asarray(_beside(places, heading, paths.resample(line, LINE_STEP))[0] <= NEAR)


def _beside(points: Floats, heading: Floats, line: Floats) -> tuple[Floats, Flags]:
    """Distance of points (n, 2) from a line with a point every LINE_STEP, infinite for those of another direction, and
    whether its nearest point is an end of it."""
    apart, nearest = cKDTree(line).query(points)
    aligned = np.abs(paths.wrap(heading - paths.headings(line)[nearest])) <= ALIGNED
    return np.where(aligned, apart, np.inf), (nearest == 0) | (nearest == len(line) - 1)


def _quantile(values: Floats, q: float) -> float:
    """Infinite where one of the two values beside it is: numpy would say nan."""
    if len(values) == 0:
        return math.nan
    above = float(np.quantile(values, q, method="higher"))
    return float(np.quantile(values, q)) if math.isfinite(above) else above


def _share(flags: Flags) -> float:
    return float(flags.mean()) if len(flags) else math.nan
