"""A drive along a night road: what a camera sees in frame after frame, and what the inertial unit says of the way.

The road is made of clothoids of 100 to 300 m, its curvature at their ends N(0, curvature_std^2) of the course prior, so
that no frame sees a single clothoid: a misspecification on purpose. Posts stand on both sides, each astray from its row
by the same in all frames; a car leads. The car sways in its lane, and its readings drift as models.road.ego.Drift says,
with one bias for the whole drive. Cameras measure as in experiments.scenarios.road.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.scenarios.road import LINE_STEP, MODEL, Line, camera
from experiments.scenarios.scene import Scene
from models.clothoid import Points
from models.program import InputError
from models.road.cues import KINDS, Cues
from models.road.drive import RoadDrive
from models.road.ego import Drift, Motion

Floats = NDArray[np.float64]
BEHIND, AHEAD = 15.0, 150.0  # of the car, where the truth is told [m]
PIECES = (100.0, 300.0)  # lengths of clothoids [m]
SWAY, SWAY_PERIOD = 0.2, 8.0  # of the car in its lane [m], [s]
READINGS = 25  # of the inertial unit between two frames
NEAREST, FARTHEST = 2.0, 130.0  # where cues are seen [m]
KIND = {kind.name: kind for kind in KINDS}


def night_drive(seed: int = 0, num_frames: int = 12, seconds: float = 0.5, speed: float = 15.0) -> Scene:
    """A drive of `num_frames` frames, `seconds` apart, at `speed` [m/s].

    The truth holds `lines` (F, M, 3): x, y, heading of the course every half metre, in the car's frame then. Raises
    InputError for a negative seed, no frames, and for seconds and speed that are not positive."""
    if seed < 0 or num_frames < 1:
        raise InputError(f"scenario night_drive: seed is {seed} and num_frames {num_frames}; give >= 0 and >= 1")
    if not 0.0 < seconds < math.inf or not 0.0 < speed < math.inf:
        raise InputError(f"scenario night_drive: seconds is {seconds} and speed {speed}; give positive numbers")
    road_seed, scene_seed, camera_seed, unit_seed = np.random.SeedSequence(seed).spawn(4)
    last = BEHIND + speed * seconds * (num_frames - 1)
    road = pieces(last + AHEAD + LINE_STEP, np.random.default_rng(road_seed))
    rng = np.random.default_rng(scene_seed)
    phase = rng.uniform(0.0, 2 * math.pi)
    time = np.linspace(-seconds, seconds * (num_frames - 1), READINGS * num_frames + 1)
    pose = drive(road, BEHIND + speed * time, time, phase, speed)  # before the first frame it is not read
    now = pose[READINGS::READINGS]
    posts = stand(last + AHEAD, rng)
    lead = (rng.uniform(35.0, 60.0), rng.normal(*KIND["car"].right))
    rng = np.random.default_rng(camera_seed)
    cues = tuple(see(road, BEHIND + speed * seconds * t, now[t], posts, lead, rng) for t in range(num_frames))
    motion = readings(time, pose, speed, np.random.default_rng(unit_seed))
    lines = np.stack([local_line(road, BEHIND + speed * seconds * t, now[t]) for t in range(num_frames)])
    info = {"scenario": "night_drive", "seed": seed, "frames": num_frames, "seconds": seconds, "speed_mps": speed}
    info |= {"cues": sum(len(c.kind) for c in cues)}
    return Scene(RoadDrive(cues, motion), {"lines": lines}, f"night_drive {seed}", info)


def pieces(reach: float, rng: np.random.Generator) -> Line:
    """A road of clothoids, from a straight heading at the origin on."""
    ends = [0.0]
    while ends[-1] < reach:
        ends.append(ends[-1] + rng.uniform(*PIECES))
    curvature_there = rng.normal(0.0, MODEL.prior.curvature_std, len(ends))
    arc = np.arange(0.0, reach + LINE_STEP, LINE_STEP)
    curvature = np.interp(arc, ends, curvature_there)
    heading = LINE_STEP * np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]))])
    middle = 0.5 * (heading[1:] + heading[:-1])
    x, y = (LINE_STEP * np.concatenate([[0.0], np.cumsum(f(middle))]) for f in (np.cos, np.sin))
    return Line(arc, Points(*(torch.from_numpy(v) for v in (x, y, heading, curvature))))


def drive(road: Line, arc: Floats, time: Floats, phase: float, speed: float) -> Floats:
    """Poses (M, 3) of the car at arc lengths and times (M,): it sways about the course."""
    x, y, heading = (v.numpy() for v in road.at(arc)[:3])
    turn = 2 * math.pi * time / SWAY_PERIOD + phase
    aside, lean = SWAY * np.sin(turn), SWAY * 2 * math.pi / SWAY_PERIOD * np.cos(turn) / speed
    return np.stack([x - np.sin(heading) * aside, y + np.cos(heading) * aside, heading + np.arctan(lean)], -1)


def readings(time: Floats, pose: Floats, speed: float, rng: np.random.Generator) -> tuple[Motion, ...]:
    """What the inertial unit reads, frame by frame; of the first, the one reading then."""
    drift, dt = Drift(), time[1] - time[0]
    way = np.hypot(*np.diff(pose[:, :2], axis=0).T) / dt
    pace = np.interp(time, 0.5 * (time[1:] + time[:-1]), way)
    yaw = np.gradient(pose[:, 2], dt) + rng.normal(0.0, drift.yaw_bias)
    yaw += drift.yaw_noise / math.sqrt(dt) * rng.standard_normal(len(time))
    push = np.gradient(pace, dt) + rng.normal(0.0, drift.acceleration_bias)
    push += drift.acceleration_noise / math.sqrt(dt) * rng.standard_normal(len(time))
    frames = list[Motion]()
    for end in range(READINGS, len(time), READINGS):
        own = slice(end if end == READINGS else end - READINGS, end + 1)
        frames.append(Motion(time[own], yaw[own], push[own], float(pace[end] + rng.normal(0.0, drift.speed_std))))
    return tuple(frames)


def stand(reach: float, rng: np.random.Generator) -> Floats:
    """Posts (P, 3): arc length, offset, and 1 on the left."""
    rows, kind = list[Floats](), KIND["delineator"]
    for left in (False, True):
        gap = float(rng.choice([25.0, 50.0]))
        arc = np.arange(rng.uniform(0.0, gap), reach, gap)
        offset = rng.normal(*(kind.left if left else kind.right)) + kind.std * rng.standard_normal(len(arc))
        rows.append(np.stack([arc, offset, np.full(len(arc), float(left))], -1))
    return np.concatenate(rows)


def see(
    road: Line, here: float, pose: Floats, posts: Floats, lead: tuple[float, float], rng: np.random.Generator
) -> Cues:
    """The cues of one frame, of a car at arc length `here`; `lead` is how far ahead another drives, and its offset."""
    car, gap = KIND["car"], posts[:, 0] - here
    met = (gap > NEAREST) & (gap < FARTHEST) & (rng.random(len(posts)) < 0.95 - 0.25 * gap / FARTHEST)
    num = int(met.sum())
    arc = np.append(posts[met, 0], here + lead[0])
    aside = np.append(posts[met, 1], lead[1] + car.std * rng.standard_normal())
    x, y, heading = (v.numpy() for v in road.at(arc)[:3])
    world = np.stack([x - np.sin(heading) * aside, y + np.cos(heading) * aside], -1)
    true, vehicles = to_car(world, pose), np.arange(num + 1) == num
    covariance = camera(true, vehicles)
    noise = (np.linalg.cholesky(covariance) @ rng.standard_normal((num + 1, 2, 1)))[..., 0]
    flow_std = 0.02 + 0.0012 * np.hypot(*true.T)
    away = np.hypot(car.flow_std or 0.0, flow_std) * rng.standard_normal(num + 1)
    return Cues(
        kind=np.array(["delineator"] * num + ["car"]),
        left=np.append(posts[met, 2] > 0.0, False),
        track=np.append(np.flatnonzero(met), 0),
        position=true + noise,
        covariance=covariance,
        flow=np.where(vehicles, heading - pose[2] + away, np.nan),
        flow_std=flow_std,
        confidence=np.ones(num + 1),
    )


def to_car(points: Floats, pose: Floats) -> Floats:
    """Points (N, 2) of the world in the frame of a car at pose (3,)."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return (points - pose[:2]) @ np.array([[cos, -sin], [sin, cos]])


def local_line(road: Line, here: float, pose: Floats) -> Floats:
    """The course about the car, (M, 3), as it is seen from there."""
    arc = here + np.arange(-BEHIND, AHEAD + LINE_STEP / 2, LINE_STEP)
    x, y, heading = (v.numpy() for v in road.at(arc)[:3])
    return np.concatenate([to_car(np.stack([x, y], -1), pose), heading[:, None] - pose[2]], -1)
