"""The model of traffic, as filters read it: how objects of several kinds move, and how sensors see them.

    object   kind k with probability share_k, state x = (position, the rest):  position is uniform (unseen objects have
             the density `unseen_density` [1/m^2]), the rest normal or, of headings, uniform
    motion   x' = f(x, dt) + L_k e;   an object of kind k lives for Exponential(lifetime_k) seconds
    sensors  models.objects.sensors

[K15] tracks with a labeled multi-Bernoulli filter; what is said here is the model under it. Objects that no scan has
shown yet are a Poisson process of constant density, as in Williams (2015), so that a first measurement begins a track
with the probability that it is an object rather than a false alarm, in its own scan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.formula import Formula
from models.multi_object import Bernoullis, Components, Moved, View, no_components, no_objects
from models.objects.motion import ANGLES, ConstantTurn, Motion, Scalars, move_formula, noise_formula
from models.objects.scans import Scan
from models.objects.sensors import Sensor, mounted
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
FLAT = 100.0  # a prior this many times wider than a measurement is taken for uniform: it adds 1e-4 of its information
HEADINGS = 4  # about which a heading that nobody measured is normal, each with a quarter of the circle


@dataclass(frozen=True)
class Kind:
    """What objects of one kind are like.

    noise         standard deviations by the motion's `noises`
    share         of unseen objects
    lifetime      mean [s]
    speed         mean and standard deviation [m/s] when first seen
    yaw_rate_std, acceleration_std  when first seen [rad/s], [m/s^2]
    extras        (mean, standard deviation) of the motion's extras when first seen
    """

    name: str = "object"
    noise: tuple[float, ...] = (0.6, 0.15, 0.01)
    share: float = 1.0
    lifetime: float = 100.0
    speed: tuple[float, float] = (8.0, 4.0)
    yaw_rate_std: float = 0.2
    acceleration_std: float = 0.5
    extras: tuple[tuple[float, float], ...] = ()
    rates: tuple[float, ...] = ()


@dataclass(frozen=True)
class Place:
    """Where objects come from, at a rate [1/s]: position and its standard deviation [m], and, where it is known, the
    heading [rad] and its standard deviation."""

    position: tuple[float, float]
    std: float
    rate: float
    heading: tuple[float, float] | None = None


@dataclass(frozen=True)
class Traffic:
    """Settings: the motion, the kinds, the sensors, and where new objects come from."""

    sensors: tuple[Sensor, ...]
    motion: Motion = field(default_factory=ConstantTurn)
    kinds: tuple[Kind, ...] = (Kind(),)
    unseen_density: float = 1e-4  # [1/m^2]
    places: tuple[Place, ...] = ()

    def __post_init__(self) -> None:
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) < len(names):
            raise InputError(f"sensors are called {names}; give each a name of its own")
        for kind in self.kinds:
            if len(kind.noise) != len(self.motion.noises) or len(kind.extras) != len(self.motion.extras):
                raise InputError(
                    f"kind {kind.name} has {len(kind.noise)} noises and {len(kind.extras)} extras; "
                    f"give a number for each of {self.motion.noises} and a pair for each of {self.motion.extras}"
                )

    @property
    def names(self) -> tuple[str, ...]:
        return self.motion.names

    @property
    def kind_names(self) -> tuple[str, ...]:
        return tuple(kind.name for kind in self.kinds)

    @cached_property
    def period(self) -> Floats:
        return np.array([ANGLES.get(name, math.inf) for name in self.names])

    @cached_property
    def _sensors(self) -> dict[str, Sensor]:
        return {sensor.name: sensor for sensor in self.sensors}

    @cached_property
    def _steps(self) -> Floats:
        rates = [kind.rates or (0.0,) * len(self.motion.extras) for kind in self.kinds]
        levels = [[mean for mean, _ in kind.extras] for kind in self.kinds]
        return np.array([(*kind.noise, *r, *m) for kind, r, m in zip(self.kinds, rates, levels, strict=True)])

    @cached_property
    def _lifetime(self) -> Floats:
        return np.array([kind.lifetime for kind in self.kinds])

    def sensor(self, scan: Scan) -> Sensor:
        """The sensor of a scan. Raises InputError where the model has none of its name."""
        if scan.sensor not in self._sensors:
            raise InputError(
                f"a scan at {scan.time} s is of sensor '{scan.sensor}', but the model has "
                f"{sorted(self._sensors)}; add it to the model's sensors"
            )
        return self._sensors[scan.sensor]

    def check(self, scan: Scan) -> None:
        """Raise InputError for a scan that cannot be used."""
        sensor, values = self.sensor(scan), np.asarray(scan.values)
        if values.ndim != 2 or values.shape[1] != len(sensor.names) or not np.isfinite(values).all():
            raise InputError(
                f"the scan of sensor '{scan.sensor}' at {scan.time} s has values of shape {values.shape}, finite: "
                f"{bool(np.isfinite(values).all())}; give finite numbers (M, {len(sensor.names)}): {sensor.names}"
            )
        if not math.isfinite(scan.time) or not np.isfinite(scan.pose).all():
            raise InputError(
                f"a scan of sensor '{scan.sensor}' has time {scan.time} and pose {scan.pose}; give numbers"
            )

    def move(self, kind: Ints, mean: Floats, seconds: float) -> Moved:
        size, num = len(self.names), len(kind)
        moved, slope = np.empty((num, size)), np.empty((num, size, size))
        noise = np.empty((num, noise_formula(self.motion).num_y))
        settings = np.empty((num, 1 + self._steps.shape[1]))
        settings[:, 0], settings[:, 1:] = seconds, self._steps[kind]
        move_formula(self.motion).compiled()(mean, settings, moved, slope)
        noise_formula(self.motion).compiled(jacobian=False)(mean, settings, noise)
        return Moved(moved, slope, noise.reshape(num, size, -1), np.exp(-seconds / self._lifetime[kind]))

    def view(self, scan: Scan, objects: Bernoullis, more: Components) -> View:
        sensor = self.sensor(scan)
        at = mounted(scan.pose, sensor.mount)
        states = np.concatenate([objects.components.mean, more.mean])
        num, size, d = len(states), len(self.names), len(sensor.names)
        own = np.array([sensor.settings(kind.name) for kind in self.kinds])
        measure, detect = sensor_formulas(self.motion, type(sensor), own.shape[1])  # type: ignore[arg-type]
        settings = np.empty((num, 3 + own.shape[1]))
        settings[:, :3], settings[:, 3:] = at, own[np.concatenate([objects.components.kind, more.kind])]
        predicted, slope, detection = np.empty((num, d)), np.empty((num, d, size)), np.empty((num, 1))
        measure.compiled()(states, settings, predicted, slope)
        detect.compiled(jacobian=False)(states, settings, detection)
        noise, values = sensor.covariance(scan), np.ascontiguousarray(scan.values, dtype=np.float64)
        one = len(noise) == 1
        sort = np.zeros(len(values), dtype=np.int64) if one else np.arange(len(values))
        clutter, feature = sensor.clutter_intensity(values), sensor.feature(scan, len(self.kinds))
        return View(predicted, slope, detection[:, 0], values, noise, sort, clutter, feature, sensor.period)

    def unseen(self, scan: Scan) -> Components:
        sensor, size = self.sensor(scan), len(self.names)
        if not sensor.births or not len(scan.values):
            return no_components(size, len(scan.values))
        covariance = sensor.covariance(scan)
        covariance = np.broadcast_to(covariance, (len(scan.values), *covariance.shape[1:]))
        placed = sensor.place(scan.values, covariance, mounted(scan.pose, sensor.mount))
        flat = FLAT**2 * placed.covariance
        # a density of objects, as far as a normal one of this width is flat at its middle
        number = self.unseen_density * 2 * math.pi * np.sqrt(np.linalg.det(flat))
        return self._newcomers(number, placed.position, flat, placed.heading, placed.heading_std)

    def arrivals(self, seconds: float) -> Bernoullis:
        if not self.places:
            return no_objects(len(self.names))
        position = np.array([place.position for place in self.places])
        covariance = np.array([place.std**2 * np.eye(2) for place in self.places])
        existence = -np.expm1([-place.rate * seconds for place in self.places])
        groups = [
            self._newcomers(
                np.ones(1),
                position[i : i + 1],
                covariance[i : i + 1],
                None if place.heading is None else np.array([[place.heading[0]]]),
                0.5 if place.heading is None else place.heading[1],
            )
            for i, place in enumerate(self.places)
        ]
        return Bernoullis(np.zeros(len(self.places), dtype=np.int64), existence, _joined(groups))

    def _newcomers(
        self, number: Floats, position: Floats, covariance: Floats, heading: Floats | None, heading_std: float
    ) -> Components:
        """B groups of components: every kind at every heading, weights summing to number (B,)."""
        motion, num, first = self.motion, len(number), _headings(self.motion)
        if first and heading is None:
            heading = np.broadcast_to(np.arange(HEADINGS) * (2 * math.pi / HEADINGS), (num, HEADINGS))
        per = heading.shape[1] if first and heading is not None else 1
        size, count = len(self.names), per * len(self.kinds)
        mean, spread = np.zeros((num, len(self.kinds), per, size)), np.zeros((num, len(self.kinds), per, size, size))
        mean[..., :2], spread[..., :2, :2] = position[:, None, None], covariance[:, None, None]
        weight = np.empty((num, len(self.kinds), per))
        for k, kind in enumerate(self.kinds):
            loc, std = _state_prior(motion, kind, heading_std)
            mean[:, k, :, 2:] = loc[2:]
            spread[:, k, :, range(2, size), range(2, size)] = np.square(std[2:])[:, None, None]
            weight[:, k] = (number * kind.share / per)[:, None]
        if first:
            mean[..., self.names.index("heading")] = heading[:, None]  # type: ignore[index]
        index = np.tile(np.repeat(np.arange(len(self.kinds)), per), num)
        offset = count * np.arange(num + 1)
        return Components(offset, weight.ravel(), index, mean.reshape(-1, size), spread.reshape(-1, size, size))


def _headings(motion: Motion) -> bool:
    return "heading" in motion.names


@lru_cache
def _state_prior(motion: Motion, kind: Kind, heading_std: float) -> tuple[Floats, Floats]:
    """Mean and standard deviation (n,) of a new object's state; those of its position are not used."""
    known = {"yaw_rate": (0.0, kind.yaw_rate_std), "acceleration": (0.0, kind.acceleration_std), "speed": kind.speed}
    known |= dict(zip(motion.extras, kind.extras, strict=True)) | {"heading": (0.0, heading_std)}
    drift = math.hypot(*kind.speed)  # of vx and vy where no heading tells which way
    known |= {"x": (0.0, 0.0), "y": (0.0, 0.0), "vx": (0.0, drift), "vy": (0.0, drift)}
    loc, std = zip(*(known[name] for name in motion.names), strict=True)
    return np.array(loc), np.array(std)


def _joined(groups: Sequence[Components]) -> Components:
    offset = np.cumsum([0, *(len(group.weight) for group in groups)])
    parts = (np.concatenate([group[i] for group in groups]) for i in range(1, 5))
    return Components(offset, *parts)


@lru_cache
def sensor_formulas(motion: Motion, sensor: type[Sensor], num_settings: int) -> tuple[Formula, Formula]:
    """h: (state; pose of the sensor) -> (d,), and p_D: (state; pose, settings) -> ()."""
    label, size = sensor.__name__.lower(), len(motion.names)

    def measure(x: Scalars, p: Scalars, ops: Any) -> Scalars:
        return sensor.measure(motion.body(x, ops), p[:3], p[3:], ops)

    def detect(x: Scalars, p: Scalars, ops: Any) -> Scalars:
        return (sensor.detect(motion.body(x, ops), p[:3], p[3:], ops),)

    return Formula(f"{label}_measure", measure, size, 3 + num_settings), Formula(f"{label}_detect", detect, size, 3 + num_settings)
