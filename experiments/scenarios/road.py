"""Night roads, simulated by the road model itself: what [T17] shows, with the truth known.

    course ~ prior of RoadCourse,  offsets ~ priors of their kinds,  cues ~ RoadCourse without clutter

A camera measures a distance r with noise along and across the line of sight: 5 cm + 2 % r + .03 % r^2 / m along for
what stands (structure from motion), 5 cm + 5 % r for vehicles (their known size), 2 cm + .2 % r across. Options depart
from the model on purpose. Seeds 0 to 999 of `night_road` are the frozen scenes; what is there, the course, the noise
and each option have their own streams, so that an option changes nothing but itself.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.scenarios.road_layout import (
    HISTORY,
    Layout,
    Row,
    place_markings,
    place_row,
    place_vehicle,
    random_layout,
)
from experiments.scenarios.road_sensors import LIDAR, RADAR, Sensor
from experiments.scenarios.scene import Scene
from models.clothoid import Clothoid, Points, evaluate, hermite
from models.program import InputError, quiet_doubles
from models.road.along_road import scatter
from models.road.course import RoadCourse
from models.road.cues import Cues, line_of_sight
from models.road.prior import course_moments

Floats = NDArray[np.float64]
MODEL = RoadCourse(clutter=0.0, lane_changes=0.0)
LINE_STEP = 0.5  # of the true line [m]
CLUTTER_REACH = 15.0  # to either side [m]
LANE_WIDTH, CHANGE_REACH = 3.5, 60.0  # how far a change of lanes leads aside, and along the road [m]


def night_road(
    seed: int = 0,
    clutter: float = 0.0,
    yaw: float = 0.0,
    mismatch: bool = False,
    markings: bool = False,
    lane_change: bool = False,
    radar: bool = False,
    lidar: bool = False,
) -> Scene:
    """A random night road of the model's prior.

    seed      0 to 999 are the frozen scenes; larger ones are further draws
    clutter   share of static cues that are moved aside by up to 15 m
    yaw       drift [rad]: each old detection of a vehicle is turned about the car by N(0, yaw)
    mismatch  the road is a line, a bend and clothoids between, not one clothoid
    markings  both borders of the lane are seen too, to 70 m
    lane_change  one more car is seen, which goes over to the left lane within 60 m
    radar, lidar  these sensors see the road, too (experiments.scenarios.road_sensors); model=road_course_radar_lidar

    The truth holds `course` (6,) and `offset` (G,) as the model's sites do, and `line` (M, 3): x, y, heading of the
    course every half metre. Raises InputError for a negative seed and shares that are none."""
    _check("night_road", seed)
    if not 0 <= clutter <= 1:
        raise InputError(f"scenario night_road: clutter is {clutter}; give a share from 0 to 1")
    if not 0 <= yaw < np.inf:
        raise InputError(f"scenario night_road: yaw is {yaw}; give an angle of 0 rad or more")
    streams = np.random.SeedSequence(seed).spawn(9)
    where, layout = random_layout(np.random.default_rng(streams[0]))
    mean, tril = course_moments(MODEL.prior)
    rng = np.random.default_rng(streams[1])
    course = mean + tril @ rng.standard_normal(6)
    start, end = (torch.from_numpy(part) for part in np.split(course, 2))
    line = composite(course[:3], np.random.default_rng(streams[3])) if mismatch else along(hermite(start, end))
    seen = see(layout, line, rng, streams[2])
    drift, disturb = (np.random.default_rng(s) for s in streams[4].spawn(2))
    if yaw > 0:
        seen = seen._replace(cues=turn_vehicles(seen.cues, drift.normal(0.0, yaw, len(seen.cues.kind))))
    if clutter > 0:
        moved = (disturb.random(len(seen.cues.kind)) < clutter) & np.isnan(seen.cues.flow)
        aside = disturb.uniform(-CLUTTER_REACH, CLUTTER_REACH, len(seen.cues.kind))
        seen.cues.position[:, 1] += np.where(moved, aside, 0.0)
    if markings:
        painted, rng = Layout([], [], [], []), np.random.default_rng(streams[5])
        place_markings(painted, rng)
        seen = seen.join(see(painted, line, rng, streams[5].spawn(1)[0]))
    if lane_change:
        seen = seen.join(changing_car(line, len(seen.cues.kind), np.random.default_rng(streams[6])))
    info = {"place": where, "clutter": clutter, "yaw": yaw, "mismatch": mismatch, "markings": markings}
    for sensor, there, stream in ((RADAR, radar, streams[7]), (LIDAR, lidar, streams[8])):
        if there:
            seen = seen.join(see_by(sensor, line, stream))
    info |= {"lane_change": lane_change, "radar": radar, "lidar": lidar}
    return _scene("night_road", seed, seen, line, info)


def night_rural(seed: int = 0) -> Scene:
    """A country road through a bend: markings, delineators on both sides, a car ahead. [T17] figure 4."""
    _check("night_rural", seed)
    layout, rng, noise = _begin(seed)
    place_markings(layout, rng)
    for left in (False, True):
        place_row(layout, Row("delineator", left, 25.0), 130.0, rng)
    place_vehicle(layout, "car", False, rng.uniform(50.0, 70.0), rng.uniform(2.0, 4.0))
    bend = rng.choice([-1.0, 1.0]) / rng.uniform(250.0, 400.0)
    line = _bend(rng, bend, 1e-5)
    return _scene("night_rural", seed, see(layout, line, rng, noise), line)


def night_highway(seed: int = 0) -> Scene:
    """A highway under high beam: markings, reflectors on the guardrails of both sides. [T17] figure 5."""
    _check("night_highway", seed)
    layout, rng, noise = _begin(seed)
    place_markings(layout, rng)
    for left in (False, True):
        place_row(layout, Row("guardrail", left, 20.0), 155.0, rng)
    line = _bend(rng, rng.normal(0.0, 1e-3), 3e-6)
    return _scene("night_highway", seed, see(layout, line, rng, noise), line)


def night_urban(seed: int = 0) -> Scene:
    """A street without markings: a few lanterns on both sides, more of them on the right. [T17] figure 6."""
    _check("night_urban", seed)
    layout, rng, noise = _begin(seed)
    place_row(layout, Row("lantern", False, 28.0), 150.0, rng)
    place_row(layout, Row("lantern", True, 45.0), 150.0, rng)
    line = _bend(rng, rng.normal(0.0, 2e-3), 1e-5)
    return _scene("night_urban", seed, see(layout, line, rng, noise), line)


# Making a scene


class Line(NamedTuple):
    """Points of a true course at arc lengths (M,) [m], about every half metre."""

    arc: Floats
    points: Points

    def at(self, arc: Floats) -> Points:
        """Points at arc lengths (N,)."""
        return Points(*(torch.from_numpy(np.interp(arc, self.arc, column.numpy())) for column in self.points))


class Seen(NamedTuple):
    """Cues, and the true offsets of their groups by name [m]."""

    cues: Cues
    offset: dict[str, float]

    def join(self, more: Seen) -> Seen:
        """Both together."""
        joined = Cues(*(np.concatenate(pair) for pair in zip(self.cues, more.cues, strict=True)))  # type: ignore[arg-type]
        return Seen(joined, self.offset | more.offset)


def see(layout: Layout, line: Line, rng: np.random.Generator, noise: np.random.SeedSequence) -> Seen:
    """The cues of a layout along a line (`along`). Offsets are drawn from the priors of the kinds; the noise is that at
    the true distance."""
    return see_at(layout, line.at(np.array(layout.arc)), rng, noise)


def see_at(
    layout: Layout,
    points: Points,
    rng: np.random.Generator,
    noise: np.random.SeedSequence,
    sensor: Sensor | None = None,
) -> Seen:
    """The same of cues that stand beside points (N,) of any road, seen by the camera or by another sensor; their arc
    lengths do not matter."""
    model = dataclasses.replace(MODEL, extra_kinds=(sensor.kind,)) if sensor else MODEL
    covariance = sensor.covariance if sensor else camera
    num = len(layout.kind)
    vehicles = np.array([kind in ("car", "truck") for kind in layout.kind])
    cues = Cues(
        kind=np.array(layout.kind),
        left=np.array(layout.left),
        track=np.array(layout.track),
        position=np.zeros((num, 2)) + np.arange(num)[:, None],  # to come; no two cues may be the same
        covariance=np.broadcast_to(np.eye(2), (num, 2, 2)),
        flow=np.where(vehicles, 0.0, np.nan),
        flow_std=np.ones(num),
        confidence=np.ones(num),
    )
    evidence = model.prepare(cues)
    offset = evidence.offset_loc + evidence.offset_std * rng.standard_normal(len(evidence.offset_loc))
    aside = offset[evidence.group]
    x, y, heading = (v.numpy() for v in points[:3])
    true = np.stack([x - np.sin(heading) * aside, y + np.cos(heading) * aside], -1)
    cues = cues._replace(covariance=covariance(true, vehicles), flow_std=0.02 + 0.0012 * np.hypot(*true.T))
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(noise.generate_state(1)[0]))
        measured = scatter(points, torch.from_numpy(aside), model.prepare(cues), model).numpy()
    cues = cues._replace(position=measured[:, :2], flow=np.where(vehicles, measured[:, 2], np.nan))
    return Seen(cues, dict(zip(evidence.names, offset.tolist(), strict=True)))


def camera(true: Floats, vehicles: NDArray[np.bool_]) -> Floats:
    """Covariances (N, 2, 2) of measured positions [m^2], at true positions (N, 2)."""
    distance = np.hypot(*true.T)
    range_std = 0.05 + np.where(vehicles, 0.05 * distance, 0.02 * distance + 0.0003 * distance**2)
    return line_of_sight(true, range_std, 0.02 + 0.002 * distance)


def see_by(sensor: Sensor, line: Line, stream: np.random.SeedSequence) -> Seen:
    """What another sensor sees."""
    rng, layout = np.random.default_rng(stream), Layout([], [], [], [])
    place_row(layout, Row(sensor.kind.name, False, sensor.gap), MODEL.prior.behind + sensor.reach, rng)
    return see_at(layout, line.at(np.array(layout.arc)), rng, stream.spawn(1)[0], sensor)


def changing_car(line: Line, track: int, rng: np.random.Generator) -> Seen:
    """A car that goes over to the lane on the left while it is seen."""
    layout = Layout([], [], [], [])
    for arc in rng.uniform(40.0, 60.0) + CHANGE_REACH / (HISTORY - 1) * np.arange(HISTORY):
        layout.add("car", False, track, float(arc))
    seen = see(layout, line, rng, np.random.SeedSequence(int(rng.integers(2**63))))
    u = np.linspace(0.0, 1.0, HISTORY)
    aside, slope = LANE_WIDTH * u**2 * (3.0 - 2.0 * u), LANE_WIDTH / CHANGE_REACH * 6.0 * u * (1.0 - u)
    heading = line.at(np.array(layout.arc)).heading.numpy()
    shift = aside[:, None] * np.stack([-np.sin(heading), np.cos(heading)], -1)
    cues = seen.cues._replace(position=seen.cues.position + shift, flow=seen.cues.flow + np.arctan(slope))
    return seen._replace(cues=cues)


def turn_vehicles(cues: Cues, angle: Floats) -> Cues:
    """Vehicles turned about the car by angles (N,) [rad]."""
    angle = np.where(np.isnan(cues.flow), 0.0, angle)
    x, y = cues.position.T
    turned = np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)], -1)
    return cues._replace(position=turned, flow=cues.flow + angle)


def composite(start: Floats, rng: np.random.Generator) -> Line:
    """A road of pieces: curvature runs evenly between four values at two inner places."""
    reach = MODEL.prior.length
    s = np.arange(0.0, reach + LINE_STEP, LINE_STEP)
    first, second, last = rng.normal(0.0, MODEL.prior.curvature_std, 3) * [0.6, 1.0, 1.0]
    places = np.sort(rng.uniform(30.0, reach - 25.0, 2))
    curvature = np.interp(s, [0.0, *places, reach], [first, second, second + 0.3 * last, last])
    heading = start[2] + LINE_STEP * np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]))])
    middle = 0.5 * (heading[1:] + heading[:-1])
    x = start[0] + LINE_STEP * np.concatenate([[0.0], np.cumsum(np.cos(middle))])
    y = start[1] + LINE_STEP * np.concatenate([[0.0], np.cumsum(np.sin(middle))])
    return Line(s, Points(*(torch.from_numpy(v) for v in (x, y, heading, curvature))))


def along(road: Clothoid) -> Line:
    """A true course that is one clothoid."""
    length = float(road.length)
    arc = np.linspace(0.0, length, 1 + round(length / LINE_STEP))
    return Line(arc, evaluate(road, torch.from_numpy(arc)))


def _bend(rng: np.random.Generator, curvature: float, rate_std: float) -> Line:
    """A road that the car is on, with this curvature where the car is."""
    prior, rate = MODEL.prior, rng.normal(0.0, rate_std)
    start = [-prior.behind, rng.normal(0.0, prior.lateral_std), rng.normal(0.0, prior.heading_std)]
    numbers = (*start, curvature - prior.behind * rate, rate, prior.length)
    return along(Clothoid(*(torch.tensor(v, dtype=torch.float64) for v in numbers)))


def _begin(seed: int) -> tuple[Layout, np.random.Generator, np.random.SeedSequence]:
    scene, noise = np.random.SeedSequence(seed).spawn(2)
    return Layout([], [], [], []), np.random.default_rng(scene), noise


def _check(name: str, seed: int) -> None:
    if seed < 0:
        raise InputError(f"scenario {name}: seed is {seed}; choose 0 or more (0 to 999 are the frozen scenes)")


def _scene(name: str, seed: int, seen: Seen, line: Line, info: dict[str, Any] | None = None) -> Scene:
    """The scene with its truth; the course is where the line starts and ends."""
    names = dataclasses.replace(MODEL, extra_kinds=(RADAR.kind, LIDAR.kind)).prepare(seen.cues).names
    track = np.stack([v.numpy() for v in line.points[:3]], -1)
    course, offset = np.concatenate([track[0], track[-1]]), np.array([seen.offset[group] for group in names])
    numbers = {"scenario": name, "seed": seed, "cues": len(seen.cues.kind), "groups": len(names)}
    truth = {"course": course, "offset": offset, "line": track}
    return Scene(seen.cues, truth, f"{name} {seed}", numbers | (info or {}))
