"""Optimal control of plans: how long it takes, how often it is solved, and what it saves."""

from __future__ import annotations

import time
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.planning_scene import Effort
from benchmarks.timing import p95
from inference.progress import Progress
from planning.candidates import Goal, Keep, follow, stop
from planning.frenet import FrenetState
from planning.optimal import DEARER, Refined, refine
from planning.planner import COMFORT, Planner, plan
from planning.reference import ReferenceLine, from_curvature
from planning.scene import Scene
from planning.shapes import Obstacles, boundary

LARGEST = 3  # number of other road users


def scene(planner: Planner, seed: int) -> Scene:
    """Scene `seed` of the set: a winding road with lines at both sides, a vehicle at 5 to 18 m/s a little off its lane,
    up to three rectangles of uncertain place that stand or drive along the road, and a speed, a lead vehicle or a stop
    point."""
    rng = np.random.default_rng([2015, seed])
    speed = rng.uniform(5.0, 18.0)
    bend, period = rng.uniform(0.0, min(0.03, 1.2 / speed**2)), rng.uniform(15.0, 40.0)
    s = np.arange(0.0, 301.0, 0.5)
    line = from_curvature(s, bend * np.sin(s / period + rng.uniform(0.0, 6.0)))
    state = FrenetState(20.0, speed, rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4), rng.uniform(-0.02, 0.02))
    num = int(rng.integers(LARGEST + 1))
    pace = rng.uniform(0.0, speed, num)
    ahead = rng.uniform(12.0, 25.0, num) + 2.0 * (speed - pace) + 12.0 * np.arange(num)
    side = rng.choice([-1.0, 1.0], num) * rng.uniform(1.2, 3.2, num)
    others = _others(line, 20.0 + ahead, side, pace, rng.uniform(0.0, 0.2, num), planner)
    goal: Goal = Keep(max(speed + rng.uniform(-4.0, 3.0), 0.0))
    end = np.inf
    if rng.random() < 0.2:
        goal = follow(45.0 + 2.0 * speed, 0.8 * speed, 0.0, planner.vehicle.front, gap=4.0, headway=1.2)
    elif rng.random() < 0.2:
        end = 20.0 + planner.vehicle.front + speed**2 / 4.0 + 10.0
        goal = stop(end, planner.vehicle.front)
    sides = rng.uniform(2.4, 5.0, 2)
    lines = [line.place(np.arange(0.0, 200.0, 1.0), d) for d in (-sides[0], sides[1])]
    return Scene(
        line, state, goal, np.linspace(-2.4, 2.4, 13), 0.0, boundary(lines, planner.radius), others, stop=float(end)
    )


def _others(
    line: ReferenceLine, s: np.ndarray, d: np.ndarray, speed: np.ndarray, std: np.ndarray, planner: Planner
) -> Obstacles:
    t = planner.step * np.arange(1, planner.num_steps + 1)
    way = s[:, None] + speed[:, None] * t
    pose = np.concatenate([line.place(way, np.broadcast_to(d[:, None], way.shape)), line.at(way)[..., 2:3]], -1)
    spread = np.broadcast_to(np.eye(2) * std[:, None, None, None] ** 2, (len(s), len(t), 2, 2))
    return Obstacles(pose, np.tile([4.6, 1.9], (len(s), 1)), spread, np.ones(len(s)))


class Outcome(NamedTuple):
    """Of a scene: what came of it, and processor time [ms] of a refinement, the second one."""

    refined: Refined
    spent: float


@lru_cache
def outcomes(effort: Effort) -> list[Outcome]:
    """Of all scenes."""
    planner, found = Planner(), list[Outcome]()
    with Progress("optimal control", effort.scenes, effort.show) as bar:
        for seed in range(effort.scenes):
            given = scene(planner, seed)
            begun = plan(planner, given)
            refine(planner, given, begun)  # builds the problem of its shape, once
            start = time.process_time()
            refined = refine(planner, given, begun)
            found.append(Outcome(refined, 1e3 * (time.process_time() - start)))
            bar.advance(1)
    return found


def figures(effort: Effort) -> Values:
    found = outcomes(effort)
    spent = [outcome.spent for outcome in found]
    refined = [outcome.refined for outcome in found]
    solved = [one.converged and one.why in ("none", DEARER) for one in refined]
    comfort = [one for one in refined if one.plan.tier == COMFORT]
    ratios = [one.cost / one.plan.cost if one.accepted else 1.0 for one in comfort]
    return {
        "ocp_ms_p95": Value(p95(spent), f"{len(found)} scenes, median {np.median(spent):.3g}, max {max(spent):.3g} ms"),
        "ocp_solved": Value(
            float(np.mean(solved)), f"{len(found)} scenes, in {len(found) - len(comfort)} of them no good candidate"
        ),
        "ocp_cost_ratio": Value(
            max(ratios),
            f"{len(comfort)} scenes, {sum(one.accepted for one in comfort)} made better, median "
            f"{np.median(ratios):.3f}, least {min(ratios):.3f}",
        ),
    }


MEASUREMENTS = (
    Measurement(
        (
            Figure(
                "ocp_ms_p95",
                "ms",
                "processor time to refine a plan by optimal control, problem built and all checks, exceeded in one of "
                "twenty scenes of a frozen random set",
                at_most=15.0,
            ),
            Figure(
                "ocp_solved",
                "",
                "share of these scenes in which the solver converges and what it finds is within the limits of comfort "
                "and clear of everything, by the check of the candidates",
                at_least=1.0,
            ),
            Figure(
                "ocp_cost_ratio",
                "",
                "cost of what is followed over that of the best candidate, the largest, where there is a good one",
                at_most=1.0,
            ),
        ),
        figures,
    ),
)
