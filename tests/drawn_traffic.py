"""Tracks drawn by hand on known courses, for tests of lanes from traffic."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios import paths
from experiments.scenarios.scene import join_tracks
from models.intersection.tracks import Tracks

Floats = NDArray[np.float64]


def straight(start: tuple[float, float], end: tuple[float, float]) -> Floats:
    """A line with a point every metre, its ends included; of whole metres."""
    return np.linspace(start, end, round(math.dist(start, end)) + 1)


def corner(offset: float, reach: float = 60.0, radius: float = 10.0) -> Floats:
    """A right turn: east along y = offset, then south along x = offset; with a quarter of a circle."""
    turn = np.linspace(0.5 * math.pi, 0.0, 30)
    middle = np.array([offset - radius, offset - radius])
    arc = middle + radius * np.stack([np.cos(turn), np.sin(turn)], 1)
    return paths.resample(np.vstack([[[-reach, offset]], arc, [[offset, -reach]]]), 1.0)


def shifting(before: float, after: float, at: float = -35.0, over: float = 20.0, reach: float = 60.0) -> Floats:
    """East from y = before to y = after, by a cosine over some metres from x = at on."""
    x = np.arange(-reach, reach, 0.5)
    u = np.clip((x - at) / over, 0.0, 1.0)
    return paths.resample(np.stack([x, before + (after - before) * (1 - np.cos(np.pi * u)) / 2], 1), 1.0)


def noisy(courses: list[Floats], seed: int = 0, std: float = 0.3) -> Tracks:
    """One track along each course, with white noise."""
    rng = np.random.default_rng(seed)
    return join_tracks([course + std * rng.standard_normal(course.shape) for course in courses], None)


def shuffled(tracks: Tracks, order: NDArray[np.int64]) -> Tracks:
    """The same tracks in another order."""
    return join_tracks([tracks.points[slice(*tracks.offsets[i : i + 2])] for i in order], None)
