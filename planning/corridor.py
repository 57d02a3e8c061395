"""Boundary lines as an interval of offsets: what a plan has on its left and on its right, circle by circle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.planner import Planner
from planning.plans import Plan
from planning.reference_kernel import FOUND
from planning.scene import Scene

Floats = NDArray[np.float64]
APART = 1.0  # of the points of a segment that are looked at [m]
SPARE = 0.02  # kept free beside the exact check [m]
SLIPPING = 1.0  # how far a motion may be ahead or behind, and still finds its lines looked at, at least [m]
OPEN = 50.0  # where there is no line [m]
BESIDE = 1.0  # of free space beside a plan: with more on both sides its problem has no lines [m]


def corridor(planner: Planner, scene: Scene, begun: Plan, t: Floats) -> Floats | None:
    """Least and largest offset of each circle's middle at times t: (2 n, K), rows lower and upper, circle by circle;
    None where lines are farther from the plan than BESIDE.

    A point of a line is left where its offset is larger than the plan's at that arc length, and lies in a circle's way
    where their arc lengths are nearer than the circle's radius and some slip, which grows with time."""
    radius = planner.radius + SPARE
    circles = planner.vehicle.circles
    told = begun.along(t)
    at = told[:, 0]
    slip = SLIPPING + told[:, 1] * (t[1] - t[0] if len(t) > 1 else 0.0)
    s, d = _points(scene, float(at[0]) - 5.0, float(at[-1]) + circles[-1] + radius + float(slip[-1]))
    out = np.empty((2 * len(circles), len(t)))
    out[0::2], out[1::2] = -OPEN, OPEN
    if not len(s):
        return None
    own = np.interp(s, *_path(begun, t[-1] + 1.0))
    left, right = d > own, d <= own
    for n, ahead in enumerate(circles):
        near = np.abs(s - (at + ahead)[:, None]) < radius + slip[:, None]  # (K, points)
        out[2 * n] = np.where(near & right, d, -OPEN).max(1) + radius
        out[2 * n + 1] = np.where(near & left, d, OPEN).min(1) - radius
    beside = begun.lateral.motion.at(t)[0, :, 0]
    return out if (out[0::2] > beside - BESIDE).any() or (out[1::2] < beside + BESIDE).any() else None


def _path(begun: Plan, until: float) -> tuple[Floats, Floats]:
    """Arc lengths and offsets of a plan."""
    t = np.arange(0.0, until, 0.05)
    return begun.along(t)[:, 0], begun.lateral.motion.at(t)[0, :, 0]


def _points(scene: Scene, first: float, last: float) -> tuple[Floats, Floats]:
    """s, d of points of the boundary lines between two arc lengths."""
    segment = scene.boundary.segment
    middle = (segment[:, :2] + segment[:, 2:]) / 2
    half = np.hypot(*(segment[:, 2:] - segment[:, :2]).T) / 2
    centre = scene.line.at((first + last) / 2)[:2]
    segment = segment[np.hypot(*(middle - centre).T) - half <= (last - first) / 2 + OPEN / 2]
    if not len(segment):
        return np.zeros(0), np.zeros(0)
    count = np.maximum(np.ceil(np.hypot(*(segment[:, 2:] - segment[:, :2]).T) / APART), 1).astype(np.int64)
    which = np.repeat(np.arange(len(segment)), count + 1)
    number = np.arange(len(which)) - np.repeat(np.cumsum(count + 1) - (count + 1), count + 1)  # in its segment
    share = (number / count[which])[:, None]
    points = segment[which, :2] * (1 - share) + segment[which, 2:] * share
    told, ended = scene.line.project(points)
    kept = (ended == FOUND) & (told[:, 0] >= first) & (told[:, 0] <= last)
    return told[kept, 0], told[kept, 1]
