"""Two more sensors beside the camera: what a radar reflects along the guardrail, and the edge of the road that a lidar
sees. A radar measures ranges well and angles badly, a lidar both well but not far. The numbers are ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.road.cues import CueKind, line_of_sight

Floats = NDArray[np.float64]


class Sensor(NamedTuple):
    """What it sees, right of the road every `gap` [m] to `reach` [m], and its noise along and across the line of sight:
    a standard deviation [m], and an angle [rad]."""

    kind: CueKind
    gap: float
    reach: float
    range_std: float
    angle_std: float

    def covariance(self, true: Floats, moves: NDArray[np.bool_]) -> Floats:
        """Covariances (N, 2, 2) of positions measured at true ones (N, 2) [m^2]."""
        distance = np.hypot(*true.T)
        return line_of_sight(true, np.full(len(true), self.range_std), 0.02 + self.angle_std * distance)


RADAR = Sensor(CueKind("radar", right=(-5.0, 1.0), left=(7.0, 1.0), std=0.4), 7.0, 140.0, 0.3, 0.01)
LIDAR = Sensor(CueKind("lidar", right=(-3.0, 0.7), left=(5.0, 0.7), std=0.1), 5.0, 60.0, 0.05, 0.001)
