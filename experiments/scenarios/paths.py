"""Polylines in the plane, walked by arc length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def arc_length(points: Floats) -> Floats:
    """Distance driven up to each point of a polyline (n, 2), (n,) [m]."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def at(points: Floats, s: Floats) -> Floats:
    """Positions (m, 2) of a polyline at arc lengths s (m,)."""
    along = arc_length(points)
    return np.stack([np.interp(s, along, points[:, 0]), np.interp(s, along, points[:, 1])], axis=1)


def resample(points: Floats, step: float) -> Floats:
    """The polyline with a point every `step` metres, beginning at its first point."""
    return at(points, np.arange(0.0, arc_length(points)[-1], step))


def headings(points: Floats) -> Floats:
    """Driving direction at each point, unwrapped along the polyline, (n,) [rad]."""
    tangent = np.gradient(points, axis=0)
    return np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))


def beside(points: Floats, line: Floats) -> tuple[Floats, Floats]:
    """How far to the left of each point of a polyline (n, 2) another one (m, 2) runs, (n,) [m], and where on it the
    closest place is, (n,): 2.25 is a quarter of the way from its vertex 2 to its vertex 3."""
    start, step = line[:-1], np.diff(line, axis=0)
    along = ((points[:, None] - start) * step).sum(-1) / np.maximum((step**2).sum(-1), 1e-300)
    along = np.clip(along, 0.0, 1.0)  # (n, m - 1)
    gaps = start + along[..., None] * step - points[:, None]
    nearest = (gaps**2).sum(-1).argmin(1)
    rows = np.arange(len(points))
    heading, gap = headings(points), gaps[rows, nearest]
    return -np.sin(heading) * gap[:, 0] + np.cos(heading) * gap[:, 1], nearest + along[rows, nearest]


def wrap(angle: Floats) -> Floats:
    """Angles brought to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
