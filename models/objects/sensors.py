"""Sensors as data: what each measures, how well, how far, how often it misses and how often it errs.

    z = h(body; at) + N(0, R), detected with probability p_D(body; at);   false alarms: Poisson of intensity lambda_c(z)

`at` is the pose of the sensor in the world: x, y [m] and heading [rad]. A new sensor is a class with `names`, `measure`
and `place`, and a config; nothing else knows that it exists.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.objects.motion import ANGLES, Body
from models.objects.scans import Scan
from models.program import InputError

Floats = NDArray[np.float64]
Scalars = Sequence[Any]


class Placed(NamedTuple):
    """Where M measurements say that something is: position (M, 2) and its covariance (M, 2, 2) in the world, and
    headings (M, H) that are possible, None where any is."""

    position: Floats
    covariance: Floats
    heading: Floats | None = None
    heading_std: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """What all sensors have.

    name, mount   who it is; pose in the frame of the car: x, y [m], heading [rad]
    angle, reach  field of view: full opening angle [rad], nearest and farthest range [m]
    noise_std     (d,) standard deviations of what it measures
    detection     probability to detect an object in view
    clutter       false alarms a scan, expected
    births        whether what it measures may begin a track
    edge          how soft the borders of the view are: angle [rad] and range [m]
    """

    name: str
    noise_std: tuple[float, ...]
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angle: float = 2 * math.pi
    reach: tuple[float, float] = (0.0, 200.0)
    detection: float = 0.95
    clutter: float = 1.0
    births: bool = True
    edge: tuple[float, float] = (0.02, 1.0)

    names: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        if len(self.noise_std) != len(self.names) or not all(s > 0.0 for s in self.noise_std):
            raise InputError(
                f"sensor {self.name}: noise_std is {self.noise_std}; give a positive number for each of {self.names}"
            )
        if not 0.0 <= self.detection <= 1.0:
            raise InputError(f"sensor {self.name}: detection is {self.detection}; give a probability")

    @property
    def period(self) -> Floats:
        """(d,) of angles, inf else."""
        return np.array([ANGLES.get(name, math.inf) for name in self.names])

    def settings(self, kind: str) -> tuple[float, ...]:
        """The numbers that h and p_D of a kind depend on, in the order that `measure` and `detect` read them."""
        return (self.detection, self.angle / 2, *self.reach, *self.edge)

    @staticmethod
    def measure(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Scalars:
        """h, (d,)."""
        raise NotImplementedError

    @staticmethod
    def detect(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Any:
        """p_D: the share `detection` within the view, softly none outside."""
        detection, half, near, far, soft_angle, soft_range = settings
        dx, dy = body.x - at[0], body.y - at[1]
        along, across = ops.cos(at[2]) * dx + ops.sin(at[2]) * dy, ops.cos(at[2]) * dy - ops.sin(at[2]) * dx
        distance, bearing = ops.sqrt(dx * dx + dy * dy + 1e-12), ops.atan2(across, along + 1e-12)
        inside = logistic((half - ops.fabs(bearing)) / soft_angle, ops)
        inside = ops.where(half > 3.141, 1.0, inside)  # all around
        return (
            detection
            * inside
            * logistic((far - distance) / soft_range, ops)
            * logistic((distance - near) / soft_range, ops)
        )

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        """Where measurements (M, d) of covariances (M, d, d) are in the world: `measure` backwards."""
        raise NotImplementedError

    def clutter_intensity(self, values: Floats) -> Floats:
        """lambda_c (M,): uniform in what is measured, over the view."""
        return np.full(len(values), self.clutter / self.volume)

    @property
    def volume(self) -> float:
        """Of the measurements that are possible."""
        raise NotImplementedError

    def feature(self, scan: Scan, num_kinds: int) -> Floats:
        """(M, C) p(score, looks | kind) / p(score, looks | false alarm). A score s that is the probability to be no
        false alarm says s / (1 - s), up to the odds before, which are those of clutter and births."""
        found = np.ones((len(scan.values), num_kinds))
        if scan.score is not None:
            found *= (scan.score / (1.0 - scan.score))[:, None]
        return found if scan.likeness is None else found * scan.likeness

    def covariance(self, scan: Scan) -> Floats:
        """(M, d, d), or (1, d, d) where all have the same."""
        return np.diag(np.square(self.noise_std))[None] if scan.noise is None else scan.noise


def logistic(value: Any, ops: Any) -> Any:
    """1 / (1 + exp(-value)), without overflow."""
    return 0.5 + 0.5 * ops.tanh(0.5 * value)


def mounted(pose: Floats, mount: Sequence[float]) -> Floats:
    """(3,) the pose in the world of what is mounted on a car at `pose`."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array(
        [pose[0] + cos * mount[0] - sin * mount[1], pose[1] + sin * mount[0] + cos * mount[1], pose[2] + mount[2]]
    )


@dataclass(frozen=True, kw_only=True)
class Position(Sensor):
    """x and y in the world [m], of what is in a square of half width `extent` about `middle`: the sensor of tracking
    benchmarks. False alarms are uniform in the square."""

    middle: tuple[float, float] = (0.0, 0.0)
    extent: float = 1000.0
    names: ClassVar[tuple[str, ...]] = ("x", "y")

    def settings(self, kind: str) -> tuple[float, ...]:
        return (self.detection, *self.middle, self.extent, self.edge[1])

    @staticmethod
    def measure(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Scalars:
        return (body.x, body.y)

    @staticmethod
    def detect(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Any:
        detection, x, y, extent, soft = settings
        farther = ops.fmax(ops.fabs(body.x - x), ops.fabs(body.y - y))
        return detection * logistic((extent - farther) / soft, ops)

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        return Placed(values, noise)

    @property
    def volume(self) -> float:
        return (2 * self.extent) ** 2


@dataclass(frozen=True, kw_only=True)
class RangeBearing(Sensor):
    """Range [m] and bearing [rad] of the middle of an object, from the sensor."""

    names: ClassVar[tuple[str, ...]] = ("range", "bearing")

    @staticmethod
    def measure(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Scalars:
        dx, dy = body.x - at[0], body.y - at[1]
        return (ops.sqrt(dx * dx + dy * dy + 1e-9), ops.atan2(dy, dx) - at[2])

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        distance, angle = values[:, 0], values[:, 1] + at[2]
        cos, sin = np.cos(angle), np.sin(angle)
        slope = np.stack([np.stack([cos, -distance * sin], -1), np.stack([sin, distance * cos], -1)], -2)
        position = np.stack([at[0] + distance * cos, at[1] + distance * sin], -1)
        return Placed(position, slope @ noise[:, :2, :2] @ slope.swapaxes(-1, -2))

    @property
    def volume(self) -> float:
        return (self.reach[1] - self.reach[0]) * self.angle


@dataclass(frozen=True, kw_only=True)
class Radar(RangeBearing):
    """Range [m], bearing [rad] and range rate over ground [m/s]: the car's own motion is taken out by the sensor.
    False alarms have range rates uniform within +-`fastest`."""

    fastest: float = 20.0
    names: ClassVar[tuple[str, ...]] = ("range", "bearing", "range_rate")

    @staticmethod
    def measure(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Scalars:
        dx, dy = body.x - at[0], body.y - at[1]
        distance, bearing = RangeBearing.measure(body, at, settings, ops)
        return (distance, bearing, (dx * body.vx + dy * body.vy) / distance)

    @property
    def volume(self) -> float:
        return super().volume * 2 * self.fastest
