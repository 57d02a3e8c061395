"""A scene to be driven in: the map, the route, lights, and road users that move by plan, by record, or by reacting.

A scenario of `python -m experiments.drive` is any callable that returns a `DriveScene`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from planning.frenet import Pose
from planning.reference import ReferenceLine
from planning.road import Lanes, StopPoint, Tracks
from planning.scene import BACKWARDS

Floats = NDArray[np.float64]
CAR = (4.6, 1.9)  # length, width [m]
BESIDE = 1.6  # how far to the side of one's way somebody is not ahead [m]


class Body(NamedTuple):
    """A road user as others see it: where its middle is, and its length and width [m]."""

    pose: Pose
    size: tuple[float, float]


def _check_start(who: str, start: float) -> None:
    if not math.isfinite(start):
        raise InputError(f"{who}: start is {start}, but must be finite")


def _check_size(who: str, size: tuple[float, float]) -> None:
    if len(size) != 2 or not all(0 < side < math.inf for side in size):
        raise InputError(f"{who}: its size is {size}, but must be length and width, positive and finite [m]")


class Actor(Protocol):
    """A road user of a scene.

    moved(time, before, others) is its middle at a time [s], None while it is not there; `before` is what it was a step
    earlier and `others`, the ego vehicle among them, what they are then."""

    @property
    def kind(self) -> str: ...
    @property
    def size(self) -> tuple[float, float]: ...

    def moved(self, time: float, step: float, before: Pose | None, others: Sequence[Body]) -> Pose | None: ...


@dataclass(frozen=True)
class Scripted:
    """Along a line by plan.

    start   arc length at time 0 [m]
    speed   ((t, v), ...) [s, m/s], linear in between and constant beyond
    offset  ((t, d), ...) [s, m] to the left of the line, smooth in between (d' = d'' = 0 at each)
    there   (from, until) [s]

    Raises InputError for numbers that are not finite, times that do not rise, speeds below 0 and sizes that are none.
    """

    line: ReferenceLine
    start: float
    speed: tuple[tuple[float, float], ...]
    offset: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    kind: str = "car"
    size: tuple[float, float] = CAR
    there: tuple[float, float] = (0.0, math.inf)

    def __post_init__(self) -> None:
        _check_start("a scripted road user", self.start)
        for name, told in (("speed", self.speed), ("offset", self.offset)):
            table = np.asarray(told, float)
            if table.ndim != 2 or table.shape[1] != 2 or not np.isfinite(table).all():
                raise InputError(f"a scripted road user: {name} is {told}, but must be ((time, value), ...), finite")
            if not (np.diff(table[:, 0]) > 0).all():
                raise InputError(f"a scripted road user: the times of its {name} must rise, but are {table[:, 0]}")
        for _, v in self.speed:
            if v < 0:
                raise InputError(f"a scripted road user: its speed is {v} m/s; give it a line that runs the other way")
        _check_size("a scripted road user", self.size)

    def moved(self, time: float, step: float, before: Pose | None, others: Sequence[Body]) -> Pose | None:
        """At a time, whatever others do."""
        if not self.there[0] <= time <= self.there[1]:
            return None
        s, v, a = self._along(time)
        if not 0.0 <= s <= self.line.length:
            return None
        d, dd = self._across(time)
        x, y, theta, kappa, _ = map(float, self.line.at(s))
        ahead = v * (1.0 - kappa * d)
        turned = math.atan2(dd, ahead) if ahead > 0.0 else 0.0
        return Pose(
            x - d * math.sin(theta),
            y + d * math.cos(theta),
            theta + turned,
            math.hypot(ahead, dd),
            a * math.cos(turned),
        )

    def _along(self, time: float) -> tuple[float, float, float]:
        """s, s', s''."""
        t, v = np.array(self.speed, float).T
        knots = np.union1d(np.clip(t, 0.0, time), [0.0, time])
        pace = np.interp(knots, t, v)
        later = np.interp(time + 1e-6, t, v)
        s = self.start + float(np.sum(np.diff(knots) * (pace[1:] + pace[:-1]) / 2))
        return s, float(pace[-1]), float(later - pace[-1]) / 1e-6

    def _across(self, time: float) -> tuple[float, float]:
        """d, d': u^3 (10 - 15 u + 6 u^2) of the way from one offset to the next."""
        t, d = np.array(self.offset, float).T
        k = int(np.searchsorted(t, time, "right"))
        if k in (0, len(t)):
            return float(d[min(k, len(t) - 1)]), 0.0
        long = float(t[k] - t[k - 1])
        u, change = (time - float(t[k - 1])) / long, float(d[k] - d[k - 1])
        return float(d[k - 1]) + change * u**3 * (10 - 15 * u + 6 * u**2), change * 30 * u**2 * (1 - u) ** 2 / long


@dataclass(frozen=True)
class Recorded:
    """As recorded: poses (K, 5) x, y, heading, speed, acceleration at times (K,); not there before and after."""

    time: Floats
    poses: Floats
    kind: str = "car"
    size: tuple[float, float] = CAR

    def __post_init__(self) -> None:
        if np.shape(self.poses) != (len(self.time), 5) or not np.isfinite(self.poses).all():
            raise InputError(f"a record of {len(self.time)} times needs ({len(self.time)}, 5) finite poses")
        if not len(self.time) or not (np.diff(self.time) > 0).all():
            raise InputError("the times of a record must rise")
        _check_size("a recorded road user", self.size)

    def moved(self, time: float, step: float, before: Pose | None, others: Sequence[Body]) -> Pose | None:
        """At a time, whatever others do."""
        if not self.time[0] - 1e-9 <= time <= self.time[-1] + 1e-9:
            return None
        heading = np.unwrap(self.poses[:, 2])
        x, y, v, a = (float(np.interp(time, self.time, self.poses[:, k])) for k in (0, 1, 3, 4))
        return Pose(x, y, float(np.interp(time, self.time, heading)), v, a)


@dataclass(frozen=True)
class Reacting:
    """Along a line by the intelligent driver model (Treiber et al. 2000), behind whoever is ahead on it:

        a = a_max (1 - (v / v_wanted)^4 - (g* / g)^2),   g* = g_0 + v T + v dv / (2 sqrt(a_max b))

    start, speed   arc length [m] and speed [m/s] at time 0
    wanted         [m/s]; headway T [s], gap g_0 [m], acceleration a_max and braking b [m/s^2]

    Raises InputError for numbers that are not finite, or not positive where they must be.
    """

    line: ReferenceLine
    start: float
    speed: float
    wanted: float
    headway: float = 1.2
    gap: float = 2.0
    acceleration: float = 1.5
    braking: float = 2.0
    kind: str = "car"
    size: tuple[float, float] = CAR

    def __post_init__(self) -> None:
        who = "a reacting road user"
        _check_start(who, self.start)
        for name in ("wanted", "acceleration", "braking"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{who}: {name} is {getattr(self, name)}, but must be positive and finite")
        for name in ("speed", "headway", "gap"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{who}: {name} is {getattr(self, name)}, but must be 0 or more and finite")
        _check_size(who, self.size)

    def moved(self, time: float, step: float, before: Pose | None, others: Sequence[Body]) -> Pose | None:
        """A step after `before`."""
        if before is None:
            return self._at(self.start, self.speed, 0.0) if time == 0.0 else None
        places = np.array([[before.x, before.y], *([b.pose.x, b.pose.y] for b in others)])
        told, ended = self.line.project(places)
        s, a = float(told[0, 0]), 1.0 - (before.speed / self.wanted) ** 4
        for body, (place, beside), lost in zip(others, told[1:], ended[1:], strict=True):
            if lost or abs(beside) > BESIDE or place <= s:
                continue
            gap = max(place - s - (body.size[0] + self.size[0]) / 2, 0.1)
            closing = before.speed - body.pose.speed * math.cos(body.pose.heading - before.heading)
            wanted = before.speed * (self.headway + closing / (2 * math.sqrt(self.acceleration * self.braking)))
            a = min(a, 1.0 - (before.speed / self.wanted) ** 4 - ((self.gap + max(wanted, 0.0)) / gap) ** 2)
        v = max(before.speed + max(self.acceleration * a, -8.0) * step, 0.0)
        return self._at(s + (before.speed + v) / 2 * step, v, (v - before.speed) / step)

    def _at(self, s: float, v: float, a: float) -> Pose | None:
        if s > self.line.length:
            return None
        x, y, theta = map(float, self.line.at(s)[:3])
        return Pose(x, y, theta, v, a)


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is seen of road users: position [m], heading [rad], speed [m/s], acceleration."""

    position: float = 0.0
    heading: float = 0.0
    speed: float = 0.0
    acceleration: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"noise: {name} is {getattr(self, name)}, but must be 0 or more and finite")


class DriveScene(NamedTuple):
    """One scene to drive in.

    lanes     of the map
    route     ids of the lanes to drive along
    stops     virtual stopping points, their s on the route
    lights    {name of a stop point: ((from, state), ...)}, times rising from 0 [s]; "green", "yellow" or "red"
    actors    the other road users
    boundary  lines (N, 2) that must not be touched [m]
    ego       the vehicle at time 0: its rear axle
    duration  [s]
    noise     of the tracks that are made of the actors
    info      plain numbers and strings for the manifest
    wanted    speed to drive at where limits, curves and others allow it [m/s]
    """

    name: str
    lanes: Lanes
    route: tuple[int, ...]
    stops: tuple[StopPoint, ...]
    lights: Mapping[str, tuple[tuple[float, str], ...]]
    actors: tuple[Actor, ...]
    boundary: tuple[Floats, ...]
    ego: Pose
    duration: float
    noise: Noise = Noise()
    info: Mapping[str, Any] = MappingProxyType({})
    wanted: float = math.inf

    def lights_at(self, time: float) -> dict[str, str]:
        """{name of a stop point: state of its light}"""
        return {name: [state for since, state in told if since <= time][-1] for name, told in self.lights.items()}


LIGHTS = ("green", "yellow", "red")


def check(scene: DriveScene) -> None:
    """Raises InputError for a scene that is none to drive in, with the part, its value and what it must be: how the
    vehicle stands on the map, the route and road users are judged where they are used."""
    where = f"scene {scene.name}"
    if not scene.ego.speed >= -BACKWARDS:
        raise InputError(f"{where}: the vehicle's speed is {scene.ego.speed} m/s, but must be 0 or more")
    if not scene.wanted > 0.0:
        raise InputError(f"{where}: the speed wanted is {scene.wanted} m/s, but must be positive; infinity means any")
    for number, actor in enumerate(scene.actors):
        if not hasattr(actor, "moved"):
            raise InputError(f"{where}: road user {number} is a {type(actor).__name__}, which does not move; see Actor")
    for point in scene.stops:
        zone = np.asarray(point.zone)
        if not -math.inf < point.s <= point.end < math.inf:
            raise InputError(
                f"{where}: stop point {point.name} is from {point.s} to {point.end} m; end no sooner than s"
            )
        if zone.ndim != 2 or zone.shape[1] != 2 or len(zone) < 3 or not np.isfinite(zone).all():
            raise InputError(
                f"{where}: the zone of stop point {point.name} has shape {zone.shape}; give (N, 2) corners"
            )
    names = [point.name for point in scene.stops]
    for name, told in scene.lights.items():
        if name not in names:
            raise InputError(f"{where}: the light {name!r} is of no stop point; there are {names}")
        times = [since for since, _ in told]
        if not times or times[0] > 0 or not (np.diff(times) > 0).all():
            raise InputError(f"{where}: the light {name!r} changes at {times} s; give rising times from 0 on")
        for _, state in told:
            if state not in LIGHTS:
                raise InputError(
                    f"{where}: the light {name!r} is {state!r} once, but must be one of {', '.join(LIGHTS)}"
                )


def observe(scene: DriveScene, poses: Sequence[Pose | None], rng: np.random.Generator) -> Tracks:
    """Tracks of those actors that are there, with the scene's noise; always as many numbers are drawn."""
    noise = scene.noise
    std = np.array([noise.position, noise.position, noise.heading, noise.speed, noise.acceleration])
    errors = rng.normal(size=(len(poses), 5)) * std
    here = [k for k, pose in enumerate(poses) if pose is not None]
    told = np.array([poses[k][:5] for k in here]).reshape(-1, 5) + errors[here]  # type: ignore[index]
    return Tracks(
        label=np.array(here, np.int64),
        kind=np.array([scene.actors[k].kind for k in here], np.str_),
        position=told[:, :2],
        covariance=np.broadcast_to(np.eye(2) * noise.position**2, (len(here), 2, 2)).copy(),
        heading=told[:, 2],
        speed=np.maximum(told[:, 3], 0.0),
        acceleration=told[:, 4],
        speed_std=np.full(len(here), noise.speed),
        size=np.array([scene.actors[k].size for k in here], float).reshape(-1, 2),
        existence=np.ones(len(here)),
    )
