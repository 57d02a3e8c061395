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


def wrap(angle: Floats) -> Floats:
    """Angles brought to [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
