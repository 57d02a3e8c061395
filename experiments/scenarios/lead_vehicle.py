"""A winding rural road: a car ahead, 30 to 100 m away, oncoming traffic, and a car that knows its own pose roughly.

[K15], section V-A, measures the distance to the leading vehicle with a reference system. Here road, speeds and
distances are ours: the road is a sine of 20 m and 500 m, the distance another in time, and all vehicles follow their
lanes exactly.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios import paths
from experiments.scenarios.moving_objects import World, in_view, see, truth_of
from experiments.scenarios.scene import Scene
from experiments.scenarios.urban_sensors import STEP, SUITE, ticks_of
from models.objects.motion import ConstantTurn
from models.objects.scans import Recording
from models.objects.sensors import Sensor
from models.objects.traffic import Traffic
from models.program import InputError

Floats = NDArray[np.float64]
LEAD = 0  # its label in the truth
SPEED = 14.0  # of the car [m/s]
DISTANCE, SWING, PERIOD = 65.0, 35.0, 9.0  # along the road to the one ahead: mean, amplitude [m], and time a radian [s]
HEIGHT, LENGTH = 20.0, 80.0  # of the road: amplitude [m], and way a radian [m]
ASIDE = 3.5  # from lane to lane [m]
ONCOMING = (8.0, 15.0)  # speeds [m/s]
GAPS = (60.0, 250.0)  # between oncoming vehicles [m]
CAR = (4.5, 1.8)  # length and width [m]
POSE_STD = (0.05, 0.05, math.radians(0.1))  # x, y [m], heading [rad]
LASER_STD = (0.2, math.radians(0.2))  # worse than in a city: few points at 100 m
WITH = {"all": ("radar", "laser", "camera"), "radar_laser": ("radar", "laser"), "radar_camera": ("radar", "camera")}
WITH |= {"radar": ("radar",)}


def lead_vehicle(
    seed: int = 0,
    duration: float = 60.0,
    sensors: Literal["all", "radar_laser", "radar_camera", "radar"] = "all",
    pose_noise: float = 0.0,
    oncoming: bool = True,
) -> Scene:
    """Scans of the sensors in order of time; the truth is that of vehicles in view of one of them, 0 the one ahead.

    duration    [s]
    sensors     that the car has
    pose_noise  of the poses that go with scans, independent from scan to scan, in units of 5 cm and 0.1 degrees
    oncoming    whether vehicles come the other way, 60 to 250 m behind each other

    Raises InputError for a negative seed or noise, and for durations that are not 0.1 to 600 s."""
    if seed < 0 or not 0.1 <= duration <= 600.0 or not 0.0 <= pose_noise < math.inf:
        raise InputError(
            f"scenario lead_vehicle: seed is {seed}, duration {duration} and pose_noise {pose_noise}; "
            "give seed >= 0, 0.1 to 600 s, and pose_noise >= 0"
        )
    own = tuple(_worse(s) for s in SUITE if s.name in WITH[sensors])
    way_seed, pose_seed, *scan_seeds = np.random.SeedSequence(seed).spawn(2 + len(SUITE))
    clocks = {s.name: ticks_of(s.name, duration) for s in own}
    ticks = np.unique(np.concatenate(list(clocks.values())))
    pose, world = drive(STEP * ticks, oncoming, np.random.default_rng(way_seed))
    rng = np.random.default_rng(pose_seed)
    noise = pose_noise * np.array(POSE_STD) * rng.standard_normal((sum(map(len, clocks.values())), 3))
    model, scans = Traffic(own, ConstantTurn()), list[tuple[int, int]]()
    for i, name in enumerate(clocks):
        scans += [(int(tick), i) for tick in clocks[name]]
    rngs = [np.random.default_rng(s) for s, sensor in zip(scan_seeds, SUITE, strict=True) if sensor.name in clocks]
    found = []
    for (tick, i), off in zip(sorted(scans), noise, strict=True):
        t = int(np.searchsorted(ticks, tick))
        scan, _ = see(model, own[i].name, world, t, pose[t], rngs[i])
        found.append(scan._replace(pose=pose[t] + off))
    told = in_view(own, model.motion, world, pose)
    info = {"scenario": "lead_vehicle", "seed": seed, "duration_s": duration, "sensors": sensors}
    info |= {"pose_noise": pose_noise, "oncoming": world.state.shape[1] - 1, "scans": len(found)}
    return Scene(Recording(tuple(found)), truth_of(world, model.motion, told), f"lead_vehicle {seed}", info)


def _worse(sensor: Sensor) -> Sensor:
    return replace(sensor, noise_std=LASER_STD) if sensor.name == "laser" else sensor


def drive(time: Floats, oncoming: bool, rng: np.random.Generator) -> tuple[Floats, World]:
    """Poses (T, 3) of the car, and the others, the one ahead first."""
    reach = time[-1] * (SPEED + ONCOMING[1]) + 300.0
    met = np.cumsum(rng.uniform(*GAPS, math.ceil(reach / GAPS[0])))
    met = met[met < reach] if oncoming else np.zeros(0)
    pace = np.append(0.0, rng.uniform(*ONCOMING, len(met)))
    first = np.arange(len(pace)) == LEAD
    arc = np.append(DISTANCE, met) - pace * time[:, None]
    arc[:, LEAD] += SPEED * time + SWING * np.sin(time / PERIOD)
    speed = pace + first * (SPEED + SWING / PERIOD * np.cos(time / PERIOD))[:, None]
    push = first * (-SWING / PERIOD**2 * np.sin(time / PERIOD))[:, None]
    course = road(min(0.0, float(arc.min())) - 1.0, float(arc.max()) + 1.0)
    state = np.stack([lane(course, arc[:, i], speed[:, i], push[:, i], i != LEAD) for i in range(arc.shape[1])], 1)
    me = lane(course, SPEED * time, np.full_like(time, SPEED), np.zeros_like(time), False)
    num = state.shape[1]
    return me[:, :3], World(time, state, np.zeros(num, dtype=np.int64), np.tile(CAR, (num, 1)))


def road(begin: float, end: float) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Arc length from x = 0, x, y, heading and curvature of the middle of the car's lane, from begin to end at
    least."""
    x = np.arange(min(begin, 0.0), end, 0.05)
    slope = HEIGHT / LENGTH * np.cos(x / LENGTH)
    bend = -HEIGHT / LENGTH**2 * np.sin(x / LENGTH)
    y = HEIGHT * np.sin(x / LENGTH)
    arc = paths.arc_length(np.stack([x, y], -1))
    arc -= np.interp(0.0, x, arc)
    return arc, x, y, np.arctan(slope), bend / (1.0 + slope**2) ** 1.5


def lane(course: tuple[Floats, ...], at: Floats, speed: Floats, push: Floats, oncoming: bool) -> Floats:
    """(T, 6) states at arc lengths (T,), driven at a speed along the road and with an acceleration; oncoming vehicles
    are in the lane to the left, and turn the other way."""
    arc, x, y, heading, curvature = (np.interp(at, course[0], column) for column in course)
    del arc
    aside = ASIDE * oncoming
    stretch = 1.0 - aside * curvature  # of the way in a lane to the left
    return np.stack(
        [
            x - aside * np.sin(heading),
            y + aside * np.cos(heading),
            heading + math.pi * oncoming,
            speed * stretch,
            curvature * speed * (-1.0 if oncoming else 1.0),
            push * stretch,
        ],
        -1,
    )
