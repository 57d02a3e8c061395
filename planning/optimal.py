"""A plan made better by optimal control: the same costs and limits, all motions instead of a fan of polynomials.

    found = plan(planner, scene, previous, elapsed)
    better = refine(planner, scene, found, better, elapsed)     # better.states(t), better.trajectory(t): to follow

The problem is that of planning.optimal_problem, solved by fatrop (an interior-point method for problems in stages) and,
where that fails, by IPOPT, from the candidate. What comes out is judged step by step by the code that judges
candidates, on the exact line, with obstacles and boundary lines as they are. It is followed only if it is good within
the limits of comfort and costs no more than the candidate; else the candidate stays.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning import optimal_problem as problem
from planning.candidates import Keep, Reach
from planning.corridor import corridor
from planning.frenet import to_pose
from planning.kinematics import LIMITS, PLACED
from planning.optimal_problem import CURVATURE, PLACE, TO_PLACE, TO_SPEED, Shape
from planning.planner import (
    COMFORT,
    EMERGENCY,
    ON_PLAN,
    RELAXED,
    Planner,
    candidates_of,
    chosen,
    judge,
    judge_states,
    rectangles,
)
from planning.plans import Plan
from planning.polynomials import NOTHING
from planning.reference import ReferenceLine
from planning.refined import Motion, Refined, motions, moved
from planning.scene import Scene
from planning.shapes import OUTLINE, outlines

Floats = NDArray[np.float64]
PER_STAGE = 2  # of the planner's steps
DEAR = 10.0  # price of jerk after the time at which the candidate arrives
OBSTACLES = (0, 1, 2, 3, 5, 8)  # problems are built for so many; only the nearest are told to it
NEAR = 1.1  # OUTLINE at the candidate: farther ones are left to the check
FREE = (2.0, 8.0)  # how far the motion may be ahead of or behind the candidate, at once and more at the horizon [m]
SOONEST = 0.45  # [s] after the horizon that the candidate's end is kept; nearer ones are put off: all but a constraint
NODES = 14  # of the line in a stage's stretch
SHORT = 1e-3  # of the last place allowed [m]
STAY = 0.02  # by which the rest of the last motion may cost more than the best one found now
DEARER = "costs more"
UNSOLVED = "not looked for"
FAR = 1e3  # [m], of what is not there


def refine(
    planner: Planner,
    scene: Scene,
    found: Plan,
    previous: Refined | None = None,
    elapsed: float = 0.0,
    *,
    per_stage: int = PER_STAGE,
    solve: bool = True,
) -> Refined:
    """The plan of this scene, or a better motion: it costs no more, or it is comfortable where no candidate was.

    previous, elapsed  the last refinement, if the vehicle follows it, and the time since its start [s]
    per_stage          of the planner's steps, in which jerk is constant
    solve              whether a motion is looked for; else only the rest of the last one, if it is good

    A horizon that recedes finds another best motion in every cycle. So what is left of the last one is followed as long
    as it is good, costs no more than the candidate, and no more than STAY beyond the best motion found now.
    Nothing is raised for what a solver does: the candidate stays."""
    try:
        told = _refined(planner, scene, found, per_stage) if solve else Refined(found, False, UNSOLVED)
    except (RuntimeError, ArithmeticError, np.linalg.LinAlgError) as failure:  # CasADi raises RuntimeError
        told = Refined(found, False, f"the solver failed: {failure}")
    rest = _rest(planner, scene, found, previous, elapsed)
    if rest is None or (told.accepted and rest.cost > (1.0 + STAY) * told.cost):
        return told
    return rest._replace(iterations=told.iterations, building=told.building)


def _rest(planner: Planner, scene: Scene, found: Plan, previous: Refined | None, elapsed: float) -> Refined | None:
    """What is left of the last refined motion, by today's targets, where it is good and costs no more than the plan."""
    if previous is None or previous.along is None or previous.across is None or not previous.accepted:
        return None
    if previous.plan.line.table is not scene.line.table:
        return None
    if not np.allclose(previous.states([elapsed])[0], scene.state, rtol=0.0, atol=ON_PLAN):
        return None
    along = previous.along._replace(gone=previous.along.gone + elapsed)
    across = previous.across._replace(gone=previous.across.gone + elapsed)
    weights, (place, speed, when), (offset, _, _) = planner.weights, along.end(), across.end()
    off = scene.goal.costs(np.array(place), np.array(speed), np.array(max(when, 0.0)))
    cost = weights.longitudinal * (along.price_left(weights) + weights.along * float(off))
    cost += weights.lateral * (across.price_left(weights) + weights.across * (offset - scene.wanted) ** 2)
    if when < 0.0 or _broken(planner, scene, along, across) != "none" or (found.tier == COMFORT and cost > found.cost):
        return None
    return previous._replace(plan=found, along=along, across=across, cost=cost, candidate_cost=found.cost, rest=True)


def _broken(planner: Planner, scene: Scene, along: Motion, across: Motion) -> str:
    """What a motion breaks, or "none"."""
    t = planner.step * np.arange(1.0, planner.num_steps + 1.0)
    return judge_states(planner, scene, along.at(t), across.at(t), planner.comfort)[0]


def _refined(planner: Planner, scene: Scene, found: Plan, per_stage: int) -> Refined:
    begun = found if found.tier != EMERGENCY else _least_bad(planner, scene)
    if begun.lateral.by_way[0]:
        return Refined(found, False, "near standstill, offsets are told by the way")
    if begun.along(planner.step * np.arange(planner.num_steps + 1.0))[:, 1].min() < problem.SLOWEST:
        return Refined(found, False, "comes near standstill, where directions are undefined")
    shape, given, error = _posed(planner, scene, begun, per_stage)
    stages = shape.stage * np.arange(shape.num_stages + 1.0)
    guess = _packed(_from_start(begun, stages), shape.stage)
    told, iterations, building = Refined(found, False, "not converged", line_error=error), 0, 0.0
    for fine in (False, True):
        shape = shape._replace(fine=fine)
        solved = _solved(shape, given, guess)
        iterations += solved.iterations
        building += solved.building
        if not solved.converged:
            told = told._replace(solver=solved.solver)
            break
        told = _judged(planner, scene, found, begun, shape, given, solved, error)
        if told.accepted or told.why == DEARER:
            break
    return told._replace(iterations=iterations, building=building)


class _Solved(NamedTuple):
    controls: Floats
    cost: float
    converged: bool
    solver: str
    iterations: int
    building: float


def _solved(shape: Shape, given: dict[str, Floats], guess: Floats) -> _Solved:
    """By fatrop, else by IPOPT."""
    began = time.perf_counter()
    built = problem.problem(shape)
    building = time.perf_counter() - began
    parameters = np.concatenate([given[name].reshape(size).ravel("F") for name, size in built.parameters.items()])
    iterations = 0
    for name in problem.SOLVERS:
        began = time.perf_counter()
        solve = problem.solver(shape, name)
        building += time.perf_counter() - began
        result = solve(x0=guess, p=parameters, lbg=built.lower, ubg=built.upper)
        stats = solve.stats()
        iterations += int(stats["iter_count"])
        if stats["success"]:
            break
    controls = np.asarray(result["x"]).ravel()[:-6].reshape(-1, 8)[:, 6:]
    return _Solved(controls, float(result["f"]), bool(stats["success"]), name, iterations, building)


def _judged(
    planner: Planner,
    scene: Scene,
    found: Plan,
    begun: Plan,
    shape: Shape,
    given: dict[str, Floats],
    solved: _Solved,
    error: float,
) -> Refined:
    """Whether a solution is followed."""
    arrivals = float(begun.longitudinal.duration[0]), float(begun.lateral.motion.duration[0])
    along, across = motions(shape, given, solved.controls, arrivals)
    weights = planner.weights
    cost = solved.cost + weights.time * (weights.longitudinal * arrivals[0] + weights.lateral * arrivals[1])
    along = moved(along, scene.state.s)
    why = _broken(planner, scene, along, across)
    if why == "none" and found.tier == COMFORT and not cost <= found.cost:
        why = DEARER
    return Refined(found, why == "none", why, along, across, cost, begun.cost, solved.solver, True, 0, error)


def _least_bad(planner: Planner, scene: Scene) -> Plan:
    """Of all candidates, the one that breaks what the vehicle can do latest, then the cheapest."""
    judged = judge(planner, scene, candidates_of(planner, scene), planner.able, first_good=False)
    best = int(np.lexsort((judged.cost, -judged.when))[0])
    return chosen(scene, judged, best, RELAXED, {})


def _from_start(begun: Plan, t: Floats) -> Floats:
    """s, s', s'', d, d', d'' (K, 6) of a plan at times t, s from its start on."""
    told = np.hstack([begun.along(t), begun.lateral.motion.at(t)[0]])
    told[:, 0] -= begun.start.s
    return told


def _packed(states: Floats, stage: float) -> Floats:
    """The decision variables of states (N + 1, 6), with mean jerks between them."""
    jerks = np.diff(states[:, [2, 5]], axis=0) / stage
    return np.concatenate([np.hstack([states[:-1], jerks]).ravel(), states[-1]])


def _posed(planner: Planner, scene: Scene, begun: Plan, per_stage: int) -> tuple[Shape, dict[str, Floats], float]:
    """The shape of a plan's problem, its parameters by name, and the error of the line as told to it [m]."""
    num_stages = -(-planner.num_steps // per_stage)
    stage = per_stage * planner.step
    horizon = num_stages * stage
    ends = stage * (np.arange(1.0, num_stages + 1.0))
    centre, pace = _from_start(begun, ends)[:, :2].T
    width = FREE[0] + FREE[1] * (ends / horizon) ** 2 + pace * stage
    line, origin, error = _line(scene.line, scene.state.s, centre, width)
    rows = _near(planner, scene, begun, planner.radius + error, num_stages * per_stage)
    rows[..., :2] -= origin
    walls = corridor(planner, scene, begun, ends) if len(scene.boundary.segment) else None
    shape = Shape(
        num_stages,
        per_stage,
        planner.step,
        tuple(map(float, planner.vehicle.circles)),
        planner.weights,
        TO_SPEED if isinstance(scene.goal, Keep) else TO_PLACE,
        rows.shape[1],
        walls is not None,
        False,
    )
    arrivals = np.array([begun.longitudinal.duration[0], begun.lateral.motion.duration[0]])
    left = arrivals - horizon
    left = np.where(left < SOONEST, planner.fans.soonest, left)
    if isinstance(scene.goal, Reach):
        place, speed = scene.goal.target(horizon + left[0])
        wanted, moving = float(place) - scene.state.s, float(speed)
    else:
        wanted, moving = scene.goal.speed, 0.0
    last = min(scene.stop - planner.vehicle.front, scene.line.length) - scene.state.s - SHORT
    stand = min(scene.stand - planner.vehicle.front - scene.state.s - SHORT, FAR)
    limits, state = planner.comfort, scene.state
    given = {
        "start": np.array([0.0, state.ds, state.dds, *state.lateral]),
        "bent": np.array([to_pose(scene.line, state).curvature]),
        "limits": np.array([getattr(limits, name) for name in LIMITS]),
        "rate": np.array([limits.curvature_rate]),
        "last": np.array([last, stand, limits.braking]),
        "ends": np.array(
            [
                [wanted, moving, left[0], _price(arrivals[0], horizon, left[0])],
                [scene.wanted, 0.0, left[1], _price(arrivals[1], horizon, left[1])],
            ]
        ).ravel(),
        "price": _price(arrivals[:, None], ends - stage, stage),
        "line": line,
        "walls": np.zeros((0, num_stages)) if walls is None else walls,
        "outlines": rows.reshape(len(rows), -1).T,
    }
    return shape, given, error


def _price(arrival: Floats, begin: Floats | float, length: Floats | float) -> Floats:
    """Mean over [begin, begin + length] of a price that is 1 before `arrival` and DEAR after it."""
    cheap = np.clip((arrival - begin) / length, 0.0, 1.0)
    priced: Floats = cheap + (1.0 - cheap) * DEAR
    return priced


def _line(line: ReferenceLine, start: float, centre: Floats, width: Floats) -> tuple[Floats, Floats, float]:
    """Parameters (., N) of the line for each stage, the place from which its x and y are told, and the error [m].

    Least squares at Chebyshev's nodes of [centre - width, centre + width]; straight on beyond the line's ends."""
    nodes = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    wanted = start + centre[:, None] + width[:, None] * nodes  # (N, nodes)
    s = np.clip(wanted, 0.0, line.length)
    told = line.at(s)
    place = told[..., :2] + (wanted - s)[..., None] * np.stack([np.cos(told[..., 2]), np.sin(told[..., 2])], -1)
    origin = line.at(start)[:2]
    powers = nodes[:, None] ** np.arange(PLACE)
    fit = np.linalg.pinv(powers)
    x, y = ((place[..., i] - origin[i]) @ fit.T for i in (0, 1))
    error = max(float(np.abs(c @ powers.T + origin[i] - place[..., i]).max()) for i, c in enumerate((x, y)))
    kappa = told[..., 3] @ np.linalg.pinv(powers[:, :CURVATURE]).T
    return np.vstack([centre, width, kappa.T, x.T, y.T]), origin, error


def _near(planner: Planner, scene: Scene, begun: Plan, radius: float, num_steps: int) -> Floats:
    """p (K, M, 6) of OUTLINE for the obstacles nearest to a plan, and as many far away as the problem's size wants."""
    rows = outlines(rectangles(planner, scene).transpose(2, 0, 1), radius)
    told = _from_start(begun, planner.step * np.arange(1.0, planner.num_steps + 1.0))
    line = scene.line.at(scene.state.s + told[:, 0])
    turned = np.stack([np.cos(line[:, 2]), np.sin(line[:, 2])], -1)
    placed = PLACED(np.column_stack([told[:, 1], line[:, 3], told[:, 3:5], line[:, :2], turned]), NOTHING)
    middle = placed[:, :2] + planner.vehicle.middle * placed[:, 2:]
    apart = OUTLINE(np.repeat(middle, rows.shape[1], 0), rows.reshape(-1, 6))[:, 0].reshape(rows.shape[:2]).min(0)
    nearest = np.argsort(apart, kind="stable")[: OBSTACLES[-1]]
    nearest = nearest[apart[nearest] < NEAR]
    size = next(size for size in OBSTACLES if size >= len(nearest))
    kept = np.broadcast_to([FAR, FAR, 1.0, 0.0, FAR / 10, FAR / 10], (num_steps, size, 6)).copy()
    kept[..., :2] += scene.line.at(scene.state.s)[:2]
    kept[: len(rows), : len(nearest)] = rows[:, nearest]
    kept[len(rows) :] = kept[len(rows) - 1]
    return kept
