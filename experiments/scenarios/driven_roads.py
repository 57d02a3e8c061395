"""Drives on made roads, each about one thing that a planner must get right.

follow       behind a car that brakes, drives on, and keeps its speed in the end
stop_line    a light that turns green, then one that does not
parked_car   half on the lane; the lane beside is driven the other way, and somebody may come along it
cut_in       a car changes into the own lane, shortly ahead
merge        from a ramp between cars that react
roundabout   entered once those on the ring have passed
box          walls ahead and beside, nearer than an ordinary stop: an emergency stop comes to rest in time
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.driving import CAR, Actor, DriveScene, Noise, Reacting, Scripted
from models.program import InputError
from planning.frenet import FrenetState, to_pose
from planning.reference import ReferenceLine, from_curvature, from_points
from planning.road import Lane, Lanes, StopPoint

Floats = NDArray[np.float64]
WIDTH = 3.5  # of lanes [m]
RING = 4.5  # of those of a roundabout, where a car needs more
LIMIT = 50 / 3.6  # of speed in town [m/s]


class Road(NamedTuple):
    """A road of two lanes: the own one around `line`, and one to its left."""

    line: ReferenceLine
    lanes: Lanes
    kerbs: tuple[Floats, ...]


def follow(*, noise: float = 0.0, duration: float = 30.0) -> DriveScene:
    """Behind a car; noise: standard deviation of its place and speed as they are seen [m, m/s]."""
    road = _road(500.0, bend=0.008)
    lead = Scripted(road.line, 55.0, ((0.0, 8.0), (6.0, 8.0), (9.0, 4.0), (13.0, 4.0), (16.0, 7.0)))
    return _drive("follow", road, (lead,), speed=10.0, duration=duration, noise=noise)


def stop_line(*, green: float = 14.0, duration: float = 45.0) -> DriveScene:
    """Two lights, 60 m and 180 m ahead: the first turns green at a time [s], the second stays red."""
    road = _road(400.0, bend=0.004)
    stops = tuple(_crossing(road.line, name, s) for name, s in (("first", 80.0), ("second", 200.0)))
    lights = {"first": ((0.0, "red"), (green, "green")), "second": ((0.0, "red"),)}
    return _drive("stop_line", road, (), speed=10.0, duration=duration, stops=stops, lights=lights)


def parked_car(*, oncoming: bool = True, noise: float = 0.0, duration: float = 30.0) -> DriveScene:
    """A parked car, with or without one that comes along the other lane."""
    road = _road(400.0, bend=0.004)
    parked = Scripted(road.line, 90.0, ((0.0, 0.0),), ((0.0, -0.9),))
    comes = Scripted(_backwards(road.line, WIDTH), 210.0, ((0.0, 10.0),))
    actors = (parked, comes) if oncoming else (parked,)
    return _drive("parked_car", road, actors, speed=10.0, duration=duration, noise=noise)


def cut_in(*, noise: float = 0.0, duration: float = 25.0) -> DriveScene:
    """A slower car from the left lane, a few metres ahead."""
    road = _road(500.0, bend=0.004, oncoming=False)
    cuts = Scripted(road.line, 40.0, ((0.0, 9.0), (6.0, 9.0), (9.0, 7.0)), ((2.0, WIDTH), (5.0, 0.0)))
    return _drive("cut_in", road, (cuts,), speed=11.0, duration=duration, noise=noise)


def merge(*, gap: float = 45.0, duration: float = 25.0) -> DriveScene:
    """From a ramp into a road with cars that drive `gap` metres apart and react to who is ahead of them."""
    if not gap > 2 * CAR[0]:
        raise InputError(f"merge: gap is {gap} m, but must be more than two cars, {2 * CAR[0]} m")
    s = np.arange(0.0, 601.0, 2.0)
    main = from_points(np.stack([s, np.zeros_like(s)], -1))
    u = np.clip((s - 160.0) / 80.0, 0.0, 1.0)  # of the way over from the ramp
    over = np.stack([s, 2 * WIDTH * (u**3 * (10 - 15 * u + 6 * u**2) - 1.0)], -1)
    ramp = from_points(over[s >= 80.0], std=0.01)
    joint = float(ramp.project([(230.0, 0.0)])[0][0, 0])
    lanes = {
        1: _lane(ramp, 0.0, joint, 0.0, successors=(2,)),
        2: _lane(ramp, joint, ramp.length, 0.0),
        3: _lane(main, 0.0, 230.0, 0.0, successors=(2,)),
    }
    cars = tuple(Reacting(main, 90.0 + k * gap, 9.0, 9.0) for k in range(-2, 3))
    kerbs = (_beside(main, WIDTH / 2), _beside(ramp, -WIDTH / 2))
    ego = to_pose(ramp, FrenetState(10.0, 9.0, 0.0, 0.0))
    return DriveScene("merge", lanes, (1, 2), (), {}, cars, kerbs, ego, duration, info={"gap_m": gap})


def roundabout(*, duration: float = 40.0) -> DriveScene:
    """Straight across a roundabout; two cars on the ring pass the entry, one after the other, before it is free."""
    radius, turn = 14.0, 12.0
    s = np.arange(0.0, 251.0, 1.0)
    line = from_curvature(s, _ring_curvature(s, radius, turn))
    middle = line.at(100.0)
    centre = middle[:2] + radius * np.array([-math.sin(middle[2]), math.cos(middle[2])])
    entry, leave = 78.0, 112.0
    angles = [float(np.arctan2(*(line.at(at)[:2] - centre)[::-1])) for at in (entry, leave)]
    before = _arc(centre, radius, angles[1] - 2 * math.pi, angles[0])
    whole = _arc(centre, radius, angles[0] - 1.5 * math.pi, angles[0] + 1.2 * math.pi)
    lanes = {
        1: _lane(line, 0.0, entry, 0.0, successors=(2,), width=RING),
        2: _lane(line, entry, leave, 0.0, successors=(3, 4), width=RING),
        3: _lane(line, leave, line.length, 0.0, width=RING),
        4: _lane(before, 0.0, before.length, 0.0, successors=(2,), width=RING),
    }
    reach = np.arange(before.length - 16.0, before.length, 1.0)
    zone = np.concatenate([before.place(reach, np.full(16, 1.5)), before.place(reach[::-1], np.full(16, -1.5))])
    stop = StopPoint("ring", "yield", 64.0, 84.0, zone)
    ring = tuple(Scripted(whole, at, ((0.0, 5.5),)) for at in (22.0, 8.0))
    inner = _arc(centre, radius - RING / 2, 0.0, 2 * math.pi - 0.01)
    kerbs = (inner.table[:, :2],)
    ego = to_pose(line, FrenetState(5.0, 9.0, 0.0, 0.0))
    return DriveScene("roundabout", lanes, (1, 2, 3), (stop,), {}, ring, kerbs, ego, duration)


def box(*, distance: float = 10.05, duration: float = 8.0) -> DriveScene:
    """Walls to both sides, and one ahead, `distance` metres before the front."""
    if not 0 < distance < math.inf:
        raise InputError(f"box: distance is {distance} m, but must be positive and finite")
    road = _road(200.0, bend=0.0)
    front = 20.0 + 3.85 + distance
    walls = (
        *(_beside(road.line, d, front + 1.0) for d in (-1.9, 1.9)),
        road.line.place([front, front], [-1.9, 1.9]),
    )
    scene = _drive("box", road, (), speed=10.0, duration=duration)
    return scene._replace(boundary=walls)


def _drive(
    name: str,
    road: Road,
    actors: tuple[Actor, ...],
    *,
    speed: float,
    duration: float,
    noise: float = 0.0,
    stops: tuple[StopPoint, ...] = (),
    lights: dict[str, tuple[tuple[float, str], ...]] | None = None,
) -> DriveScene:
    """Along the own lane of a road, from 20 m on."""
    seen = Noise(position=noise, speed=noise, heading=noise / 10)
    ego = to_pose(road.line, FrenetState(20.0, speed, 0.0, 0.0))
    return DriveScene(name, road.lanes, (1,), stops, lights or {}, actors, road.kerbs, ego, duration, seen)


def _road(length: float, *, bend: float, oncoming: bool = True) -> Road:
    """Bends to either side with curvatures up to `bend` [1/m]."""
    s = np.arange(0.0, length + 1.0, 2.0)
    line = from_curvature(s, bend * np.sin(s / 25))
    own, other = _lane(line, 0.0, line.length, 0.0), _lane(line, 0.0, line.length, WIDTH)
    if oncoming:
        other = other._replace(left=other.right[::-1], right=other.left[::-1], beside=(1, None), opposite=(True, False))
    else:
        other = other._replace(beside=(None, 1))
    own = own._replace(beside=(2, None), opposite=(oncoming, False))
    return Road(line, {1: own, 2: other}, (_beside(line, -WIDTH / 2), _beside(line, 1.5 * WIDTH)))


def _beside(line: ReferenceLine, d: float, until: float = math.inf) -> Floats:
    """Points of a line at an offset."""
    s = np.arange(0.0, min(line.length, until), 1.0)
    return line.place(s, np.full(len(s), d))


def _lane(
    line: ReferenceLine, start: float, end: float, d: float, *, successors: tuple[int, ...] = (), width: float = WIDTH
) -> Lane:
    """Along a line, its middle at an offset."""
    s = np.linspace(start, end, max(round(end - start), 3))
    left, right = (line.place(s, np.full(len(s), d + side * width / 2)) for side in (1, -1))
    return Lane(left, right, successors, speed=LIMIT)


def _crossing(line: ReferenceLine, name: str, s: float) -> StopPoint:
    """A light before a road across."""
    zone = line.place([s + 1, s + 9, s + 9, s + 1], [-4.0, -4.0, 4.0, 4.0])
    return StopPoint(name, "light", s, s + 10.0, zone)


def _backwards(line: ReferenceLine, d: float) -> ReferenceLine:
    """The line at an offset, driven the other way."""
    return from_points(_beside(line, d)[::-1], std=0.01)


def _arc(centre: Floats, radius: float, first: float, last: float) -> ReferenceLine:
    """A circle to the left between two angles."""
    s = np.linspace(0.0, radius * (last - first), 50)
    x, y = centre + radius * np.array([math.cos(first), math.sin(first)])
    return from_curvature(s, np.full(50, 1 / radius), (float(x), float(y), first + math.pi / 2))


def _ring_curvature(s: Floats, radius: float, turn: float) -> Floats:
    """Straight, to the right into the ring, around it to the left, to the right out of it, straight."""
    knots = np.array([0.0, 60.0, 64.0, 74.0, 78.0, 112.0, 116.0, 126.0, 130.0, 1e3])
    told = np.array([0.0, 0.0, -1 / turn, -1 / turn, 1 / radius, 1 / radius, -1 / turn, -1 / turn, 0.0, 0.0])
    return np.interp(s, knots, told)
