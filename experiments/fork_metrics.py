"""Whether a road was seen to fork, where, and how far both courses run from the true ones.

Which of two courses is the main one is a matter of the model (models.road.fork), and draws may differ in it. So the
second course is the one on the side where most draws have theirs. The courses of an estimate are the means of the drawn
ones, point by point at equal arc lengths, and true courses are compared with them in the order that fits better.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.metrics import known
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from models.clothoid_kernel import COS, SIN
from models.road.along_fork import Fork, sampled_courses
from models.road.fork import ForkedRoad

Floats = NDArray[np.float64]
TOLD = (80.0, 140.0)  # ranges whose errors are reported [m]
NUM_DRAWS = 1000


class DrawnFork(NamedTuple):
    """What D draws of a posterior say of both courses, E of which have the more probable kind of second course.

    draws        {site: (D, *event)}, equally weighted
    forked       (D,) which E have it
    swapped      (E,) whose main course is told as the second here
    probability  of a second course
    joins        probability that it joins, given that there is one
    place        (E,) where the courses part, along the main one from the car on [m]
    courses      drawn points (E, num, 2) of both courses [m]; (D - E, num, 2) of one where that is more probable
    """

    draws: dict[str, NDArray[Any]]
    forked: NDArray[np.bool_]
    swapped: NDArray[np.bool_]
    probability: float
    joins: float
    place: Floats
    courses: list[Floats]


def drawn_fork(posterior: Posterior, model: ForkedRoad, num_draws: int = NUM_DRAWS) -> DrawnFork:
    """Equally weighted draws of the courses."""
    draws = posterior.resample(num_draws, 0)
    two = draws["num_courses"] == 2
    share, joins = float(two.mean()), float(draws["joins"][two].mean()) if two.any() else math.nan
    forked = two & (draws["joins"] == (joins > 0.5))
    first, second = sampled_courses(model, fork_of(draws))
    one = first[~two, :, :2]
    first, second = first[forked], second[forked]
    end = 0 if joins > 0.5 else -1  # where the courses are apart
    at, apart = first[:, end], second[:, end, :2] - first[:, end, :2]
    left = apart[:, 1] * at[:, COS] - apart[:, 0] * at[:, SIN] > 0.0
    swapped = left != (left.mean() > 0.5) if len(left) else left
    mask = swapped[:, None, None]
    both = [np.where(mask, b, a)[..., :2] for a, b in ((first, second), (second, first))]
    length, shared = model.road.prior.length, draws["shared"][forked]
    place = (length - shared if joins > 0.5 else shared) - model.road.prior.behind
    return DrawnFork(draws, forked, swapped, share, joins, place, both if share > 0.5 else [one])


def fork_of(draws: dict[str, NDArray[Any]]) -> Fork:
    """The courses of draws {site: (D, *event)}."""
    return Fork(*(torch.from_numpy(draws[name]) for name in Fork._fields))


def errors(lines: list[Floats], truth: list[Floats], distance: float) -> list[float]:
    """How far the points of true lines (M, 3) at a distance from the car are from estimated lines (num, 2), in the
    order of the lines that fits better [m]; nan for a true line without a counterpart."""
    points = [at_distance(line, distance) for line in truth]
    orders = [lines, lines[::-1]] if len(lines) == 2 else [lines]
    found = [[to_line(p, line) for p, line in zip(points, order, strict=False)] for order in orders]
    best = min(found, key=sum)
    return best + [math.nan] * (len(truth) - len(best))


def at_distance(line: Floats, distance: float) -> Floats:
    """The point (2,) of a line (M, 2 or 3) ahead of the car at this distance."""
    away = np.hypot(line[:, 0], line[:, 1])
    ahead = np.flatnonzero((line[:, 0] > 0.0) & (away >= distance))
    return np.asarray(line[ahead[0] if len(ahead) else -1, :2])


def to_line(point: Floats, line: Floats) -> float:
    """Distance of a point (2,) from a line through points (num, 2) [m]."""
    way = np.diff(line, axis=0)
    share = np.clip(((point - line[:-1]) * way).sum(-1) / np.square(way).sum(-1), 0.0, 1.0)
    return float(np.hypot(*(point - line[:-1] - share[:, None] * way).T).min())


def metrics(posterior: Posterior, scene: Scene, *, forks: ForkedRoad | None = None) -> dict[str, float]:
    """Of a posterior over forks, for the report; nothing without the true lines.

    fork_probability       of a second course
    count_right            1 where the more probable number of courses is the true one
    kind_right             1 where the second course joins or leaves as it does in truth
    place_error_m          of the posterior mean of the place where the courses part, along the road
    main_error_80_m ..     distance of the true courses from the estimated ones, 80 and 140 m from the car; nan where
    second_error_80_m ..   one is not seen"""
    truth = known(scene)
    if "line" not in truth or "bend" not in posterior.draws:
        return {}
    drawn = drawn_fork(posterior, forks or ForkedRoad())
    lines = [points.mean(0) for points in drawn.courses]
    true = [truth[name] for name in ("line", "branch") if name in truth]
    out = {
        "fork_probability": drawn.probability,
        "count_right": float((drawn.probability > 0.5) == (len(true) == 2)),
    }
    if len(true) == 2 and len(lines) == 2:
        out["kind_right"] = float((drawn.joins > 0.5) == bool(truth["joins"]))
        out["place_error_m"] = abs(float(drawn.place.mean() - truth["place"]))
    for distance in TOLD:
        for name, error in zip(("main", "second"), errors(lines, true, distance), strict=False):
            out[f"{name}_error_{distance:.0f}_m"] = error
    return out
