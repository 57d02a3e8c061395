"""The planning scene that is timed: a winding road, eight vehicles, boundary lines, fans of any size."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from planning.candidates import Keep, Lateral, Longitudinal, Weights, longitudinal_cost
from planning.frenet import FrenetState
from planning.kinematics import Limits
from planning.planner import Planner, combined
from planning.plans import Candidates
from planning.polynomials import quartics, quintics, squared_jerk
from planning.reference import from_curvature
from planning.scene import Scene
from planning.shapes import Obstacles, boundary

S = np.arange(0.0, 301.0, 0.5)
LINE = from_curvature(S, 0.012 * np.sin(S / 25.0))  # curvature at most .012 / m
START = FrenetState(20.0, 10.0, 0.0, 0.3)
SPEED = 10.0  # wanted [m/s]
FANS = {3000: (10, 6, 10, 5), 10000: (10, 10, 10, 10)}  # durations and ends along, durations and ends across
PLANNER = Planner()
WIDE = Limits(100.0, 50.0, 1e4, 50.0, 50.0, 10.0, 100.0)  # nothing is turned down for these


class Effort(NamedTuple):
    """How much to measure.

    scenes   of each sort, with seeds from 0 on
    repeats  of each timed call
    show     progress bars on the standard error
    """

    scenes: int
    repeats: int
    show: bool = False


FULL = Effort(scenes=120, repeats=40)
QUICK = Effort(scenes=12, repeats=8)


def vehicles(num_steps: int, step: float, number: int = 8, std: float = 0.2) -> Obstacles:
    """Before, beside and towards, along the line; each is placed with the same standard deviation [m]."""
    t, pose = step * np.arange(1, num_steps + 1), np.zeros((number, num_steps, 3))
    for m in range(number):
        towards = m % 2 == 1
        s = np.abs(45.0 + 12.0 * (m // 2) + (-9.0 if towards else 7.0) * t)
        offset = 3.6 if towards else (-3.4 if m % 4 == 0 else 1.2)
        pose[m, :, :2] = LINE.place(s, np.full(num_steps, offset))
        pose[m, :, 2] = LINE.at(s)[:, 2] + (math.pi if towards else 0.0)
    covariance = np.broadcast_to(std**2 * np.eye(2), (number, num_steps, 2, 2))
    return Obstacles(pose, np.tile([4.6, 1.9], (number, 1)), np.array(covariance), np.ones(number))


def scene(planner: Planner) -> Scene:
    """Boundary lines are found anew at every call, as in a cycle."""
    lines = [LINE.place(np.arange(0.0, 120.0), np.full(120, d)) for d in (-4.0, 6.0)]
    around = vehicles(planner.num_steps, planner.step)
    return Scene(LINE, START, Keep(SPEED), np.zeros(1), 0.0, boundary(lines, planner.radius), around)


def fan(planner: Planner, size: int) -> Candidates:
    """So many candidates, in order of their costs."""
    weights = Weights()
    times, speeds, across, offsets = FANS[size]
    T, v = (a.ravel() for a in np.meshgrid(np.linspace(1, 3, times), np.linspace(5, 15, speeds), indexing="ij"))
    ahead = quartics(START[:3], v, T)
    T, d = (a.ravel() for a in np.meshgrid(np.linspace(1, 3, across), np.linspace(-2.5, 2.5, offsets), indexing="ij"))
    aside = quintics(START.lateral, np.stack([d, 0 * d, 0 * d], -1), T)
    cost = weights.jerk * squared_jerk(aside) + weights.time * T + weights.across * d**2
    lateral = Lateral(aside, np.zeros(len(d), bool), d, cost)
    return combined(planner, Longitudinal(ahead, longitudinal_cost(ahead, Keep(SPEED), weights)), lateral)
