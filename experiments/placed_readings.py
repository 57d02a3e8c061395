"""Where measurements say that objects are: what pictures of tracks show in grey."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.objects.scans import Recording
from models.objects.sensors import mounted
from models.objects.traffic import Traffic

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PlacedReadings:
    """A function of a recording: time [s] and positions (M, 2) in the world [m] of the measurements of each scan, by
    the sensors of `traffic`; none of sensors that cannot begin a track, for they place objects too vaguely."""

    traffic: Traffic

    def __call__(self, data: Recording) -> list[tuple[float, Floats]]:
        told = list[tuple[float, Floats]]()
        for scan in data.scans:
            sensor = self.traffic.sensor(scan)
            if sensor.births and len(scan.values):
                covariance = sensor.covariance(scan)
                covariance = np.broadcast_to(covariance, (len(scan.values), *covariance.shape[1:]))
                placed = sensor.place(scan.values, covariance, mounted(scan.pose, sensor.mount))
                told.append((scan.time, placed.position))
        return told
