"""The closed loop: what is seen becomes a plan every cycle, control drives along it, and the world goes on.

    tracks of the road users, with noise -> situation, decisions, behaviour -> planner -> control -> vehicle

What is followed is the plan, or what optimal control makes of it (planning.optimal) where that is asked for.

A plan begins where what is followed says the vehicle is now, so that plans agree with one another, unless the vehicle
is farther from there than a tolerance: then where it is. Nothing raises once the vehicle moves: a cycle that cannot be
planned is an emergency stop along what was followed last, and told.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.driving import Body, DriveScene, check, observe
from inference.progress import Progress
from models.program import InputError
from planning.control import Command, Control, Lags, command, moved
from planning.frenet import FrenetState, Pose, to_frenet, to_pose
from planning.optimal import refine
from planning.planner import EMERGENCY, Planner, plan
from planning.plans import Plan
from planning.polynomials import quartics, quintics
from planning.refined import Refined
from planning.road import Route, Tracks, route
from planning.scene import Scene as PlanScene
from planning.shapes import Vehicle

Floats = NDArray[np.float64]
SHORTEST = 0.3  # of a lateral motion to its end along an emergency stop [m]


@dataclass(frozen=True)
class Loop:
    """Settings; a cycle takes as long as the planner's end times are apart (planning.candidates.Fans.cycle).

    world      between movements of other road users, and between looks for contact [s]
    tolerance  from what is followed, within which the next plan begins on it [m]
    refine     whether refined plans are followed; of an emergency stop, only the rest of the last refined motion is
    control    and the time constants the vehicle really has
    """

    world: float = 0.05
    tolerance: float = 0.3
    refine: bool = False
    control: Control = field(default_factory=Control)
    lags: Lags = field(default_factory=Lags)

    def __post_init__(self) -> None:
        for name in ("world", "tolerance"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"loop: {name} is {getattr(self, name)}, but must be positive and finite")
        _multiple("world", self.world, "control.step", self.control.step)


def _multiple(name: str, long: float, of: str, short: float) -> None:
    if not math.isfinite(long / short) or abs(long / short - round(long / short)) > 1e-9:
        raise InputError(f"loop: {name} is {long} s, but must be a multiple of {of}, {short} s")


class Thought(NamedTuple):
    """What a cycle plans in, and what was thought on the way, in words."""

    given: PlanScene
    words: str = ""


Mind = Callable[[float, FrenetState, Tracks], Thought]  # time [s], where to plan from, what is seen -> Thought


class Log(NamedTuple):
    """What was driven, N steps of control; what others did, K looks of A; what was thought, C cycles.

    time, ego        (N + 1,) [s], (N + 1, 6) x, y, heading, speed, acceleration, curvature of the rear axle
    wanted, command  (N + 1, 6) the same by plan; (N + 1, 2) acceleration, curvature
    looked, others   (K,) [s], (K, A, 5) x, y, heading, speed, acceleration of middles, NaN where they are not there
    cycle            (C,) [s]
    ms               (C,) of a cycle up to what is followed, without building problems of optimal control
    building         (C,) these, once each [s]
    tier, clear      (C,) of what is followed
    cost, plan_cost  (C,) of what is followed, and of the plan
    refined          (C,) whether a refined motion is followed
    unrefined        (C,) why none is, where one was asked for, else nothing
    planned          (C, H, 6) what is followed, from its time on
    consistency      (C,) largest distance from what was followed before, NaN where there is nothing [m]
    stop             (C,) arc length that the front must not pass [m]
    goal             (C,) place, speed of what was aimed at behind or before; place NaN where only a speed was
    words, stated    (C,) what was thought; why a cycle could not be planned, else nothing
    """

    time: Floats
    ego: Floats
    wanted: Floats
    command: Floats
    looked: Floats
    others: Floats
    cycle: Floats
    ms: Floats
    building: Floats
    tier: NDArray[np.str_]
    clear: NDArray[np.bool_]
    cost: Floats
    plan_cost: Floats
    refined: NDArray[np.bool_]
    unrefined: NDArray[np.str_]
    planned: Floats
    consistency: Floats
    stop: Floats
    goal: Floats
    words: NDArray[np.str_]
    stated: NDArray[np.str_]


class Drive(NamedTuple):
    """A drive: its log, and what each cycle planned in and planned, before refinement."""

    scene: DriveScene
    route: Route
    planner: Planner
    log: Log
    given: list[PlanScene]
    plans: list[Plan]


def drive(
    scene: DriveScene,
    mind: Callable[[DriveScene, Route, Planner], Mind],
    planner: Planner = Planner(),
    loop: Loop = Loop(),
    *,
    seed: int = 0,
    progress: bool = False,
) -> Drive:
    """Drive through a scene, with a bar where that takes long and `progress` is asked for. Candidates are let go.

    Raises InputError for a scene that cannot be begun (a route that is none, a vehicle off it, no time to drive), for
    a driver that is none, and for time steps that do not fit into one another."""
    check(scene)
    cycle = planner.fans.cycle
    if not cycle <= scene.duration < math.inf:
        raise InputError(f"scene {scene.name}: duration is {scene.duration} s, but must be a cycle, {cycle} s, or more")
    _multiple("cycle", cycle, "world", loop.world)
    _multiple("cycle", cycle, "planner.step", planner.step)
    if planner.horizon < cycle:
        raise InputError(f"planner: horizon is {planner.horizon} s, but must be a cycle, {cycle} s, or more")
    if seed < 0:
        raise InputError(f"seed is {seed}, but must be 0 or more")
    way = route(scene.lanes, scene.route)
    think = mind(scene, way, planner)
    if not callable(think):
        raise InputError(f"the driver gave a {type(think).__name__}; return a mind, (time, state, tracks) -> Thought")
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    others: list[Pose | None] = [None] * len(scene.actors)
    others = _others(scene, planner.vehicle, 0.0, 0.0, others, scene.ego)
    ego, given = scene.ego, None
    made: Plan | None = None
    better: Refined | None = None
    followed: Plan | Refined | None = None
    driven: list[tuple[Pose, Pose, Command]] = []
    looks, cycles, givens, plans = [others], [], [], []
    per_look = round(loop.world / loop.control.step)
    horizon, gone = planner.step * np.arange(planner.num_steps + 1, dtype=np.float64), round(cycle / planner.step)
    planned: list[Floats] = []
    num_cycles = round(scene.duration / cycle)
    with Progress("driving", num_cycles, progress) as bar:
        for number in range(num_cycles):
            now, began, stated, words = number * cycle, time.perf_counter(), "", ""
            tracks = observe(scene, others, rng)
            try:
                state = _start(way, ego, followed, cycle, loop.tolerance)
                given, words = _thought(think(now, state, tracks))
                found = plan(planner, given, made, cycle)._replace(candidates=None)
                if loop.refine:
                    better = refine(planner, given, found, better, cycle, solve=found.tier != EMERGENCY)
            except InputError as error:
                if followed is None or given is None:
                    raise
                stated = str(error)
                found, better = stop_along(planner, followed, cycle), None
            made, followed = found, found if better is None or not better.accepted else better
            building, why = (0.0, "") if better is None else (better.building, "" if better.accepted else better.why)
            ms = 1e3 * (time.perf_counter() - began - building)
            planned.append(followed.trajectory(horizon))
            apart = math.nan if number == 0 else _apart(planned[-1][:-gone], planned[-2][gone:])
            cycles.append((now, ms, building, found, followed, why, apart, given.stop, _aim(given), words, stated))
            givens.append(given)
            plans.append(found)
            poses = [Pose(*row) for row in followed.trajectory(np.arange(0.0, cycle + 1e-9, loop.control.step))]
            for k, (wanted, after) in enumerate(pairwise(poses), start=1):
                told = command(loop.control, planner.able, ego, wanted, after)
                driven.append((ego, wanted, told))
                ego = moved(loop.lags, ego, told, loop.control.step)
                if k % per_look == 0:
                    others = _others(scene, planner.vehicle, now + k * loop.control.step, loop.world, others, ego)
                    looks.append(others)
            bar.advance(1)
    driven.append((ego, poses[-1], told))
    return Drive(scene, way, planner, _log(scene, loop, driven, looks, cycles, planned), givens, plans)


def _thought(found: Any) -> Thought:
    """What a driver made of a cycle. Raises InputError where it is something else."""
    if not isinstance(found, Thought):
        raise InputError(f"the driver answered with a {type(found).__name__}; return experiments.closed_loop.Thought")
    if not isinstance(found.given, PlanScene):
        given = type(found.given).__name__
        raise InputError(f"the driver would have a {given} planned in; give planning.scene.Scene in its Thought")
    return found


def stop_along(planner: Planner, last: Plan | Refined, elapsed: float) -> Plan:
    """From where a motion is after a time, to rest as hard as the vehicle can along the motion's own path.

    A quartic from v to rest in T brakes by 3 v / 2 T at most (from a = 0)."""
    state = last.states([elapsed])[0]
    duration = np.array([max(1.5 * state.ds / planner.able.braking, planner.fans.cycle)])
    begun = last.plan if isinstance(last, Refined) else last
    lateral, refined = begun.lateral, last.across if isinstance(last, Refined) and last.accepted else None
    if refined is None and lateral.by_way[0]:
        lateral = lateral._replace(motion=lateral.motion.later(state.s - begun.start.s))
    else:
        target, end = float(lateral.target[0]), float(lateral.motion.duration[0])
        if refined is not None:
            target, _, end = refined.end()
        way = max(last.states([max(end, elapsed)])[0].s - state.s, SHORTEST)
        across = quintics((state.d, state.slope, state.bend), [[target, 0.0, 0.0]], [way])
        lateral = lateral._replace(motion=across, by_way=np.array([True]), target=np.array([target]))
    motion = quartics((state.s, state.ds, state.dds), [0.0], duration)
    return begun._replace(
        start=state, longitudinal=motion, lateral=lateral, tier=EMERGENCY, clear=False, cost=math.inf, rejected={}
    )


def middle_of(vehicle: Vehicle, pose: Pose) -> Pose:
    """Of a vehicle whose rear axle is at a pose."""
    x, y = pose.x + vehicle.middle * math.cos(pose.heading), pose.y + vehicle.middle * math.sin(pose.heading)
    return pose._replace(x=x, y=y)


def _start(way: Route, ego: Pose, last: Plan | Refined | None, elapsed: float, tolerance: float) -> FrenetState:
    """Where to plan from: on what was followed, or where the vehicle is."""
    if last is None:
        return to_frenet(way.line, ego)
    state = last.states([elapsed])[0]
    there = to_pose(way.line, state)
    if math.hypot(ego.x - there.x, ego.y - there.y) <= tolerance:
        return state
    return to_frenet(way.line, ego, state.s)


def _apart(one: Floats, other: Floats) -> float:
    return float(np.hypot(*(one - other)[:, :2].T).max())


def _aim(given: PlanScene) -> tuple[float, float]:
    goal = given.goal
    return getattr(goal, "place", math.nan), goal.speed


def _others(
    scene: DriveScene, vehicle: Vehicle, now: float, step: float, before: Sequence[Pose | None], ego: Pose
) -> list[Pose | None]:
    """Where the actors are, each having looked at the others and at the ego vehicle."""
    bodies = [None if b is None else Body(b, actor.size) for actor, b in zip(scene.actors, before, strict=True)]
    own = Body(middle_of(vehicle, ego), (vehicle.length, vehicle.width))
    return [
        actor.moved(now, step, before[k], [own, *(b for n, b in enumerate(bodies) if b is not None and n != k)])
        for k, actor in enumerate(scene.actors)
    ]


def _log(
    scene: DriveScene,
    loop: Loop,
    driven: list[tuple[Pose, Pose, Command]],
    looks: list[list[Pose | None]],
    cycles: list[tuple[Any, ...]],
    planned: list[Floats],
) -> Log:
    others = np.full((len(looks), len(scene.actors), 5), math.nan)
    for k, look in enumerate(looks):
        for n, pose in enumerate(look):
            if pose is not None:
                others[k, n] = pose[:5]
    now, ms, building, plans, followed, why, apart, stop, aim, words, stated = zip(*cycles, strict=True)
    ego, wanted, told = (np.array(column, float) for column in zip(*driven, strict=True))
    return Log(
        time=loop.control.step * np.arange(len(driven), dtype=np.float64),
        ego=ego,
        wanted=wanted,
        command=told,
        looked=loop.world * np.arange(len(looks), dtype=np.float64),
        others=others,
        cycle=np.array(now),
        ms=np.array(ms),
        building=np.array(building),
        tier=np.array([motion.tier for motion in followed]),
        clear=np.array([motion.clear for motion in followed]),
        cost=np.array([motion.cost for motion in followed]),
        plan_cost=np.array([found.cost for found in plans]),
        refined=np.array([isinstance(motion, Refined) for motion in followed]),
        unrefined=np.array(why),
        planned=np.stack(planned),
        consistency=np.array(apart),
        stop=np.array(stop),
        goal=np.array(aim),
        words=np.array(words),
        stated=np.array(stated),
    )
