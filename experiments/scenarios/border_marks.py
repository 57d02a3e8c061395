"""Markings and curbs on the arms of a simulated junction, as a camera or a laser scanner would place them."""

from __future__ import annotations

import numpy as np

from experiments.scenarios.scene import Floats, JunctionTruth

SPACING = 4.0  # of the points along a border [m]


def border_marks(truth: JunctionTruth, length: float, std: float, rng: np.random.Generator) -> Floats:
    """Points (M, 2) on all borders of the lanes of straight arms, from where interiors begin to `length` [m].

    One point about every SPACING metres, white noise of `std` [m] on each axis."""
    points = []
    for arm, angle in enumerate(truth.angle):
        axis = np.array([np.cos(angle), np.sin(angle)])
        for side, count in ((1, truth.entries[arm]), (-1, truth.exits[arm])):
            for number in range(count + 1):
                s = np.arange(truth.radius[arm] + SPACING * rng.uniform(), length, SPACING)
                across = side * (truth.gap[arm] / 2 + number * truth.width[arm])
                points.append(truth.centre + s[:, None] * axis + across * np.array([-axis[1], axis[0]]))
    return np.concatenate(points) + std * rng.standard_normal((sum(map(len, points)), 2))
