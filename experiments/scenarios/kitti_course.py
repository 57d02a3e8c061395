"""Recorded courses: what KITTI's car drove past real poles, and lanes of motorways.

The courses and poles are real, the measurements are simulated at their places with the camera of
experiments.scenarios.road. Neither is a clothoid, and no row of poles is even: a misspecification on purpose. The car
stands on its course.
"""

from __future__ import annotations

import csv
import gzip
import json

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.scenarios.junction import DATA_ROOT, find, pick
from experiments.scenarios.road import MODEL, Line, camera, see
from experiments.scenarios.road_layout import Layout, Row, place_markings, place_row
from experiments.scenarios.scene import Scene
from models.clothoid import Points
from models.program import InputError
from models.road.cues import Cues

Floats = NDArray[np.float64]

STEP = 0.5  # of a line [m]
BEHIND = MODEL.prior.behind  # where the course begins [m]
REACH = MODEL.prior.length  # of the course [m]
MOST_TURN = 0.9  # [rad]; more is a corner between two roads, which no course goes round
BESIDE = 10.0  # a pole farther from the course belongs to another road [m]
LEAST_POLES = 3


def kitti_course(sequence: str = "03", seed: int = 0, data_root: str = DATA_ROOT) -> Scene:
    """A place on a drive of KITTI's car and the poles beside the next 145 m of it.

    sequence   "03" and "10" are in the country and suburbs, "04" is an avenue, "00", "05" and "07" are in town
    seed       chooses the place among those from where the drive turns by less than 50 degrees, and the noise

    Raises InputError where the data are not there, and for a sequence that is not among them."""
    _check("kitti_course", seed)
    with gzip.open(
        pick(sequence, find(data_root, "road_course/kitti_odometry_poses", ".csv.gz", "night_road"), "sequence"), "rt"
    ) as f:
        driven = resample(np.array([[float(row["x_m"]), float(row["y_m"])] for row in csv.DictReader(f)]))
    with pick(sequence, find(data_root, "localization/kitti_poles", ".csv", "night_road"), "sequence").open() as f:
        poles = np.array([[float(row["x_m"]), float(row["y_m"])] for row in csv.DictReader(f)])
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    for first in rng.permutation(np.arange(0.0, STEP * len(driven) - REACH, 5.0)):
        line = in_car_frame(driven, first)
        if np.ptp(np.unwrap(line.points.heading.numpy())) < MOST_TURN:
            arc, aside = beside(line, to_car_frame(poles, driven, first))
            seen = np.flatnonzero(rng.random(len(arc)) < 0.95 - 0.25 * arc / REACH)
            if len(seen) >= LEAST_POLES:
                cues = measure_poles(line, arc[seen], aside[seen], rng)
                info = {"scenario": "kitti_course", "sequence": sequence, "seed": seed, "place_m": float(first)}
                return Scene(cues, _truth(line), f"KITTI {sequence}, {first:.0f} m", info | {"cues": len(seen)})
    raise InputError(f"sequence {sequence} has no {REACH:.0f} m without a corner and with poles; choose another")


def motorway_course(name: str = "exid_merzenich_rather", seed: int = 0, data_root: str = DATA_ROOT) -> Scene:
    """A lane of a motorway, with markings and reflectors on both guardrails as in night_highway.

    seed  chooses the lane, the place on it and the cues

    Raises InputError where the data are not there, and for a name that is not among them."""
    _check("motorway_course", seed)
    file = pick(name, find(data_root, "road_course/highway_lanes", ".json", "night_highway"), "motorway")
    lanes = [lane for lane in json.loads(file.read_text())["lanes"] if lane["length_m"] > REACH + STEP]
    choose, noise = np.random.SeedSequence(seed).spawn(2)
    rng = np.random.default_rng(choose)
    lane = resample(np.array(lanes[rng.integers(len(lanes))]["centerline"]))
    line = in_car_frame(lane, rng.uniform(0.0, STEP * (len(lane) - 1) - REACH))
    layout = Layout([], [], [], [])
    place_markings(layout, rng)
    for left in (False, True):
        place_row(layout, Row("guardrail", left, 20.0), REACH, rng)
    cues = see(layout, line, rng, noise).cues
    info = {"scenario": "motorway_course", "name": name, "seed": seed, "cues": len(cues.kind)}
    return Scene(cues, _truth(line), f"{name} {seed}", info)


def _check(name: str, seed: int) -> None:
    if seed < 0:
        raise InputError(f"scenario {name}: seed is {seed}; choose 0 or more")


def _truth(line: Line) -> dict[str, Floats]:
    track = np.stack([v.numpy() for v in line.points[:3]], -1)
    return {"course": np.concatenate([track[0], track[-1]]), "line": track}


def resample(points: Floats) -> Floats:
    """Points (M, 2) every STEP along a line (N, 2) that may stand still."""
    moved = np.concatenate([[True], np.hypot(*np.diff(points, axis=0).T) > 1e-3])
    points = points[moved]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.arange(0.0, arc[-1], STEP)
    return np.stack([np.interp(at, arc, points[:, axis]) for axis in range(2)], -1)


def to_car_frame(points: Floats, driven: Floats, first: float) -> Floats:
    """Points (N, 2) in the frame of a car BEHIND metres after arc length `first` of a line, x along it."""
    here = round((first + BEHIND) / STEP)
    ahead = driven[min(here + 4, len(driven) - 1)] - driven[max(here - 4, 0)]
    c, s = ahead / np.hypot(*ahead)
    return (points - driven[here]) @ np.array([[c, -s], [s, c]])


def in_car_frame(driven: Floats, first: float) -> Line:
    """The course from arc length `first` of a line on, in the frame of the car."""
    points = to_car_frame(driven, driven, first)[round(first / STEP) : round((first + REACH) / STEP) + 1]
    slope = np.gradient(points, axis=0)
    heading = np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))
    columns = (points[:, 0], points[:, 1], heading, np.gradient(heading) / STEP)
    arc = np.linspace(0.0, REACH, len(points))
    return Line(arc, Points(*(torch.from_numpy(np.ascontiguousarray(v)) for v in columns)))


def beside(line: Line, poles: Floats) -> tuple[Floats, Floats]:
    """Arc lengths (N,) and distances to the left (N,) of the poles beside a line."""
    x, y, heading = (v.numpy() for v in line.points[:3])
    gap = poles[:, None] - np.stack([x, y], -1)  # (P, M, 2)
    nearest = np.hypot(gap[..., 0], gap[..., 1]).argmin(1)
    dx, dy = gap[np.arange(len(poles)), nearest].T
    aside = np.cos(heading[nearest]) * dy - np.sin(heading[nearest]) * dx
    along = np.cos(heading[nearest]) * dx + np.sin(heading[nearest]) * dy
    kept = (np.abs(aside) < BESIDE) & (np.abs(along) < 2 * STEP)
    return line.arc[nearest[kept]], aside[kept]


def measure_poles(line: Line, arc: Floats, aside: Floats, rng: np.random.Generator) -> Cues:
    """Poles at arc lengths (N,) and offsets (N,) of a line as the camera sees them."""
    x, y, heading = (v.numpy() for v in line.at(arc)[:3])
    true = np.stack([x - np.sin(heading) * aside, y + np.cos(heading) * aside], -1)
    covariance = camera(true, np.zeros(len(true), dtype=bool))
    noise = (np.linalg.cholesky(covariance) @ rng.standard_normal((len(true), 2, 1)))[..., 0]
    return Cues(
        kind=np.full(len(true), "pole"),
        left=aside > 0,
        track=np.arange(len(true)),
        position=true + noise,
        covariance=covariance,
        flow=np.full(len(true), np.nan),
        flow_std=np.ones(len(true)),
        confidence=np.ones(len(true)),
    )
