"""What sensors report: scans, and the checks that they are usable."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Scan(NamedTuple):
    """All M measurements of one sensor at one time. Sensors are never coupled: each reports its own.

    sensor    name of the sensor, as the model has it
    time      [s]
    values    (M, d) as the sensor measures
    pose      (3,) of the car in the world then: x, y [m], heading [rad]
    noise     (M, d, d) covariances, None for those of the sensor
    score     (M,) what the detector thinks of each: the probability that it is no false alarm, unless the sensor
              says otherwise; None where it has no opinion
    likeness  (M, C) p(looks of the measurement | kind), up to a factor by measurement; None where it shows no kind
    """

    sensor: str
    time: float
    values: Floats
    pose: Floats
    noise: Floats | None = None
    score: Floats | None = None
    likeness: Floats | None = None


class Recording(NamedTuple):
    """What all sensors of a car reported, in the order in which it arrived: late scans come late."""

    scans: tuple[Scan, ...]
