"""A laser that tells elevation beside range and bearing: a sensor that nothing in the tree knows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from models.objects.motion import Body
from models.objects.sensors import Floats, RangeBearing, Scalars


@dataclass(frozen=True, kw_only=True)
class Laser3D(RangeBearing):
    """Range [m] on the ground, bearing and elevation [rad]; z of the state is counted from the sensor's height. Where
    measurements begin a track, and how noise turns into places, is RangeBearing's: it reads the first two."""

    steepest: float = 0.3  # of false alarms, up and down [rad]
    names: ClassVar[tuple[str, ...]] = ("range", "bearing", "elevation")
    reads: ClassVar[tuple[str, ...]] = ("z",)

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        distance, bearing = RangeBearing.measure(body, at, ops)
        return (distance, bearing, ops.atan2(body.z, distance))

    @property
    def span(self) -> Floats:
        steepest = min(self.steepest, math.pi / 2)
        return np.vstack([super().span, (-steepest, steepest)])
