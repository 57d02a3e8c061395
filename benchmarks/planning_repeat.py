"""Whether the next plan is the rest of the last one, and how often planned motions touch what is uncertain."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.planning_scene import LINE, PLANNER, Effort
from planning.candidates import Goal, Keep, follow, merge, stop
from planning.frenet import FrenetState
from planning.planner import Planner, plan
from planning.plans import Plan
from planning.scene import Scene
from planning.shapes import CLEARANCE, Obstacles, boundary, no_obstacles

Floats = NDArray[np.float64]
CYCLES = 14
MODES = ("keep", "follow", "stop", "merge")
OFFSETS = np.linspace(-0.5, 0.5, 5)
LEAD_STD = 0.3  # of place [m] and of speed [m/s], drawn anew in every cycle
RISK = 0.05
DRAWS = 4000


def starts(number: int) -> list[FrenetState]:
    """Seeded: 6 to 12 m/s, up to .5 m/s^2, .8 m beside the line and .2 m/s across it."""
    rng, found = np.random.default_rng(0), []
    for _ in range(number):
        s, ds, dds, d, dd = rng.uniform([20, 6, -0.5, -0.8, -0.2], [120, 12, 0.5, 0.8, 0.2])
        found.append(FrenetState(s, ds, dds, d, dd / ds))
    return found


def goal(mode: str, start: FrenetState, t: float, error: Floats) -> Goal:
    """At time t after the start; error (2,) of a lead's place and speed."""
    front = PLANNER.vehicle.front
    if mode == "keep":
        return Keep(10.0)
    if mode == "stop":
        return stop(start.s + 40.0 + front, front)
    if mode == "merge":
        return merge((start.s + 14.0 + 9.0 * t, 9.0), (start.s - 8.0 + 9.0 * t, 9.0))
    speed = 8.0 + error[1]
    return follow(start.s + 35.0 + 8.0 * t + error[0], speed, 0.0, front, gap=4.0, headway=1.2)


def deviations(planner: Planner, start: FrenetState, mode: str, errors: Floats) -> list[float]:
    """Largest distance over 2.85 s between each plan and the rest of the one before [m]."""
    t, state, found, last = np.arange(0.0, 2.851, 0.05), start, list[float](), None
    for cycle in range(CYCLES):
        made = goal(mode, start, planner.fans.cycle * cycle, errors[cycle])
        road = boundary([], planner.radius)
        scene = Scene(LINE, state, made, OFFSETS, 0.0, road, no_obstacles(planner.num_steps))
        now = plan(planner, scene, last, planner.fans.cycle)
        if last is not None:
            gap = now.trajectory(t)[:, :2] - last.trajectory(t + planner.fans.cycle)[:, :2]
            found.append(float(np.hypot(*gap.T).max()))
        state, last = now.states([planner.fans.cycle])[0], now
    return found


def consistency(effort: Effort) -> Values:
    each = {mode: list[float]() for mode in MODES}
    noisy = list[float]()
    rng = np.random.default_rng(1)
    for start in starts(max(effort.scenes // 3, 2)):
        for mode in MODES:
            each[mode] += deviations(PLANNER, start, mode, np.zeros((CYCLES, 2)))
        noisy += deviations(PLANNER, start, "follow", rng.normal(0.0, LEAD_STD, (CYCLES, 2)))
    every = np.concatenate([each[mode] for mode in MODES])
    told = ", ".join(f"{mode} {np.quantile(each[mode], 0.95):.1e}" for mode in MODES)
    moved = float((every > 1e-6).mean())
    return {
        "consistency_p95_m": Value(float(np.quantile(every, 0.95)), f"{len(every)} plans, {moved:.3f} moved; {told}"),
        "consistency_noisy_lead_m": Value(float(np.quantile(noisy, 0.95)), f"median {np.median(noisy):.2g}"),
    }


def uncertain(rng: np.random.Generator, planner: Planner, start: FrenetState) -> tuple[Obstacles, Floats]:
    """A vehicle beside the way of the ego, and its state's standard deviations: place along and across [m], speed
    [m/s]; the covariances of its predicted places follow from them."""
    t = planner.step * np.arange(1, planner.num_steps + 1)
    s, d, v = start.s + rng.uniform(10, 30), rng.choice([-1, 1]) * rng.uniform(2.2, 3.5), rng.uniform(0, 6)
    std = rng.uniform([0.2, 0.1, 0.2], [0.6, 0.5, 0.6])
    told = LINE.at(s + v * t)
    pose = np.column_stack([LINE.place(s + v * t, np.full_like(t, d)), told[:, 2]])
    along, across = std[0] ** 2 + std[2] ** 2 * t**2, np.full_like(t, std[1] ** 2)
    cos, sin = np.cos(told[:, 2]), np.sin(told[:, 2])
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    covariance = turn @ (np.stack([along, across], -1)[..., None] * np.swapaxes(turn, 1, 2))
    return Obstacles(pose[None], np.array([[4.6, 1.9]]), covariance[None], np.ones(1)), std


def touched(planner: Planner, found: Plan, given: Obstacles, std: Floats, rng: np.random.Generator) -> Floats:
    """(DRAWS,) whether the vehicle's circles touch the other somewhere on the plan, its place and speed drawn once."""
    t = planner.step * np.arange(1, planner.num_steps + 1)
    told = found.trajectory(t)
    ahead = planner.vehicle.circles[None, :, None] * np.stack([np.cos(told[:, 2]), np.sin(told[:, 2])], -1)[:, None]
    circles = told[:, None, :2] + ahead  # (K, n, 2)
    error = rng.standard_normal((DRAWS, 3)) * std
    hit = np.zeros(DRAWS, dtype=bool)
    for k in range(planner.num_steps):
        x, y, heading = given.pose[0, k]
        along, across = error[:, 0] + error[:, 2] * t[k], error[:, 1]
        cos, sin = math.cos(heading), math.sin(heading)
        moved = np.column_stack([x + along * cos - across * sin, y + along * sin + across * cos])
        half = given.size[0] / 2
        for centre in circles[k]:  # a circle against rectangles: distances in the rectangle's frame
            p = [0.0, 0.0, cos, sin, *half, 0.0, 0.0, 0.0, 0.0, planner.vehicle.radius]
            hit |= CLEARANCE(centre - moved, np.array([p]))[:, 0] <= 0.0
    return hit.astype(float)


def chance(effort: Effort) -> Values:
    """Plans that pass beside another as closely as their chance allows, so that the share is not of easy scenes."""
    planner = Planner(risk=RISK, margin=0.0)
    rng, rates = np.random.default_rng(2), list[float]()
    tight = 0
    for start in starts(effort.scenes):
        given, std = uncertain(rng, planner, start)
        wanted = 0.0
        scene = Scene(LINE, start, Keep(10.0), np.linspace(-3.0, 3.0, 25), wanted, boundary([], planner.radius), given)
        found = plan(planner, scene)
        if found.tier != "comfort":
            continue
        tight += "other road user" in found.rejected
        rates.append(float(touched(planner, found, given, std, rng).mean()))
    near = [rate for rate in rates if rate > 0.1 * RISK]
    worst = max(rates)
    told = f"of {len(rates)} plans, {tight} of which turned cheaper ones down for it"
    mean = (
        f"mean {np.mean(near):.3g} over the {len(near)} above a tenth of the risk" if near else "none is near the risk"
    )
    return {
        "chance_stated": Value(RISK, "planner.risk of these plans"),
        "chance_rate": Value(worst, f"the largest {told}; {mean}"),
        "chance_ratio": Value(worst / RISK),
    }


MEASUREMENTS = (
    Measurement(
        (
            Figure(
                "consistency_p95_m",
                "m",
                "largest distance over 2.85 s between a plan and the rest of the one before, 95 of 100, in a world "
                "that goes on as predicted; keeping a speed, following, stopping, merging on a winding road",
                at_most=1e-9,
            ),
            Figure(
                "consistency_noisy_lead_m",
                "m",
                f"the same while following a lead told wrong by {LEAD_STD} m and m/s (std), anew in each cycle",
            ),
        ),
        consistency,
    ),
    Measurement(
        (
            Figure("chance_stated", "", "probability of touching another vehicle within a plan that was allowed"),
            Figure(
                "chance_rate",
                "",
                f"share of {DRAWS} drawn worlds in which the plan touches it, the largest over plans beside vehicles "
                "of uncertain place and speed",
            ),
            Figure("chance_ratio", "", "chance_rate / chance_stated", at_most=1.2),
        ),
        chance,
    ),
)
