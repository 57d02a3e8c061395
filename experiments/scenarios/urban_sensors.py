"""Cars, bicycles and pedestrians around a car that waits in a city, seen by a radar, a laser and a camera.

Each sensor has a clock of its own. The road users are no draws of the model: they steer and accelerate by
Ornstein-Uhlenbeck processes, drift back to the speed of their kind, and turn round where they would leave the place,
with other noise than any filter assumes. Nothing hides one behind another, unless the laser's beams are simulated.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.laser_beams import Laser, sweep
from experiments.scenarios.laser_boxes import boxes
from experiments.scenarios.laser_outlines import outlines as outlines_of
from experiments.scenarios.moving_objects import World, in_view, see, truth_of
from experiments.scenarios.paths import wrap
from experiments.scenarios.scene import Scene
from models.objects.motion import ConstantTurn
from models.objects.scans import Recording, Scan
from models.objects.sensors import Radar, RangeBearing, Sensor
from models.objects.traffic import Kind, Traffic
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
STEP = 0.01  # of the clock on which everything happens [s]
PLACE = (5.0, 180.0, 95.0)  # where road users keep to: x from, x to, |y| up to, from the car [m]
TURN = 0.4  # the most that they turn back with [rad/s]
PULL = 0.02  # back to the usual speed of a kind [1/s^2]
BAD_WEATHER = 0.9  # the mass it gives to the camera's not detecting: of .85, .36 is left


class Habit(NamedTuple):
    """How road users of a kind are: share of all, speed from, to, and at most [m/s], noise of yaw rate [rad/s^1.5] and
    acceleration [m/s^2.5], length and width [m] and the spread of both."""

    share: float
    slow: float
    fast: float
    most: float
    turn: float
    push: float
    size: tuple[float, float]
    spread: tuple[float, float]


HABITS = {
    "car": Habit(0.6, 3.0, 15.0, 20.0, 0.02, 0.3, (4.5, 1.8), (0.3, 0.1)),
    "bicycle": Habit(0.2, 2.0, 7.0, 10.0, 0.05, 0.2, (1.8, 0.6), (0.1, 0.05)),
    "pedestrian": Habit(0.2, 0.7, 1.8, 2.5, 0.15, 0.1, (0.5, 0.5), (0.05, 0.05)),
}
FRONT = (3.5, 0.0, 0.0)
SUITE: tuple[Sensor, ...] = (
    Radar(
        name="radar",
        mount=FRONT,
        angle=math.radians(60.0),
        noise_std=(0.3, math.radians(1.0), 0.15),
        detection=0.9,
        clutter=10.0,
    ),
    RangeBearing(
        name="laser", mount=FRONT, angle=math.radians(210.0), noise_std=(0.1, math.radians(0.15)), clutter=10.0
    ),
    RangeBearing(
        name="camera",
        mount=(1.5, 0.0, 0.0),
        angle=math.radians(56.0),
        reach=(0.0, 120.0),
        noise_std=(4.0, math.radians(0.15)),
        detection=0.85,
        clutter=5.0,
        births=False,
    ),
)
CLOCK = {"radar": (0.0, 0.07), "laser": (0.02, 0.08), "camera": (0.03, 0.07)}  # first scan, and time between two [s]
LASER = Laser()
CONFUSED = 0.05  # probability that the camera takes a road user for one of each other kind


def urban_sensors(
    seed: int = 0,
    number: int = 20,
    duration: float = 10.0,
    kinds: tuple[str, ...] = ("car", "bicycle", "pedestrian"),
    sensors: tuple[str, ...] = ("radar", "laser", "camera"),
    dropout: str | None = None,
    dropout_from: float = 4.0,
    dropout_to: float = 7.0,
    bad_weather: bool = False,
    latency: float = 0.0,
    raw_laser: bool = False,
    outlines: bool = False,
) -> Scene:
    """Scans of the sensors in order of arrival; the truth is that of the road users in view of one of them.

    number       of road users
    duration     [s]
    kinds        of which there are some, in the order of the model's kinds
    sensors      that the car has
    dropout      a sensor that says nothing from `dropout_from` to `dropout_to` [s]
    bad_weather  the camera detects .36 of what it sees, not .85
    latency      of the camera's scans [s]: they arrive so much after they were taken, other sensors' at once
    raw_laser    simulate the laser's beams on rectangles that hide each other, and send the middles of fitted boxes
    outlines     simulate them, and send what they show of each rectangle (models.objects.outline)

    Raises InputError for numbers out of range and names that are not known."""
    _check(seed, number, duration, kinds, sensors, dropout, dropout_from, dropout_to, latency)
    way_seed, *scan_seeds = np.random.SeedSequence(seed).spawn(1 + len(SUITE))
    clocks = {s.name: ticks_of(s.name, duration) for s in SUITE if s.name in sensors}
    ticks = np.unique(np.concatenate(list(clocks.values())))
    world = road_users(ticks, number, kinds, np.random.default_rng(way_seed))
    model = traffic(kinds, sensors, bad_weather)
    pose, scans, arrival = np.zeros(3), list[Scan](), list[float]()
    for sensor, own_seed in zip(SUITE, scan_seeds, strict=True):
        rng = np.random.default_rng(own_seed)
        for tick in clocks.get(sensor.name, ()):
            t, when = int(np.searchsorted(ticks, tick)), tick * STEP
            if sensor.name == "laser" and (raw_laser or outlines):
                scan = beams(sensor, world, t, rng, outlines)
            else:
                scan, _ = see(model, sensor.name, world, t, pose, rng)
            if sensor.name != dropout or not dropout_from <= when < dropout_to:
                scans.append(scan)
                arrival.append(when + latency * (sensor.name == "camera"))
    order = np.lexsort(np.array([[scan.time for scan in scans], arrival]))
    told = in_view(suite(kinds, sensors), model.motion, world, np.zeros((len(ticks), 3)))
    info = {"scenario": "urban_sensors", "seed": seed, "number": number, "duration_s": duration}
    info |= {"kinds": ", ".join(kinds), "sensors": ", ".join(sensors), "dropout": dropout or "none"}
    info |= {"bad_weather": bad_weather, "latency_s": latency, "raw_laser": raw_laser, "outlines": outlines}
    info |= {"scans": len(scans)}
    info |= {f"{kind}s": int((world.kind == k).sum()) for k, kind in enumerate(kinds)}
    data = Recording(tuple(scans[i] for i in order))
    return Scene(data, truth_of(world, model.motion, told), f"urban_sensors {seed}", info)


def _check(
    seed: int,
    number: int,
    duration: float,
    kinds: tuple[str, ...],
    sensors: tuple[str, ...],
    dropout: str | None,
    dropout_from: float,
    dropout_to: float,
    latency: float,
) -> None:
    if seed < 0 or number < 1 or not 0.1 <= duration <= 600.0:
        raise InputError(
            f"scenario urban_sensors: seed is {seed}, number {number} and duration {duration}; "
            "give seed >= 0, one road user or more, and 0.1 to 600 s"
        )
    for what, names, known in (("kinds", kinds, HABITS), ("sensors", sensors, CLOCK)):
        if not names or len(set(names)) < len(names) or not set(names) <= set(known):
            raise InputError(
                f"scenario urban_sensors: {what} are {list(names)}; choose some of {list(known)}, each once"
            )
    if dropout is not None and (dropout not in sensors or not dropout_from < dropout_to):
        raise InputError(
            f"scenario urban_sensors: {dropout} drops out from {dropout_from} to {dropout_to} s; "
            f"name one of {list(sensors)}, and a time that ends after it begins"
        )
    if not 0.0 <= latency < math.inf:
        raise InputError(f"scenario urban_sensors: latency is {latency} s; give 0 or more")


def ticks_of(sensor: str, duration: float) -> Ints:
    """When it scans, in steps of the clock."""
    first, period = (round(value / STEP) for value in CLOCK[sensor])
    return np.arange(first, round(duration / STEP) + 1, period)


def road_users(ticks: Ints, number: int, kinds: tuple[str, ...], rng: np.random.Generator) -> World:
    """They are there all the time; states x, y, heading, speed, yaw rate, acceleration."""
    share = np.array([HABITS[kind].share for kind in kinds])
    kind = rng.choice(len(kinds), number, p=share / share.sum())
    habit = [HABITS[kinds[k]] for k in kind]
    slow, fast, most, turn, push = np.array([h[1:6] for h in habit]).T
    usual = 0.5 * (slow + fast)
    size = np.array([h.size for h in habit]) + np.array([h.spread for h in habit]) * rng.standard_normal((number, 2))
    near, far, side = PLACE
    x, y = rng.uniform(near, far, number), rng.uniform(-side, side, number)
    heading, speed = rng.uniform(-math.pi, math.pi, number), rng.uniform(slow, fast)
    rate, pace = turn * rng.standard_normal(number), np.zeros(number)
    told, wanted = np.empty((len(ticks), number, 6)), {int(tick): i for i, tick in enumerate(ticks)}
    for tick in range(int(ticks[-1]) + 1):
        if tick in wanted:
            told[wanted[tick]] = np.stack([x, y, heading, speed, rate, pace], -1)
        home = wrap(np.arctan2(-y, 0.5 * (near + far) - x) - heading)
        leaving = (x < near) | (x > far) | (np.abs(y) > side)
        rate += STEP * (5.0 * (np.clip(home, -TURN, TURN) - rate) * leaving - 0.5 * rate)
        rate += math.sqrt(STEP) * turn * rng.standard_normal(number)
        pace += STEP * (PULL * (usual - speed) - 0.5 * pace) + math.sqrt(STEP) * push * rng.standard_normal(number)
        ahead = np.clip(speed + STEP * pace, 0.3, most)
        pace = (ahead - speed) / STEP  # none where the limit holds it
        middle, way = heading + 0.5 * STEP * rate, 0.5 * STEP * (speed + ahead)
        x, y, heading, speed = x + way * np.cos(middle), y + way * np.sin(middle), heading + STEP * rate, ahead
    return World(np.asarray(STEP * ticks, dtype=np.float64), told, kind.astype(np.int64), size)


def suite(kinds: tuple[str, ...], sensors: tuple[str, ...]) -> tuple[Sensor, ...]:
    """The sensors of these names; the camera takes a road user for each other kind with probability `CONFUSED`, and a
    false alarm for any."""
    num = len(kinds)
    right = (1.0 - CONFUSED * num) * np.eye(num) + CONFUSED
    table = tuple(tuple(row) for row in [*right.tolist(), [1.0 / num] * num]) if num > 1 else None
    return tuple(replace(s, confusion=table) if s.name == "camera" else s for s in SUITE if s.name in sensors)


def traffic(
    kinds: tuple[str, ...] = tuple(HABITS), sensors: tuple[str, ...] = tuple(CLOCK), bad_weather: bool = False
) -> Traffic:
    """The model that scans are simulated by; in bad weather the camera misses more."""
    own = (replace(s, weather=BAD_WEATHER) if bad_weather and s.name == "camera" else s for s in suite(kinds, sensors))
    return Traffic(tuple(own), ConstantTurn(), tuple(Kind(name=kind, share=1 / len(kinds)) for kind in kinds))


def beams(sensor: Sensor, world: World, t: int, rng: np.random.Generator, outlines: bool) -> Scan:
    """A scan of the middles of boxes, fitted to the points where beams end, or of outlines."""
    there = world.present(t)
    rectangles = np.concatenate([world.state[t, there, :3], world.size[there]], -1)
    points = sweep(LASER, np.array(sensor.mount), sensor.angle, sensor.reach[1], rectangles, rng)
    found = outlines_of(points, LASER) if outlines else boxes(points, LASER)
    return Scan(sensor.name, float(world.time[t]), found.values, np.zeros(3), noise=found.noise)
