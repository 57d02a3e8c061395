"""A detector of 3-D boxes of vehicles that scores them, such as PointRCNN."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from models.objects.motion import Body
from models.objects.scans import Scan
from models.objects.sensors import Placed, Scalars, Sensor, logistic

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Look:
    """How a kind looks to the detector: score at range r is score - fall max(r - near, 0); detection probability."""

    fall: float = 0.0
    near: float = 10.0
    detection: float = 0.97
    far: float = 70.0


@dataclass(frozen=True, kw_only=True)
class BoxDetector(Sensor):
    looks: tuple[tuple[str, Look], ...] = ()
    clutter_density: float = 2.7e-4  # per m^2
    clutter_score: tuple[float, float] = (0.7, 1.3)
    clutter_size: tuple[tuple[float, float], ...] = ((1.55, 0.15), (1.63, 0.07), (3.97, 0.35))
    clutter_z: tuple[float, float] = (-1.7, 0.5)
    score_std: float = 1.0
    stds: tuple[float, ...] = (0.12, 0.07, 0.05, 0.08, 0.1, 0.1, 0.3)
    names: ClassVar[tuple[str, ...]] = ("x", "y", "heading", "z", "height", "width", "length", "score")

    @property
    def period(self) -> Floats:
        return np.where([name == "heading" for name in self.names], math.pi, math.inf)

    def settings(self, kind: str) -> tuple[float, ...]:
        look = dict(self.looks)[kind]
        return (look.detection, self.angle / 2, look.far, look.fall, look.near)

    @staticmethod
    def measure(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Scalars:
        dx, dy = body.x - at[0], body.y - at[1]
        distance = ops.sqrt(dx * dx + dy * dy + 1e-9)
        score = body.score - settings[3] * ops.fmax(distance - settings[4], 0.0)
        return (body.x, body.y, body.heading, body.z, body.height, body.width, body.length, score)

    @staticmethod
    def detect(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Any:
        detection, half, far = settings[:3]
        dx, dy = body.x - at[0], body.y - at[1]
        along, across = ops.cos(at[2]) * dx + ops.sin(at[2]) * dy, ops.cos(at[2]) * dy - ops.sin(at[2]) * dx
        distance, bearing = ops.sqrt(dx * dx + dy * dy + 1e-12), ops.atan2(across, along + 1e-12)
        half_width = 1.2 / distance  # of the object as an angle: one that is partly in the image may be seen
        inside = ops.fmin(ops.fmax((half + half_width - ops.fabs(bearing)) / (2 * half_width), 0.0), 1.0)
        return detection * ops.fmin(1.5 * inside, 1.0) * logistic((far - distance) / 4.0, ops)

    def covariance(self, scan: Scan) -> Floats:
        values, score = scan.values, scan.values[:, 7]
        k = np.exp(np.interp(score, [-1, 1, 4, 7, 10], np.log([3.0, 2.2, 1.5, 1.0, 0.6])))
        R = np.zeros((len(values), 8, 8))
        angle = np.arctan2(values[:, 1] - scan.pose[1], values[:, 0] - scan.pose[0])
        cos, sin = np.cos(angle), np.sin(angle)
        a, b = (self.stds[0] * k) ** 2, (self.stds[1] * k) ** 2
        R[:, 0, 0], R[:, 1, 1] = cos**2 * a + sin**2 * b, sin**2 * a + cos**2 * b
        R[:, 0, 1] = R[:, 1, 0] = cos * sin * (a - b)
        for i, std in enumerate(self.stds[2:], start=2):
            R[:, i, i] = (std * k) ** 2
        R[:, 7, 7] = self.score_std**2
        return R

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        return Placed(values[:, :2], noise[:, :2, :2], values[:, 2:3], 1.0)

    def clutter_intensity(self, values: Floats) -> Floats:
        loc, std = zip(self.clutter_z, *self.clutter_size, self.clutter_score, strict=True)
        z = (values[:, 3:] - np.array(loc)) / np.array(std)
        log = -0.5 * np.square(z).sum(1) - np.log(np.array(std) * math.sqrt(2 * math.pi)).sum()
        return self.clutter_density / math.pi * np.exp(log)
