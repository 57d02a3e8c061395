"""Sensors as data: what each measures, how well, how far, how often it misses and how often it errs.

    z = h(body; at) + N(0, R(h)), detected with probability p_D(body; at);  false alarms: a Poisson process, lambda_c(z)

`at` is the pose of the sensor in the world: x, y [m] and heading [rad]. A new sensor is a class with `names`,
`measure`, `place` and `span`, and a config; nothing else knows that it exists.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.formula import Formula
from models.objects.motion import ANGLES, Body, Motion, check_length
from models.objects.newcomers import from_polar
from models.objects.perception import capability, combined, hidden_share, hindrance, logistic, probability
from models.objects.scans import Scan
from models.program import InputError

Floats = NDArray[np.float64]
Scalars = Sequence[Any]
UNSURE = 1e-6  # no score makes a false alarm less probable than this, even where it is 1
AROUND = 3.141  # half an angle of view from which on a sensor sees all around [rad]


class Placed(NamedTuple):
    """Where M measurements say that something is: position (M, 2) and its covariance (M, 2, 2) in the world, and the
    headings (M, H) that it may have, None where any is possible, with their standard deviation (M,), None where
    they are told apart from each other only: then they share the circle."""

    position: Floats
    covariance: Floats
    heading: Floats | None = None
    heading_std: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """What all sensors have.

    name, mount   who it is; pose in the frame of the car: x, y [m], heading [rad]
    angle, reach  field of view: full opening angle [rad], nearest and farthest range [m]
    noise_std     (d,) standard deviations of what it measures, or what `spread` makes them of
    detection     probability to detect an object in view, where nothing hinders
    doubt         of which only the rest is known (models.objects.perception)
    weather       mass that the weather gives to not detecting, None for weather that says nothing
    occlusion     the same of an object that is hidden behind others altogether
    clutter       false alarms a scan, expected
    births        whether what it measures may begin a track
    edge          how soft the borders of the view are: angle [rad] and range [m]
    confusion     (C + 1, L) p(looks l | kind), and in the last row of false alarms; None where it tells no kinds apart
    """

    name: str
    noise_std: tuple[float, ...]
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angle: float = 2 * math.pi
    reach: tuple[float, float] = (0.0, 200.0)
    detection: float = 0.95
    doubt: float = 0.0
    weather: float | None = None
    occlusion: float = 0.0
    clutter: float = 1.0
    births: bool = True
    edge: tuple[float, float] = (0.01, 0.5)
    confusion: tuple[tuple[float, ...], ...] | None = None

    names: ClassVar[tuple[str, ...]] = ()
    reads: ClassVar[tuple[str, ...]] = ()  # of Body, what not every motion has

    def __post_init__(self) -> None:
        if len(self.noise_std) != len(self.names) or not all(s > 0.0 for s in self.noise_std):
            raise InputError(
                f"sensor {self.name}: noise_std is {self.noise_std}; give a positive number for each of {self.names}"
            )
        for what in ("detection", "doubt", "weather", "occlusion"):
            value = getattr(self, what)
            if value is not None and not 0.0 <= value <= 1.0:
                raise InputError(f"sensor {self.name}: {what} is {value}; give a number from 0 to 1")
        if self.doubt > 2 * min(self.detection, 1.0 - self.detection):
            raise InputError(
                f"sensor {self.name}: doubt is {self.doubt}, but a detection of {self.detection} leaves at most "
                f"{2 * min(self.detection, 1.0 - self.detection):g}"
            )
        if not 0.0 <= self.clutter < math.inf:
            raise InputError(f"sensor {self.name}: clutter is {self.clutter}; give the expected number of false alarms")
        if not 0.0 < self.angle or not 0.0 <= self.reach[0] < self.reach[1]:
            raise InputError(
                f"sensor {self.name}: angle is {self.angle} and reach {self.reach}; give a positive angle, and the "
                "nearest range before the farthest"
            )
        if self.confusion is not None:
            table = np.array(self.confusion, dtype=np.float64)
            if table.ndim != 2 or (table < 0.0).any() or (table[-1] == 0.0).any() or not np.allclose(table.sum(1), 1.0):
                raise InputError(
                    f"sensor {self.name}: confusion is {self.confusion}; give rows of probabilities that sum to one, "
                    "one for each kind and one, without zeros, for false alarms"
                )

    @cached_property
    def period(self) -> Floats:
        """(d,) of angles, inf else."""
        return np.array([ANGLES.get(name, math.inf) for name in self.names])

    @property
    def view_settings(self) -> tuple[float, ...]:
        """The numbers that `view` reads, in its order."""
        return (self.angle / 2, *self.reach, *self.edge)

    @property
    def settings(self) -> tuple[float, ...]:
        """The numbers that p_D depends on: capability, weather, view."""
        return (self.detection, self.doubt, self.weather or 0.0, *self.view_settings)

    @cached_property
    def looking(self) -> Floats:
        """(3 + .,) `mount`, `settings` and `occlusion`: what p_D reads of a sensor at a pose of the car, where all that
        may be hidden is."""
        return np.array((*self.mount, *self.settings, self.occlusion), dtype=np.float64)

    @property
    def noise_settings(self) -> tuple[float, ...]:
        """The numbers that `spread` reads."""
        return self.noise_std

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        """h, (d,)."""
        raise NotImplementedError

    @staticmethod
    def spread(z: Scalars, settings: Scalars, ops: Any) -> Scalars:
        """Standard deviations (d,) where h is z: of the program at the true h, of filters at what was measured."""
        return settings

    @staticmethod
    def view(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Any:
        """How surely it is within the view: one inside, zero outside, softly between."""
        half, near, far, soft_angle, soft_range = settings
        dx, dy = body.x - at[0], body.y - at[1]
        along, across = ops.cos(at[2]) * dx + ops.sin(at[2]) * dy, ops.cos(at[2]) * dy - ops.sin(at[2]) * dx
        distance, bearing = ops.sqrt(dx * dx + dy * dy + 1e-12), ops.atan2(across, along + 1e-12)
        inside = ops.where(half > AROUND, 1.0, logistic((half - ops.fabs(bearing)) / soft_angle, ops))
        nearest = ops.where(near > 0.0, logistic((distance - near) / soft_range, ops), 1.0)
        return inside * nearest * logistic((far - distance) / soft_range, ops)

    @classmethod
    def detect(cls, body: Body, at: Scalars, settings: Scalars, hidden: Any, ops: Any) -> Any:
        """p_D = view * pignistic(capability + weather + occlusion): the mean of what is so within the view, and of
        nothing, which is certain outside. `hidden` is the mass that occlusion gives to not detecting."""
        detection, doubt, weather = settings[:3]
        masses = combined(capability(detection, doubt), hindrance(weather), ops)
        return cls.view(body, at, settings[3:], ops) * probability(combined(masses, hindrance(hidden), ops))

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        """Where measurements (M, d) of covariances (M, d, d) are in the world: `measure` backwards."""
        raise NotImplementedError

    @property
    def span(self) -> Floats:
        """(d, 2) lowest and highest false alarm."""
        raise NotImplementedError

    @property
    def false_alarms(self) -> float:
        """Expected in a scan, int lambda_c."""
        return self.clutter

    def clutter_quantile(self, uniform: Floats) -> Floats:
        """False alarms (*, d) of uniform numbers (*, d): independent entries of density lambda_c / int lambda_c."""
        low, high = self.span.T
        return np.asarray(low + (high - low) * uniform)

    def clutter_intensity(self, values: Floats) -> Floats:
        """lambda_c (*, M) of values (*, M, d): uniform over the span; the same beyond it, where noise may lead."""
        return np.full(values.shape[:-1], self._clutter_density)

    @cached_property
    def _clutter_density(self) -> float:
        return self.clutter / float(np.prod(self.span[:, 1] - self.span[:, 0]))

    @cached_property
    def _covariance(self) -> Floats:
        return np.diag(np.square(self.noise_std))[None]

    def feature(self, scan: Scan, num_kinds: int) -> Floats:
        """(M, C) p(score, looks | kind) / p(score, looks | false alarm). A score s that is the probability to be no
        false alarm says s / (1 - s), up to the odds before, which are those of clutter and births."""
        found = np.ones((len(scan.values), num_kinds))
        if scan.score is not None:
            found *= (scan.score / np.maximum(1.0 - scan.score, UNSURE))[:, None]
        return found if scan.likeness is None else found * scan.likeness

    def covariance(self, scan: Scan) -> Floats:
        """(M, d, d), or (1, d, d) where all have the same."""
        if scan.noise is not None:
            return scan.noise
        if type(self).spread is Sensor.spread:
            return self._covariance
        formula = spread_formula(type(self), len(self.noise_settings))  # type: ignore[arg-type]
        std = formula(scan.values, np.array([self.noise_settings]))
        return np.square(std)[:, :, None] * np.eye(std.shape[1])


@lru_cache
def sensor_formulas(motion: Motion, sensor: type[Sensor], num_settings: int) -> tuple[Formula, Formula]:
    """h: (state; pose of the sensor) -> (d,), and p_D: (state; pose, settings, hidden) -> ()."""
    label, size = sensor.__name__.lower(), len(motion.names)

    def measure(x: Scalars, p: Scalars, ops: Any) -> Scalars:
        seen = sensor.measure(motion.body(x, ops), p, ops)
        check_length(f"{sensor.__name__}.measure", seen, sensor.names)
        return seen

    def detect(x: Scalars, p: Scalars, ops: Any) -> Scalars:
        return (sensor.detect(motion.body(x, ops), p[:3], p[3:-1], p[-1], ops),)

    return Formula(f"{label}_measure", measure, size, 3), Formula(f"{label}_detect", detect, size, 4 + num_settings)


@lru_cache
def spread_formula(sensor: type[Sensor], num_settings: int) -> Formula:
    """(h; settings of the noise) -> standard deviations (d,)."""
    label = f"{sensor.__name__.lower()}_spread"
    return Formula(label, sensor.spread, len(sensor.names), num_settings)


@lru_cache
def hidden_formula() -> Formula:
    """(x, y of an object and of another; pose of the sensor, both radii) -> what share of the first is hidden."""

    def hidden(x: Scalars, p: Scalars, ops: Any) -> Scalars:
        return (hidden_share((x[0], x[1]), (p[0], p[1]), p[3], (x[2], x[3]), p[4], ops),)

    return Formula("hidden", hidden, 4, 5)


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

    @property
    def view_settings(self) -> tuple[float, ...]:
        return (*self.middle, self.extent, self.edge[1])

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        return (body.x, body.y)

    @staticmethod
    def view(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Any:
        x, y, extent, soft = settings
        farther = ops.fmax(ops.fabs(body.x - x), ops.fabs(body.y - y))
        return logistic((extent - farther) / soft, ops)

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        return Placed(values, noise)

    @property
    def span(self) -> Floats:
        return np.add(self.middle, self.extent * np.array([[-1.0, -1.0], [1.0, 1.0]])).T


def placed(values: Floats, noise: Floats, at: Floats) -> Placed:
    """Where range and bearing, the first of what is measured (M, d), are in the world."""
    return Placed(*from_polar(values, noise, at))


@dataclass(frozen=True, kw_only=True)
class RangeBearing(Sensor):
    """Range [m] and bearing [rad] of the middle of an object, from the sensor."""

    names: ClassVar[tuple[str, ...]] = ("range", "bearing")

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        dx, dy = body.x - at[0], body.y - at[1]
        return (ops.sqrt(dx * dx + dy * dy + 1e-9), ops.atan2(dy, dx) - at[2])

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        return placed(values, noise, at)

    @property
    def span(self) -> Floats:
        half = min(self.angle / 2, math.pi)
        return np.array([self.reach, (-half, half)])


@dataclass(frozen=True, kw_only=True)
class Radar(RangeBearing):
    """Range [m], bearing [rad] and range rate over ground [m/s]: the car's own motion is taken out by the sensor.
    False alarms have range rates uniform within +-`fastest`."""

    fastest: float = 20.0
    names: ClassVar[tuple[str, ...]] = ("range", "bearing", "range_rate")

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        dx, dy = body.x - at[0], body.y - at[1]
        distance, bearing = RangeBearing.measure(body, at, ops)
        return (distance, bearing, (dx * body.vx + dy * body.vy) / distance)

    @property
    def span(self) -> Floats:
        return np.vstack([super().span, (-self.fastest, self.fastest)])


@dataclass(frozen=True, kw_only=True)
class Camera(RangeBearing):
    """Bearing [rad], and the range [m] at which an object stands on a flat road, `height` [m] below the camera: the
    angle of sight below the horizon is height / range, so what it is wrong by, noise_std[0] [rad] (pitch and pixels),
    becomes

        std of range = range^2 / height * noise_std[0]
    """

    height: float = 1.3
    names: ClassVar[tuple[str, ...]] = ("range", "bearing")

    @property
    def noise_settings(self) -> tuple[float, ...]:
        return (*self.noise_std, self.height)

    @staticmethod
    def spread(z: Scalars, settings: Scalars, ops: Any) -> Scalars:
        steep, bearing, height = settings
        distance = ops.fmax(z[0], 1.0)
        return (distance * distance / height * steep, bearing)


@dataclass(frozen=True, kw_only=True)
class LaserBox(RangeBearing):
    """A box fitted to laser points: range [m] and bearing [rad] of its middle, its axis [rad] (a heading of which front
    and back are not told apart), length and width [m]. False alarms have sizes up to `largest` [m]."""

    largest: tuple[float, float] = (12.0, 4.0)
    names: ClassVar[tuple[str, ...]] = ("range", "bearing", "axis", "length", "width")
    reads: ClassVar[tuple[str, ...]] = ("heading", "length", "width")

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        return (*RangeBearing.measure(body, at, ops), body.heading - at[2], body.length, body.width)

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        where, axis = super().place(values, noise, at), values[:, 2:3] + at[2]
        return where._replace(heading=np.concatenate([axis, axis + math.pi], 1), heading_std=np.sqrt(noise[:, 2, 2]))

    @property
    def span(self) -> Floats:
        sizes = [(0.0, size) for size in self.largest]
        return np.vstack([super().span, (-math.pi / 2, math.pi / 2), *sizes])
