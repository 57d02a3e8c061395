"""One planning cycle: candidates, cheapest first, judged until one is good; there is always an answer.

    comfort      the cheapest candidate within the vehicle's comfortable limits, clear of everything
    relaxed      the same within what the vehicle can do
    emergency    a stop: the cheapest that is clear, else the one that does least harm

A vehicle at rest where it may be stays there, comfortably, if it finds nothing good, even where others may come and
touch it: `clear` tells.

[K15], section IV-C: horizon 3 s, 20 Hz, every 150 ms; |a_lat| <= 2 m/s^2.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from planning import candidates
from planning.candidates import Fans, Keep, Lateral, Longitudinal, Weights
from planning.frenet import FrenetState, to_pose
from planning.kinematics import LIMITS, Limits
from planning.plans import SLOWEST, Candidates, Plan
from planning.polynomials import Polynomials, quartics
from planning.scene import Scene, check
from planning.shapes import Vehicle

Floats = NDArray[np.float64]
COMFORT, RELAXED, EMERGENCY = "comfort", "relaxed", "emergency"
ON_PLAN = 1e-9  # [m, s] between the vehicle and its last plan, for the rest of that plan to be a candidate
ANY = Limits(*(1e9,) * 7)  # no limits but those of geometry
MOST_STEPS = 10_000
AT_REST = 1e-3  # [m/s] below which a vehicle stands
FAR = 0.05  # of an equal share of the risk, for road users that a candidate does not come near to


@dataclass(frozen=True)
class Planner:
    """Settings of a planner.

    horizon, step   [s] of what is judged
    comfort, able   limits of ordinary plans, and of what the vehicle can do at all
    risk            allowed probability of touching other road users within a plan, shared among them
    margin          kept clear around the vehicle, of boundary lines and of road users [m]
    """

    vehicle: Vehicle = field(default_factory=Vehicle)
    comfort: Limits = field(default_factory=Limits)
    able: Limits = field(
        default_factory=lambda: Limits(
            speed=60.0, acceleration=4.0, braking=8.0, lateral_acceleration=5.0, curvature_rate=0.4
        )
    )
    weights: Weights = field(default_factory=Weights)
    fans: Fans = field(default_factory=Fans)
    horizon: float = 3.0
    step: float = 0.05
    risk: float = 1e-3
    margin: float = 0.1

    def __post_init__(self) -> None:
        for name in ("horizon", "step", "risk"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"planner: {name} is {getattr(self, name)}, but must be positive and finite")
        if self.horizon / self.step > MOST_STEPS or self.num_steps < 1:
            raise InputError(
                f"planner: a horizon of {self.horizon} s has no step of {self.step} s, or more than {MOST_STEPS}"
            )
        if self.risk >= 1.0:
            raise InputError(f"planner: risk is {self.risk}, but is a probability below 1")
        for name in (*LIMITS, "curvature_rate"):
            if getattr(self.able, name) < getattr(self.comfort, name):
                raise InputError(
                    f"planner: comfort.{name} is {getattr(self.comfort, name)}, more than the vehicle can: "
                    f"able.{name} is {getattr(self.able, name)}"
                )
        if not 0.0 <= self.margin < math.inf:
            raise InputError(f"planner: margin is {self.margin}, but must be 0 or more and finite [m]")

    @property
    def num_steps(self) -> int:
        return round(self.horizon / self.step)

    @property
    def radius(self) -> float:
        """Of the vehicle's circles with their margin [m]."""
        return self.vehicle.radius + self.margin


def plan(
    planner: Planner, scene: Scene, previous: Plan | None = None, elapsed: float = 0.0, *, all_reasons: bool = False
) -> Plan:
    """The plan of a cycle.

    previous, elapsed  the last plan on the same line and the time since its start [s]: its rest is a candidate
    all_reasons        judge every candidate, not only those cheaper than the best: for pictures

    Raises InputError for a scene that is not one (shapes, NaN, driving backwards), and for a last plan that is none;
    anything else is answered with a plan."""
    from planning.check_kernel import GOOD, OBSTACLE, ON_LIMITS

    check(scene, planner.radius, planner.num_steps)
    if not (previous is None or isinstance(previous, Plan)) or not 0.0 <= elapsed < math.inf:
        raise InputError(
            f"the previous plan is a {type(previous).__name__}, {elapsed} s ago; give a Plan and 0 s or more"
        )
    made = candidates_of(planner, scene, previous, elapsed)
    judged = judge(planner, scene, made, planner.comfort, first_good=not all_reasons)
    if judged.best < 0 and scene.state.ds >= planner.fans.slow:
        made = candidates_of(planner, scene, previous, elapsed, both=True)
        judged = judge(planner, scene, made, planner.comfort, first_good=not all_reasons)
    rejected = turned_down(judged)
    if judged.best >= 0:
        return chosen(scene, judged, judged.best, COMFORT, rejected)
    again = judged.order[np.isin(judged.reason[judged.order], ON_LIMITS)]
    relaxed = judge(planner, scene, made._replace(order=again), planner.able)
    if relaxed.best >= 0:
        return chosen(scene, judged._replace(best=relaxed.best), relaxed.best, RELAXED, rejected)
    stops = judge(planner, scene, emergency_stops(planner, scene, previous, elapsed), planner.able, first_good=False)
    best = stops.best if stops.best >= 0 else least_harm(planner, scene, stops)
    stays = abs(scene.state.ds) < AT_REST and stops.reason[best] in (GOOD, OBSTACLE)
    return chosen(scene, stops, best, COMFORT if stays else EMERGENCY, rejected)


def candidates_of(
    planner: Planner, scene: Scene, previous: Plan | None = None, elapsed: float = 0.0, *, both: bool = False
) -> Candidates:
    """All motions of a scene, and the rest of the previous plan if the vehicle is where that plan wanted it.

    both  at speed, too, lateral motions told by the way: those told by time, that go on when the vehicle stands, turn
          on the spot where it brakes hard"""
    rest = _rest(scene, previous, elapsed)
    ahead = candidates.longitudinal(
        _started(scene.state), scene.goal, planner.fans, planner.weights, None if rest is None else rest[0]
    )
    across = _across(planner, scene, None if rest is None else rest[1], both)
    return combined(planner, ahead, across)


def _across(planner: Planner, scene: Scene, rest: Lateral | None, both: bool) -> Lateral:
    """Motions to the offsets; at speed, too, `both` those told by time and by the way."""
    state, fans = scene.state, planner.fans
    across = candidates.lateral(state, scene.offsets, scene.wanted, fans, planner.weights, rest)
    if not both or state.ds < fans.slow:
        return across
    pace = state.ds / fans.slow
    steady = replace(fans, ways=tuple(pace * way for way in fans.ways), slow=math.nextafter(state.ds, math.inf))
    return candidates.lateral(state, scene.offsets, scene.wanted, steady, planner.weights, across)


def emergency_stops(planner: Planner, scene: Scene, previous: Plan | None, elapsed: float) -> Candidates:
    """Stops within what the vehicle can do, from as hard as that on, on lateral motions told by time and by the way.

    A quartic from speed v and acceleration a to rest in T brakes by (3 v + a T)^2 / (3 T (2 v + a T)) at most, which is
    b at T = 3 v / (b - a + sqrt(b (b + a))); where a < 0 it stays positive up to T = 3 v / -a. A path that is told by
    the way is the same however hard one brakes on it."""
    state, rest, braking = _started(scene.state), _rest(scene, previous, elapsed), planner.able.braking
    v, a = max(state.ds, SLOWEST), min(max(state.dds, -braking), braking)
    shortest = 3.0 * v / (braking - a + math.sqrt(braking * (braking + a)))
    longest = 3.0 * v / max(-state.dds, 1e-9)
    duration = np.unique(np.minimum(shortest * np.array([1.0, 1.05, 1.15, 1.4, 1.8, 2.5, 4.0]), longest))
    motion = quartics((state.s, state.ds, state.dds), np.zeros_like(duration), duration)
    ahead = Longitudinal(motion, candidates.longitudinal_cost(motion, Keep(0.0), planner.weights))
    across = _across(planner, scene._replace(state=state), None if rest is None else rest[1], True)
    return combined(planner, ahead, across)


def judge(planner: Planner, scene: Scene, made: Candidates, limits: Limits, *, first_good: bool = True) -> Candidates:
    """Candidates with reasons, cheapest first, up to the first good one, where a reason is one that holds; unless
    `first_good` all of them, each with what it breaks first."""
    from planning import check_kernel as kernel

    dt = planner.step
    ahead = np.empty((len(made.longitudinal.cost), 9, planner.num_steps))
    kernel.along_line(*made.longitudinal.motion, scene.line.table, scene.line.step, dt, ahead)
    across = np.empty((len(made.lateral.cost), 3, planner.num_steps))
    kernel.across_line(*made.lateral.motion, dt, across)
    lateral = made.lateral
    best, reason, when = _judged(
        planner, scene, limits, made.order, ahead, across, lateral.by_way, lateral.motion, first_good
    )
    return made._replace(best=best, reason=reason, when=when)


def judge_states(planner: Planner, scene: Scene, along: Floats, across: Floats, limits: Limits) -> tuple[str, int]:
    """Why a motion is bad (a word of planning.check_kernel.REASONS, "none" where it is good) and at which step.

    along, across  (K, 3): s, s', s'' and d, d', d'' at the horizon's steps without the first"""
    from planning import check_kernel as kernel

    ahead = np.empty((1, 9, planner.num_steps))
    ahead[0, :3] = along.T
    kernel.add_line(scene.line.table, scene.line.step, ahead)
    unused = Polynomials(np.zeros((1, 6)), np.zeros(1))  # coefficients: only of motions told by the way
    order, by_way = np.zeros(1, np.int64), np.zeros(1, np.bool_)
    told = np.ascontiguousarray(across.T)[None]
    _, reason, when = _judged(planner, scene, limits, order, ahead, told, by_way, unused, False)
    return kernel.REASONS[reason[0]], int(when[0])


def _judged(
    planner: Planner,
    scene: Scene,
    limits: Limits,
    order: NDArray[np.int64],
    ahead: Floats,
    across: Floats,
    by_way: NDArray[np.bool_],
    ways: Polynomials,
    first_good: bool,
) -> tuple[int, NDArray[np.int64], NDArray[np.int64]]:
    """The first good one, or -1; reason and when of all."""
    from planning import check_kernel as kernel

    vehicle = planner.vehicle
    count = len(ahead) * len(across)
    reason, when = np.full(count, -1), np.zeros(count, np.int64)
    best = kernel.judge(
        order,
        ahead,
        across,
        by_way,
        *ways,
        np.array([scene.state.s, to_pose(scene.line, scene.state).curvature]),
        planner.step,
        np.array([getattr(limits, name) for name in LIMITS]),
        limits.curvature_rate,
        scene.line.length,
        scene.stop - vehicle.front,
        scene.stand - vehicle.front,
        limits.braking,
        tuple(scene.boundary[:6]),
        *uncertain(planner, scene),
        vehicle.middle,
        vehicle.circles,
        planner.radius,
        first_good,
        reason,
        when,
    )
    return best, reason, when


def rectangles(planner: Planner, scene: Scene, part: float = 1.0) -> Floats:
    """The obstacles' table, with this part of the planner's risk shared among them in equal shares."""
    vehicle = planner.vehicle
    reach = math.hypot(vehicle.length / 2, vehicle.width / 2) + planner.radius  # generous: circles stand out
    each = part * planner.risk / max(len(scene.obstacles.probability), 1)
    return scene.obstacles.table(each, planner.radius, reach)


def uncertain(planner: Planner, scene: Scene) -> tuple[Floats, tuple[float, Floats, Floats, Floats]]:
    """Rectangles and chances of planning.check_kernel.first_rectangle: each candidate has the whole risk for those that
    it comes near to, less FAR of an equal share for any other. What is clear with equal shares is so here, too."""
    from scipy.special import ndtri

    told, chance = rectangles(planner, scene, FAR), scene.obstacles.probability
    each = FAR * planner.risk / max(len(chance), 1)
    likely = chance[chance > each]
    risk = planner.risk - each * (len(chance) - len(likely))
    alone = -ndtri(np.minimum(risk / likely, 1.0))
    return told, (risk, likely, alone, np.full(len(likely), each))


def turned_down(judged: Candidates) -> dict[str, int]:
    """{reason: how many candidates cheaper than the best were turned down for it}"""
    from planning.check_kernel import REASONS

    rank = np.flatnonzero(judged.order == judged.best)
    cheaper = judged.order[: rank[0]] if len(rank) else judged.order
    return dict(Counter(REASONS[reason] for reason in judged.reason[cheaper]).most_common())


def _rest(scene: Scene, previous: Plan | None, elapsed: float) -> tuple[Polynomials, Lateral] | None:
    """What is left of the previous plan, where the vehicle is on it and its line is this one."""
    if previous is None or previous.line.table is not scene.line.table:
        return None
    planned = previous.states([elapsed])[0]
    if not np.allclose(planned, scene.state, rtol=0.0, atol=ON_PLAN):
        return None
    lateral = previous.lateral
    gone = planned.s - previous.start.s if lateral.by_way[0] else elapsed
    return previous.longitudinal.later(elapsed), lateral._replace(motion=lateral.motion.later(gone))


def _started(state: FrenetState) -> FrenetState:
    """At rest nothing brakes: a small deceleration that is measured there would forbid every motion as backwards."""
    return state._replace(dds=max(state.dds, 0.0)) if state.ds < SLOWEST else state


def combined(planner: Planner, ahead: Longitudinal, across: Lateral) -> Candidates:
    weights = planner.weights
    cost = (weights.longitudinal * ahead.cost[:, None] + weights.lateral * across.cost).ravel()
    unseen = np.full(cost.size, -1)
    return Candidates(ahead, across, cost, np.argsort(cost, kind="stable"), unseen, unseen, -1)


def least_harm(planner: Planner, scene: Scene, judged: Candidates) -> int:
    """Of stops that are all bad: one that can be driven, then the slowest where it touches something or leaves the line
    (0 where it does not: passing a stop point touches nothing), then the shortest, then the cheapest."""
    from planning.check_kernel import END_OF_LINE, GOOD

    passing = judge(planner, scene._replace(stop=math.inf, stand=math.inf), judged, ANY, first_good=False)
    told = judged.longitudinal.motion.at(planner.step * np.arange(1, planner.num_steps + 2))
    i = np.arange(judged.cost.size) // len(judged.lateral.cost)
    speed = np.where(passing.reason < END_OF_LINE, math.inf, told[i, passing.when, 1])
    speed[passing.reason == GOOD] = 0.0
    driven = (judged.reason == GOOD) | (judged.reason >= END_OF_LINE)
    return int(np.lexsort((judged.cost, told[i, -1, 0], speed, ~driven))[0])


def chosen(scene: Scene, judged: Candidates, best: int, tier: str, rejected: dict[str, int]) -> Plan:
    """The plan that is candidate `best`."""
    i, j = divmod(best, len(judged.lateral.cost))
    ahead = judged.longitudinal.motion.take([i])
    across = Lateral(
        judged.lateral.motion.take([j]),
        judged.lateral.by_way[[j]],
        judged.lateral.target[[j]],
        judged.lateral.cost[[j]],
    )
    cost = float(judged.cost[best])
    return Plan(scene.line, scene.state, ahead, across, tier, judged.best >= 0, cost, rejected, judged)
