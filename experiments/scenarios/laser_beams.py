"""Where the beams of a laser scanner end among rectangles, each of which hides what is behind it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Laser(NamedTuple):
    """Angle between two beams [rad], and standard deviation of their length [m]: a front laser of [K15], section II."""

    step: float = math.radians(0.125)
    range_std: float = 0.04


class Sweep(NamedTuple):
    """What B beams say.

    bearing   (B,) rising, seen from the sensor [rad]
    distance  (B,) to where they end [m], inf where nothing stops them
    """

    bearing: Floats
    distance: Floats


def sweep(laser: Laser, at: Floats, angle: float, reach: float, rectangles: Floats, rng: np.random.Generator) -> Sweep:
    """Beams over an opening angle [rad], up to `reach` [m], from a sensor at (3,) x, y [m], heading [rad].

    rectangles (N, 5): x, y of the middle [m], heading [rad], length and width [m]."""
    bearing = np.arange(-angle / 2, angle / 2 + 0.5 * laser.step, laser.step)
    distance = ranges(at, bearing + at[2], rectangles)
    distance = np.where(distance <= reach, distance + laser.range_std * rng.standard_normal(len(bearing)), np.inf)
    return Sweep(bearing, distance)


def ranges(at: Floats, direction: Floats, rectangles: Floats) -> Floats:
    """(B,) distance [m] from a point to the first rectangle in each direction [rad], inf where there is none.

    In the frame of a rectangle the beam o + t d is between two sides for t within (+-h - o) / d; it enters where it has
    come between the second pair of sides, if it has not left the first by then."""
    turn = direction[:, None] - rectangles[:, 2]
    gap = np.asarray(at[:2]) - rectangles[:, :2]
    cos, sin = np.cos(rectangles[:, 2]), np.sin(rectangles[:, 2])
    along, across = cos * gap[:, 0] + sin * gap[:, 1], cos * gap[:, 1] - sin * gap[:, 0]
    pairs = list[tuple[Floats, Floats]]()
    for ray, origin, size in ((np.cos(turn), along, rectangles[:, 3]), (np.sin(turn), across, rectangles[:, 4])):
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (-0.5 * size - origin) / ray, (0.5 * size - origin) / ray  # (B, N)
        pairs.append((np.fmin(first, second), np.fmax(first, second)))
    enter, leave = np.maximum(pairs[0][0], pairs[1][0]), np.minimum(pairs[0][1], pairs[1][1])
    met = np.where((enter <= leave) & (leave > 0.0), np.maximum(enter, 0.0), np.inf)
    return np.asarray(met.min(1, initial=np.inf))
