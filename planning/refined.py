"""Refined motions: constant jerk over stages and a polynomial to the end, and what came of a refinement."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning import optimal_problem as problem
from planning.candidates import Weights
from planning.frenet import FrenetState, to_poses
from planning.optimal_problem import ACROSS, TO_PLACE, TO_SPEED, Shape
from planning.planner import COMFORT
from planning.plans import Plan, forwards, state_of
from planning.polynomials import Polynomials, quartics, quintics, squared_jerk

Floats = NDArray[np.float64]


class Motion(NamedTuple):
    """Constant jerk over stages of `stage` seconds, then a polynomial; of which `gone` seconds are over.

    states (N + 1, 3), jerk (N,); price (N + 1,) of the squared jerk in each stage and in the tail; arrival  of the
    candidate that it was made from [s]"""

    stage: float
    states: Floats
    jerk: Floats
    tail: Polynomials
    price: Floats
    arrival: float
    gone: float = 0.0

    @property
    def horizon(self) -> float:
        """Where the tail begins [s]."""
        return len(self.jerk) * self.stage

    def end(self) -> tuple[float, float, float]:
        """q, q' at the tail's end, and when that is."""
        q, first = self.tail.end()[0]
        return float(q), float(first), self.horizon + float(self.tail.duration[0]) - self.gone

    def price_left(self, weights: Weights) -> float:
        """k_j int(price jerk^2) + k_t T of what is left."""
        ends = self.stage * np.arange(1.0, len(self.jerk) + 1.0)
        left = np.clip(ends - self.gone, 0.0, self.stage)
        tail = squared_jerk(self.tail.later(max(self.gone - self.horizon, 0.0)))[0]
        jerk = (self.price[:-1] * left * self.jerk**2).sum() + self.price[-1] * tail
        return float(weights.jerk * jerk + weights.time * max(self.arrival - self.gone, 0.0))

    def at(self, t: Floats) -> Floats:
        """q, q', q'' (K, 3) at times t (K,)."""
        t, n = t + self.gone, len(self.jerk)
        k = np.minimum((t / self.stage + 1e-9).astype(np.int64), n - 1)
        told = np.stack(problem.advance(self.states[k].T, [self.jerk[k]], t - k * self.stage), -1)  # type: ignore[arg-type]
        beyond = t > self.horizon
        told[beyond] = self.tail.at(t[beyond] - self.horizon)[0]
        return told


class Refined(NamedTuple):
    """What came of a refinement.

    plan      that it began from
    accepted  whether the refined motion is followed; if not, `why`: not converged, costs more, or what it breaks
    along, across  the refined motion, where the solver made one
    cost, candidate_cost  of both by the same functional; NaN without a motion
    solver    that made it, or that failed last; `iterations` of all solvers
    line_error  of the line as told to the solver [m]
    rest      whether the motion followed is what is left of the last one
    building  of problems that were met for the first time [s]
    """

    plan: Plan
    accepted: bool
    why: str
    along: Motion | None = None
    across: Motion | None = None
    cost: float = math.nan
    candidate_cost: float = math.nan
    solver: str = "none"
    converged: bool = False
    iterations: int = 0
    line_error: float = math.nan
    rest: bool = False
    building: float = 0.0

    @property
    def tier(self) -> str:
        """Of what is followed."""
        return COMFORT if self.accepted else self.plan.tier

    @property
    def clear(self) -> bool:
        """Whether what is followed breaks nothing within the horizon."""
        return self.accepted or self.plan.clear

    def states(self, t: list[float] | Floats) -> list[FrenetState]:
        """Where the vehicle is along the line at times t after the start."""
        if not self.accepted or self.along is None or self.across is None:
            return self.plan.states(t)
        given = np.asarray(t, float)
        along, across = forwards(self.along.at(given)), self.across.at(given)
        return [state_of(a, d) for a, d in zip(along, across, strict=True)]

    def trajectory(self, t: list[float] | Floats) -> Floats:
        """x, y, heading, speed, acceleration, curvature (K, 6) at times t after the start."""
        return to_poses(self.plan.line, self.states(t))


def motions(
    shape: Shape, given: dict[str, Floats], controls: Floats, arrivals: tuple[float, float]
) -> tuple[Motion, Motion]:
    """Along and across, from the start by the controls, and on to the ends that cost least."""
    states, ends = [given["start"]], given["ends"]
    for u in controls:
        states.append(np.array(problem.advance(list(states[-1]), list(u), shape.stage)))
    told, made = np.array(states), list[Motion]()
    for i, kind in enumerate((shape.kind, ACROSS)):
        part = told[:, 3 * i : 3 * i + 3]
        _, pace, left, price = own = ends[4 * i : 4 * i + 4]
        end = float(problem.closing(kind, shape.weights)(part[-1], own)[1])
        first = tuple(map(float, part[-1]))
        if kind == TO_SPEED:
            tail = quartics(first, [end], [left])
        else:
            tail = quintics(first, [[end, pace if kind == TO_PLACE else 0.0, 0.0]], [left])
        made.append(Motion(shape.stage, part, controls[:, i], tail, np.r_[given["price"][i], price], arrivals[i]))
    return made[0], made[1]


def moved(motion: Motion, by: float) -> Motion:
    """The same from another origin."""
    states, coefficients = motion.states.copy(), motion.tail.coefficients.copy()
    states[:, 0] += by
    coefficients[:, 0] += by
    return motion._replace(states=states, tail=motion.tail._replace(coefficients=coefficients))
