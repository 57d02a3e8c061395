"""How far estimated centre lines run from the true ones.

    lane error = (sum of the mean distances of matched lanes + 2.7 m (missed + phantom)) / (true + phantom)

a plain mean over lanes, the true ones and the phantoms, not weighted by length. [M20] section V measures the
orthogonal distance too, but does not say how lanes are matched nor what a wrong number of them costs: ours.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from experiments.lane_posterior import Lanes
from experiments.scenarios import paths
from experiments.scenarios.protocol import LINE_STEP
from experiments.scenarios.scene import JunctionTruth, Scene
from inference.posterior import Posterior
from models.program import InputError

Floats = NDArray[np.float64]

COST = 2.7  # of a missed or a phantom lane, all along it: the width of a lane; no pair lies farther apart [m]
STEP = 1.0  # between the points of a true line that are measured [m]
DROPPED = 1.0  # of a true line at both ends: tracks begin and end within the first and the last metre [m]
SPREAD = 11  # points that a mean distance steps over, so that few of them tell lines that are far apart


def lane_error(lines: list[Floats], truth: JunctionTruth) -> dict[str, float]:
    """Compare estimated centre lines, each (n, 2), with the true ones that vehicles drove.

    lane_error_cm  mean distance from the true centre lines to the matched ones, 2.7 m for a missed or phantom lane
    lanes_missed   driven true lines without an estimate
    lanes_phantom  estimated lines without a true one; one on a true line that nobody drove is none
    inside_cm      mean over matched lanes, where they are nearer to the centre than the larger `radius` of their arms
    arms_cm        the same beyond it

    The distance of a pair is the mean along the true line of the distance to the estimate, which may be longer at no
    cost. Pairs minimise the sum of their distances, each counted up to 2.7 m; lines that far apart are no pair.
    Simulated vehicles drive all of their line: all but its ends is the region of the trajectories. What has nothing to
    say is nan: everything where nobody knows who drove where, the last two where no matched lane has points there.

    Raises InputError for an estimated line of fewer than two points or with a number that is not finite."""
    for index, line in enumerate(lines):
        if len(line) < 2 or not np.isfinite(line).all():
            what = "a number that is not finite" if len(line) > 1 else f"{len(line)} points"
            raise InputError(f"estimated centre line {index} has {what}; give two or more finite points")
    driven = np.unique(truth.track_lane[truth.track_lane >= 0])
    if len(driven) == 0:
        return dict.fromkeys(("lane_error_cm", "lanes_missed", "lanes_phantom", "inside_cm", "arms_cm"), math.nan)
    estimates = [np.ascontiguousarray(line, dtype=np.float64) for line in lines]
    regions = [region(line) for line in truth.lines]
    table = np.array([[_mean_distance(points, line, COST) for line in estimates] for points in regions])
    table = table.reshape(len(regions), len(estimates))
    rows, found = linear_sum_assignment(table[driven])
    true = driven[rows]
    matched = table[true, found] < COST
    true, found = true[matched], found[matched]
    unmatched, undriven = np.ones(len(estimates), dtype=bool), np.ones(len(regions), dtype=bool)
    unmatched[found], undriven[driven] = False, False
    missed = len(driven) - len(true)
    phantom = int((table[undriven][:, unmatched] >= COST).all(0).sum())
    total = table[true, found].sum() + COST * (missed + phantom)
    inside, arms = [], []
    for lane, estimate in zip(true, found, strict=True):
        near = np.linalg.norm(regions[lane] - truth.centre, axis=1) < truth.radius[truth.connections[lane, ::2]].max()
        distance = distance_to_line(regions[lane], estimates[estimate])
        inside += [distance[near].mean()] if near.any() else []
        arms += [distance[~near].mean()] if not near.all() else []
    return {
        "lane_error_cm": 100.0 * float(total) / (len(driven) + phantom),
        "lanes_missed": float(missed),
        "lanes_phantom": float(phantom),
        "inside_cm": 100.0 * float(np.mean(inside)) if inside else math.nan,
        "arms_cm": 100.0 * float(np.mean(arms)) if arms else math.nan,
    }


def metrics(posterior: Posterior, scene: Scene) -> dict[str, float]:
    """`lane_error` of a posterior with lanes, and how honest its bands are; nothing without lanes or without a truth.

    band_coverage  share of the lanes' nodes whose true place is inside the 90 % band
    half_band_cm   half the width of that band, mean over all nodes"""
    lanes = getattr(posterior, "lanes", None)
    if lanes is None or scene.truth is None:
        return {}
    widths = np.concatenate([left + right for left, right in zip(lanes.left, lanes.right, strict=True)] or [[math.nan]])
    bands = {"band_coverage": band_coverage(lanes, scene.truth), "half_band_cm": 50.0 * float(widths.mean())}
    return lane_error(lanes.lines, scene.truth) | bands


def band_coverage(lanes: Lanes, truth: JunctionTruth) -> float:
    """Share of the nodes of all estimated lanes between whose 90 % band's edges the true line runs.

    A lane's true line is the one that most of its tracks drove; nodes beyond the ends of that line are left out.
    nan where no lane has one."""
    inside = []
    for number, (line, left, right) in enumerate(zip(lanes.lines, lanes.left, lanes.right, strict=True)):
        drove = truth.track_lane[lanes.routes.track_route == number]
        if (drove >= 0).any():
            offset = _offset(line, truth.lines[np.bincount(drove[drove >= 0]).argmax()])
            inside.append(((offset <= left) & (offset >= -right))[~np.isnan(offset)])
    joined = np.concatenate(inside) if inside else np.zeros(0)
    return float(joined.mean()) if len(joined) else math.nan


def _offset(line: Floats, true: Floats) -> Floats:
    """How far to the left of each point of a line the true one runs, nan beyond its ends, (n,) [m]."""
    offset, place = paths.beside(line, true)
    end = (place < DROPPED / LINE_STEP) | (place > len(true) - 1 - DROPPED / LINE_STEP)
    return np.where(end, np.nan, offset)


def region(line: Floats) -> Floats:
    """Points (n, 2) of a true centre line, a metre apart, without a metre at both ends."""
    return paths.at(line, np.arange(DROPPED, paths.arc_length(line)[-1] - DROPPED, STEP))


@nb.njit(cache=True)
def distance_to_line(points: Floats, line: Floats) -> Floats:
    """Distance (n,) of points (n, 2) to the segments of a polyline (m, 2), to its end beyond it [m]."""
    out = np.empty(len(points))
    for i in range(len(points)):
        out[i] = _distance(points[i, 0], points[i, 1], line)
    return out


@nb.njit(cache=True)
def _mean_distance(points: Floats, line: Floats, most: float) -> float:
    """Mean of `distance_to_line`; `most` as soon as it is known not to be less."""
    total = 0.0
    for first in range(SPREAD):
        for i in range(first, len(points), SPREAD):
            total += _distance(points[i, 0], points[i, 1], line)
            if total >= most * len(points):
                return most
    return total / len(points)


@nb.njit(cache=True)
def _distance(x: float, y: float, line: Floats) -> float:
    least = (x - line[0, 0]) ** 2 + (y - line[0, 1]) ** 2
    for k in range(len(line) - 1):
        ax, ay = x - line[k, 0], y - line[k, 1]
        dx, dy = line[k + 1, 0] - line[k, 0], line[k + 1, 1] - line[k, 1]
        along, square = ax * dx + ay * dy, dx * dx + dy * dy
        if along >= square:
            ax, ay = x - line[k + 1, 0], y - line[k + 1, 1]
        elif along > 0.0:
            ax, ay = ax - along / square * dx, ay - along / square * dy
        least = min(least, ax * ax + ay * ay)
    return math.sqrt(least)
