"""Refinement by optimal control: exact where there is an exact answer, within all limits, never worse than the plan."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import shapely

from benchmarks.planning_optimal import scene as random_scene
from planning import optimal, optimal_problem
from planning.candidates import Fans, Goal, Keep, Reach, Weights, stop
from planning.frenet import FrenetState
from planning.kinematics import Limits
from planning.optimal import refine
from planning.optimal_problem import ACROSS, TO_PLACE, TO_SPEED
from planning.planner import COMFORT, EMERGENCY, Planner, plan
from planning.polynomials import quartics, quintics, squared_jerk
from planning.reference import from_curvature
from planning.scene import Scene
from planning.shapes import Obstacles, boundary, no_obstacles

PLANNER = Planner()
FREE = Limits(300.0, 300.0, 1e4, 300.0, 300.0, 10.0, 100.0)
S = np.arange(0.0, 301.0, 0.5)
LINE = from_curvature(S, 0.012 * np.sin(S / 25))
START = FrenetState(20.0, 10.0, 0.2, 0.4, 0.02)
T = 0.05 * np.arange(1, 61)


def scene(state: FrenetState, goal: Goal, **more: Any) -> Scene:
    given = {"offsets": np.linspace(-2.4, 2.4, 13), "wanted": 0.0, "boundary": boundary([], PLANNER.radius)} | more
    return Scene(LINE, state, goal, obstacles=given.pop("obstacles", no_obstacles(60)), **given)


def rectangle(s: float, d: float, speed: float = 0.0, std: float = 0.0) -> Obstacles:
    way = s + speed * T
    pose = np.column_stack([LINE.place(way, np.full(60, d)), LINE.at(way)[:, 2]])
    return Obstacles(pose[None], np.array([[4.6, 1.9]]), np.full((1, 60, 2, 2), np.eye(2) * std**2), np.ones(1))


@pytest.mark.parametrize("goal", [Keep(13.0), Reach(60.0, 8.0, 0.2)])
def test_without_limits_it_is_the_polynomial_but_for_the_square_of_the_stage(
    goal: Goal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Arrivals beyond the horizon: by Bellman the least cost is that of the best polynomial from the start."""
    monkeypatch.setattr(optimal_problem, "TOLERANCE", 1e-9)
    free = Planner(comfort=FREE, able=FREE, weights=Weights(time=0.0), fans=Fans(latest=6.0))
    given = scene(START, goal)
    found = plan(free, given)
    arrival = found.longitudinal.duration[0], found.lateral.motion.duration[0]
    assert min(arrival) > 3.9
    wanted, pace = (goal.speed, 0.0) if isinstance(goal, Keep) else map(float, goal.target(arrival[0]))
    kind = TO_SPEED if isinstance(goal, Keep) else TO_PLACE
    along = optimal_problem.closing(kind, free.weights)(START[:3], [wanted, pace, arrival[0], 1.0])[0]
    across = optimal_problem.closing(ACROSS, free.weights)(START.lateral, [0.0, 0.0, arrival[1], 1.0])[0]
    best = float(along) + float(across)
    over = [refine(free, given, found, per_stage=n).cost - best for n in (4, 2, 1)]
    assert over[0] / over[1] == pytest.approx(4.0, rel=0.1) and over[1] / over[2] == pytest.approx(4.0, rel=0.1)
    assert 0 < over[2] < 1e-3 * best
    assert found.cost >= best - 1e-9


def test_what_lies_beyond_the_horizon_costs_what_the_best_polynomial_costs() -> None:
    weights, x, left = Weights(), (3.0, 1.2, -0.4), 1.7
    for kind, pace in ((TO_SPEED, 0.0), (TO_PLACE, 2.0), (ACROSS, 0.0)):
        cost, end = map(float, optimal_problem.closing(kind, weights)(x, [4.0, pace, left, 3.0]))
        near = end + np.array([-1e-3, 0.0, 1e-3, 2.0])
        if kind == TO_SPEED:
            motion = quartics(x, near, np.full(4, left))
        else:
            motion = quintics(x, np.column_stack([near, np.full(4, pace), np.zeros(4)]), np.full(4, left))
        weight = weights.across if kind == ACROSS else weights.along
        told = 3.0 * weights.jerk * squared_jerk(motion) + weight * (near - 4.0) ** 2
        assert cost == pytest.approx(told[1], rel=1e-9) and told.argmin() == 1


def test_the_functional_of_a_candidate_is_its_cost() -> None:
    """But for the jerk within a stage, of which the mean is a little less."""
    given = scene(START, Keep(11.0))
    found = plan(PLANNER, given)
    shape, parameters, error = optimal._posed(PLANNER, given, found, 1)
    built = optimal_problem.problem(shape)
    w = optimal._packed(optimal._from_start(found, shape.stage * np.arange(shape.num_stages + 1.0)), shape.stage)
    p = np.concatenate([parameters[name].reshape(size).ravel("F") for name, size in built.parameters.items()])
    x = built.programme
    told = float(ca.Function("f", [x["x"], x["p"]], [x["f"]])(w, p))
    told += PLANNER.weights.time * (found.longitudinal.duration[0] + found.lateral.motion.duration[0])
    assert told == pytest.approx(found.cost, rel=5e-3) and error < 1e-5


@pytest.mark.parametrize("seed", [0, 5, 17, 19, 24, 75, 82])
def test_refined_motions_keep_every_limit_at_every_step_and_cost_less(seed: int) -> None:
    given = random_scene(PLANNER, seed)
    found = plan(PLANNER, given)
    refined = refine(PLANNER, given, found)
    assert refined.accepted and refined.tier == COMFORT and refined.cost <= found.cost
    limits, vehicle = PLANNER.comfort, PLANNER.vehicle
    x, y, heading, speed, acceleration, curvature = refined.trajectory(T).T
    bent = np.r_[refined.trajectory([0.0])[0, 5], curvature]
    assert (np.abs(curvature) * speed**2).max() <= limits.lateral_acceleration + 1e-6
    assert -limits.braking - 1e-6 <= acceleration.min() and acceleration.max() <= limits.acceleration + 1e-6
    assert speed.max() <= limits.speed + 1e-6 and speed.min() > -1e-6
    assert (np.abs(np.diff(bent))[speed > 0.1] <= limits.curvature_rate * 0.05 + 1e-9).all()
    assert max(state.s for state in refined.states(T)) + vehicle.front <= given.stop
    lines = shapely.multilinestrings([shapely.linestrings(part.reshape(2, 2)) for part in given.boundary.segment])
    for k in range(60):
        corners = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) * [vehicle.length / 2, vehicle.width / 2]
        c, s = math.cos(heading[k]), math.sin(heading[k])
        turn = np.array([[c, s], [-s, c]])
        body = shapely.Polygon((corners + np.array([vehicle.middle, 0.0])) @ turn + np.array([x[k], y[k]]))
        assert body.distance(lines) > 0.0
        for pose, size in zip(given.obstacles.pose[:, k], given.obstacles.size, strict=True):
            c, s = math.cos(pose[2]), math.sin(pose[2])
            other = shapely.Polygon(corners / corners[0] * size / 2 @ np.array([[c, s], [-s, c]]) + pose[:2])
            assert body.distance(other) > PLANNER.margin - 0.05


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_car_in_the_way_is_passed_on_its_free_side(side: float) -> None:
    given = scene(START, Keep(10.0), obstacles=rectangle(50.0, 1.2 * side))
    refined = refine(PLANNER, given, plan(PLANNER, given))
    beside = next(state for state in refined.states(T) if state.s > 48.0)
    assert refined.accepted and -side * beside.d > 0.7


def test_between_two_lines_it_keeps_off_both() -> None:
    lines = boundary([LINE.place(np.arange(0, 120, 1.0), d) for d in (-2.2, 3.2)], PLANNER.radius)
    given = scene(START, Keep(10.0), obstacles=rectangle(50.0, 2.6), boundary=lines)
    refined = refine(PLANNER, given, plan(PLANNER, given))
    assert refined.accepted and min(state.d for state in refined.states(T)) > -2.2 + PLANNER.vehicle.width / 2


def test_a_way_is_found_where_no_candidate_is_comfortable() -> None:
    """Only the lane's middle may be driven to; a car stands out into the lane."""
    ahead = rectangle(38.0, 2.1)
    given = scene(START._replace(d=0.0, slope=0.0), Keep(10.0), offsets=np.zeros(1), obstacles=ahead, stand=1e3)
    found = plan(PLANNER, given)
    refined = refine(PLANNER, given, found)
    assert found.tier != COMFORT
    assert refined.accepted and refined.tier == COMFORT and refined.states([3.0])[0].s > 40.0


def test_where_nothing_is_found_the_candidate_stays() -> None:
    walls = [LINE.place(np.arange(0, 60, 1.0), d) for d in (-1.5, 1.5)] + [LINE.place([26.0, 26.0], [-2.0, 2.0])]
    given = scene(START, Keep(10.0), boundary=boundary(walls, PLANNER.radius))
    found = plan(PLANNER, given)
    refined = refine(PLANNER, given, found)
    assert found.tier == EMERGENCY and not refined.accepted and refined.tier == EMERGENCY and not refined.clear
    np.testing.assert_array_equal(refined.trajectory(T), found.trajectory(T))


def test_a_solver_that_fails_or_raises_leaves_the_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    given = scene(START, Keep(10.0))
    found = plan(PLANNER, given)

    def broken(*_: Any) -> Any:
        raise RuntimeError("out of order")

    monkeypatch.setattr(optimal_problem, "solver", broken)
    refined = refine(PLANNER, given, found)
    assert not refined.accepted and "out of order" in refined.why
    np.testing.assert_array_equal(refined.trajectory(T), found.trajectory(T))


def test_ipopt_finds_the_same_where_fatrop_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    given = scene(START, Keep(10.0), obstacles=rectangle(50.0, 1.2))
    found = plan(PLANNER, given)
    first = refine(PLANNER, given, found)
    monkeypatch.setattr(optimal_problem, "SOLVERS", ("ipopt",))
    second = refine(PLANNER, given, found)
    assert (first.solver, second.solver) == ("fatrop", "ipopt") and second.accepted
    assert second.cost == pytest.approx(first.cost, rel=1e-3)


def test_near_standstill_the_candidate_stays() -> None:
    given = scene(FrenetState(20.0, 1.0, 0.0, 0.3), Keep(5.0))
    refined = refine(PLANNER, given, plan(PLANNER, given))
    assert not refined.accepted and "standstill" in refined.why


def test_a_motion_that_costs_more_is_not_followed() -> None:
    given = scene(START, Keep(10.0))
    found = plan(PLANNER, given)
    refined = refine(PLANNER, given, found._replace(cost=0.1))
    assert not refined.accepted and refined.why == optimal.DEARER and refined.cost > 0.1


def test_derivatives_are_those_of_finite_differences() -> None:
    """Of all constraints, at a random point, along random directions."""
    lines = boundary([LINE.place(np.arange(0, 120, 1.0), d) for d in (-2.2, 2.2)], PLANNER.radius)
    given = scene(START, Keep(12.0), obstacles=rectangle(34.0, 2.5, 3.0, 0.1), boundary=lines)
    planner = replace(PLANNER, horizon=0.4)
    given = given._replace(obstacles=Obstacles(*(v[:, :8] if v.ndim > 2 else v for v in given.obstacles)))
    shape, parameters, _ = optimal._posed(planner, given, plan(planner, given), 2)
    shape = shape._replace(fine=True)
    built = optimal_problem.problem(shape)
    assert shape.walled and shape.num_obstacles == 1
    w, p = built.programme["x"], built.programme["p"]
    g = ca.Function("g", [w, p], [built.programme["g"], ca.jacobian(built.programme["g"], w)])
    value = np.concatenate([parameters[name].reshape(size).ravel("F") for name, size in built.parameters.items()])
    rng = np.random.default_rng(0)
    at = optimal._packed(optimal._from_start(plan(planner, given), shape.stage * np.arange(5.0)), shape.stage)
    at = at + 0.02 * rng.normal(size=at.shape)
    for _ in range(3):
        move = rng.normal(size=at.shape)
        up, down = (np.array(g(at + h * move, value)[0]).ravel() for h in (1e-6, -1e-6))
        exact = np.array(g(at, value)[1] @ move).ravel()
        np.testing.assert_allclose((up - down) / 2e-6, exact, atol=1e-5 * np.abs(exact).max())


def test_refinements_are_the_same_bits_again() -> None:
    given = random_scene(PLANNER, 24)
    found = plan(PLANNER, given)
    first, second = (refine(PLANNER, given, found).trajectory(T) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_refined_drive_stops_before_the_line() -> None:
    state, previous = START, None
    accepted = 0
    for _ in range(70):
        given = scene(state, stop(70.0, PLANNER.vehicle.front), stop=70.0)
        previous = plan(PLANNER, given, previous, 0.15)
        refined = refine(PLANNER, given, previous)
        accepted += refined.accepted
        assert refined.tier == COMFORT
        state = refined.states([0.15])[0]
        assert state.s + PLANNER.vehicle.front <= 70.0
    assert state.ds == pytest.approx(0.0, abs=0.01) and 70.0 - (state.s + PLANNER.vehicle.front) < 0.3
    assert accepted > 5


@pytest.mark.parametrize("seed", [0, 19, 24])
def test_all_of_a_refined_motion_is_its_own_rest(seed: int) -> None:
    """Told again without any time gone, it costs what the solver said it does."""
    given = random_scene(PLANNER, seed)
    found = plan(PLANNER, given)
    refined = refine(PLANNER, given, found)
    again = refine(PLANNER, given, found, refined, 0.0)
    assert refined.accepted and not refined.rest and again.rest
    assert again.cost == pytest.approx(refined.cost, rel=1e-6)
    np.testing.assert_array_equal(again.trajectory(T), refined.trajectory(T))


def test_a_world_that_does_not_change_is_driven_as_refined_before() -> None:
    state, previous, rest = START, None, 0
    gaps = list[float]()
    for cycle in range(20):
        given = scene(state, Reach(45.0 + 8.0 * 0.15 * cycle, 8.0))
        refined = refine(PLANNER, given, plan(PLANNER, given), previous, 0.15)
        if previous is not None:
            t = np.arange(0.0, 2.851, 0.05)
            gaps.append(np.abs(refined.trajectory(t)[:, :2] - previous.trajectory(t + 0.15)[:, :2]).max())
        state, previous, rest = refined.states([0.15])[0], refined, rest + refined.rest
    assert rest >= 18 and np.quantile(gaps, 0.95) < 1e-9


@pytest.mark.parametrize(
    "change", [{"goal": Reach(52.0, 8.0)}, {"obstacles": rectangle(45.0, 0.5)}, {"stop": 45.0}, {"wanted": 2.0}]
)
def test_the_rest_is_not_followed_into_a_world_that_changed(change: dict[str, Any]) -> None:
    given = scene(START, Reach(45.0, 8.0))
    first = refine(PLANNER, given, plan(PLANNER, given))
    same = scene(first.states([0.15])[0], Reach(45.0 + 8.0 * 0.15, 8.0))
    changed = same._replace(**change)
    assert refine(PLANNER, same, plan(PLANNER, same), first, 0.15).rest
    assert not refine(PLANNER, changed, plan(PLANNER, changed), first, 0.15).rest


def test_a_vehicle_that_left_its_motion_does_not_get_the_rest_of_it() -> None:
    given = scene(START, Keep(12.0))
    first = refine(PLANNER, given, plan(PLANNER, given))
    state = first.states([0.15])[0]
    moved = scene(state._replace(d=state.d + 0.05), Keep(12.0))
    assert not refine(PLANNER, moved, plan(PLANNER, moved), first, 0.15).rest


def test_where_nothing_is_to_be_solved_only_the_rest_is_followed() -> None:
    given = scene(START, Keep(12.0))
    first = refine(PLANNER, given, plan(PLANNER, given))
    alone = refine(PLANNER, given, first.plan, solve=False)
    assert not alone.accepted and alone.iterations == 0 and alone.why == optimal.UNSOLVED
    rest = refine(PLANNER, given, first.plan, first, 0.0, solve=False)
    assert rest.rest and rest.accepted and rest.iterations == 0
    np.testing.assert_array_equal(rest.trajectory(T), first.trajectory(T))


def test_what_the_solver_is_not_told_is_found_by_the_check(monkeypatch: pytest.MonkeyPatch) -> None:
    given = scene(START, Keep(10.0), obstacles=rectangle(50.0, 1.6))
    found = plan(PLANNER, given)
    monkeypatch.setattr(optimal, "NEAR", -10.0)
    refined = refine(PLANNER, given, found)
    assert refined.converged and not refined.accepted and refined.why == "other road user"
    np.testing.assert_array_equal(refined.trajectory(T), found.trajectory(T))


def test_the_rest_gives_way_to_a_motion_that_is_much_better(monkeypatch: pytest.MonkeyPatch) -> None:
    given = scene(START, Reach(45.0, 8.0))
    first = refine(PLANNER, given, plan(PLANNER, given))
    assert refine(PLANNER, given, first.plan, first, 0.0).rest
    monkeypatch.setattr(optimal, "STAY", -0.01)  # the motion found now is the same: 1 % too dear then
    assert not refine(PLANNER, given, first.plan, first, 0.0).rest
