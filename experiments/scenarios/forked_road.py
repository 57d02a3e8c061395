"""A motorway at night that an exit leaves, that an entry joins, or that goes on alone: simulated, the truth known.

The motorway bends gently. An exit leaves it 40 to 100 m ahead of the car with a bend of its own, of 100 to 250 m
radius, mostly to the right; an entry is an exit of the road turned round, and ends on the motorway where the exit
would begin. Reflectors stand on the guardrails of both sides and delineators behind them, along the second road as
along the first and at the same offsets, but none where they would stand on the other road. A car drives on each.
The camera is that of experiments.scenarios.road.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.scenarios.road import MODEL, Line, along, see_at
from experiments.scenarios.road_layout import Layout, Row, place_row, place_vehicle
from experiments.scenarios.scene import Scene
from models.clothoid import Clothoid, Points, evaluate
from models.program import InputError
from models.road.cues import KINDS

Floats = NDArray[np.float64]
CLEAR = 3.0  # of posts from the middle of the other road [m]
APART = 6.0  # of the second road from the first, from where it has posts of its own [m]


def forked_road(seed: int = 0, second: Literal["any", "none", "exit", "entry"] = "any") -> Scene:
    """A motorway, half of the times alone, else with an exit or an entry.

    second  what there is beside the motorway; "any" draws it

    The truth holds `num_courses`, `line` (M, 3) x, y, heading of the motorway, and where there is a second road also
    `branch`, the same of it, `joins` and `place`, how far ahead along the motorway they part [m].
    Raises InputError for a negative seed and for another word."""
    if seed < 0:
        raise InputError(f"scenario forked_road: seed is {seed}; choose 0 or more")
    if second not in ("any", "none", "exit", "entry"):
        raise InputError(f"scenario forked_road: second is '{second}'; choose any, none, exit or entry")
    which, where, stand, noise = np.random.SeedSequence(seed).spawn(4)
    drawn = str(np.random.default_rng(which).choice(["none", "none", "exit", "entry"]))
    kind = drawn if second == "any" else second
    rng, posts = np.random.default_rng(where), np.random.default_rng(stand)
    main = motorway(rng)
    place = rng.uniform(40.0, 100.0) + MODEL.prior.behind
    branch = parting(main, kind == "entry", place, rng)
    layout, points = furnish(main, branch if kind != "none" else None, kind == "entry", place, posts)
    seen = see_at(layout, points, posts, noise)
    lines = [main, branch][: 1 if kind == "none" else 2]
    tracks = [np.stack([v.numpy() for v in line.points[:3]], -1) for line in lines]
    truth = {"num_courses": np.array(len(lines)), "line": tracks[0]}
    if kind != "none":
        ahead = place - MODEL.prior.behind
        truth |= {"branch": tracks[1], "joins": np.array(kind == "entry"), "place": np.array(ahead)}
    info = {"scenario": "forked_road", "seed": seed, "second": kind, "cues": len(layout.kind)}
    return Scene(seen.cues, truth, f"forked_road {seed}, {'no second road' if kind == 'none' else 'an ' + kind}", info)


def motorway(rng: np.random.Generator) -> Line:
    """A road of gentle bends that the car is on."""
    prior = MODEL.prior
    start = [-prior.behind, rng.normal(0.0, prior.lateral_std), rng.normal(0.0, 0.5 * prior.heading_std)]
    numbers = (*start, rng.normal(0.0, 5e-4), rng.normal(0.0, 5e-6), prior.length)
    return along(Clothoid(*(torch.tensor(v, dtype=torch.float64) for v in numbers)))


def parting(main: Line, joins: bool, place: float, rng: np.random.Generator) -> Line:
    """The second road, at the same arc lengths as the first: the same up to `place`, or from there on if it joins."""
    bend = rng.choice([-1.0, 1.0], p=[0.8, 0.2]) / rng.uniform(100.0, 250.0)  # to the right, mostly
    rate, sign = rng.normal(0.0, 2e-5), -1.0 if joins else 1.0
    if joins:
        bend = -bend  # an entry from the right bends to the left, seen from the motorway on the way back
    at = main.at(np.array([place]))
    way = sign * (main.arc - place)
    x, y, heading, curvature = (v[0] for v in (at.x, at.y, at.heading + math.pi * joins, sign * at.curvature + bend))
    branch = Clothoid(x, y, heading, curvature, torch.tensor(rate), torch.tensor(way.max()))
    there = evaluate(branch, torch.from_numpy(way))
    there = there._replace(heading=there.heading - math.pi * joins, curvature=sign * there.curvature)
    parted = torch.from_numpy(way > 0.0)
    return Line(main.arc, Points(*(torch.where(parted, b, a) for a, b in zip(main.points, there, strict=True))))


def furnish(
    main: Line, branch: Line | None, joins: bool, place: float, rng: np.random.Generator
) -> tuple[Layout, Points]:
    """What stands and drives along both roads, and the points of the roads beside which it does."""
    whole, points = Layout([], [], [], []), list[Points]()
    reach = rng.uniform(130.0, main.arc[-1])
    for line, other in ((main, branch), (branch, main)):
        if line is None:
            continue
        row = Layout([], [], [], [])
        for kind, gap in (("guardrail", 20.0), ("delineator", 50.0)):
            for left in (False, True):
                place_row(row, Row(kind, left, gap), reach, rng)
        begin, free = len(whole.arc), stands_free(row, line, other, line is branch)
        for i in np.flatnonzero(free):
            whole.add(row.kind[i], row.left[i], len(whole.kind), row.arc[i])
        first = place + 15.0 if line is branch and not joins else 15.0
        first += rng.uniform(0.0, place - 40.0 if joins else 40.0)
        place_vehicle(whole, "car", False, float(first), rng.uniform(2.0, 4.0))
        points.append(line.at(np.array(whole.arc[begin:])))
    return whole, Points(*(torch.cat(columns) for columns in zip(*points, strict=True)))


def stands_free(row: Layout, line: Line, other: Line | None, is_second: bool) -> NDArray[np.bool_]:
    """Which posts (N,) are there: not where they would stand on the other road, and along the second road only where
    it has left the first."""
    if other is None:
        return np.ones(len(row.kind), dtype=bool)
    at, kinds = line.at(np.array(row.arc)), {kind.name: kind for kind in KINDS}
    sides = [kinds[k].left if left else kinds[k].right for k, left in zip(row.kind, row.left, strict=True)]
    offset = np.array([mean for mean, _ in sides])
    x, y, heading = (v.numpy() for v in at[:3])
    beside = np.stack([x - np.sin(heading) * offset, y + np.cos(heading) * offset], -1)
    free = distance(beside, other) > CLEAR
    return free & (distance(np.stack([x, y], -1), other) > APART) if is_second else free


def distance(places: Floats, line: Line) -> Floats:
    """From places (N, 2) to the nearest of the points of a line, (N,) [m]."""
    points = np.stack([line.points.x, line.points.y], -1)
    return np.hypot(*(places[:, None] - points).transpose(2, 0, 1)).min(-1)
