"""Reference curves: a first course of each lane from the tracks on it alone.

No frame and no structure: the longest track of a lane is smoothed by a spline over the number of the point,

    min_c  sum_i |p_i - sum_k c_k N_k(i)|^2 + STIFF sum_k |c_(k+3) - 3 c_(k+2) + 3 c_(k+1) - c_k|^2

(Eilers and Marx 1996), made longer at both ends as far as other tracks of the lane go, and divided into equal steps.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from models.intersection.free_kernel import free_nodes
from models.spline import ORDER, basis

Array = NDArray[np.float64]
KNOTS = 4.0  # points between the knots of the smoothing spline
STIFF = 10.0
SHORTEST = 6  # nodes of a curve
LEAST = 1e-6  # [m] between points, for a spline in the length along them


def reference_curve(tracks: list[Array], spacing: float) -> Array:
    """Points (n, 2) about `spacing` apart along a first course of a lane with tracks, each (m, 2) [m]."""
    longest = max(tracks, key=lambda points: float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()))
    line = smoothed(longest)
    before, behind = (overhang(line[::step], tracks) for step in (1, -1))
    first, last = line[0] - before * direction(line[0], line[1]), line[-1] + behind * direction(line[-2], line[-1])
    return resampled(np.vstack([first[None][: before > spacing], line, last[None][: behind > spacing]]), spacing)


def smoothed(points: Array) -> Array:
    """The smoothing spline of points (n, 2), one for each of them."""
    num = max(math.ceil((len(points) - 1) / KNOTS), 1) + ORDER - 1
    pieces, weights, _ = basis(np.arange(len(points), dtype=np.float64), 0.0, KNOTS, num)
    design = np.zeros((len(points), num))
    np.put_along_axis(design, pieces[:, None] + np.arange(ORDER), weights, 1)
    third = np.diff(np.eye(num), ORDER - 1, axis=0)
    return np.asarray(design @ np.linalg.solve(design.T @ design + STIFF * third.T @ third, design.T @ points))


def overhang(line: Array, tracks: list[Array]) -> float:
    """How far the tracks reach beyond the first point of a line, along its direction there [m]."""
    outwards = direction(line[min(4, len(line) - 1)], line[0])
    ends = [end for points in tracks for end in (points[0], points[-1]) if near(end, line)]
    return max((float((end - line[0]) @ outwards) for end in ends), default=0.0)


def near(point: Array, line: Array) -> bool:
    """Whether the first point of a line is the nearest of its points."""
    return int(((line - point) ** 2).sum(1).argmin()) == 0


def direction(a: Array, b: Array) -> Array:
    """Unit vector from a to b."""
    return np.asarray((b - a) / np.linalg.norm(b - a))


def arc_length(line: Array) -> Array:
    """(n,) along the chords [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def tangents(line: Array) -> Array:
    """Unit tangents (n, 2) of a polyline by central differences."""
    steps = np.gradient(line, axis=0)
    return np.asarray(steps / np.linalg.norm(steps, axis=1)[:, None])


def curvatures(line: Array) -> Array:
    """(n,) of a polyline [1/m]."""
    nodes = np.empty((len(line), 5))
    free_nodes(np.empty(0), np.hstack([line, tangents(line)]), np.empty((len(line), 0)), nodes)
    return nodes[:, 4]


def turns(line: Array, t: Array, pieces: int, knots: float) -> Array:
    """Third differences (pieces,) that take the changes of a curve's own curvature from knot to knot back [m].

    t (n,) of the points (n, 2) of the curve; knots lie `knots` apart in t"""
    return np.asarray(-(knots**2) * np.diff(np.interp(knots * np.arange(pieces + 1), t, curvatures(line))))


def resampled(line: Array, spacing: float) -> Array:
    """The cubic spline through the points (n, 2) of a line at equal steps of about `spacing`."""
    line = line[np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > LEAST])]
    length = arc_length(line)
    count = max(round(length[-1] / spacing) + 1, SHORTEST)
    return np.asarray(CubicSpline(length, line)(np.linspace(0.0, length[-1], count)))
