"""Stops that must not fail, and vehicles in states that no plan would have led to."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from planning.candidates import Goal, Keep, stop
from planning.check_kernel import REASONS
from planning.frenet import FrenetState
from planning.planner import AT_REST, COMFORT, EMERGENCY, RELAXED, Planner, emergency_stops, plan
from planning.plans import Plan
from planning.polynomials import quintics
from planning.reference import from_curvature
from planning.scene import Scene
from planning.shapes import Obstacles, boundary, no_obstacles

PLANNER = Planner()
S = np.arange(0.0, 301.0, 0.5)
STRAIGHT = from_curvature(S, 0.0 * S)
LINE = from_curvature(S, 0.012 * np.sin(S / 25))
FRONT = PLANNER.vehicle.front


def scene(state: FrenetState, goal: Goal, **more: Any) -> Scene:
    given = {"line": STRAIGHT, "offsets": np.linspace(-2.0, 2.0, 9), "obstacles": no_obstacles(60)} | more
    lines = given.pop("boundary", boundary([], PLANNER.radius))
    return Scene(given.pop("line"), state, goal, given.pop("offsets"), 0.0, lines, given.pop("obstacles"), **given)


def standing(s: float, d: float) -> Obstacles:
    """A car on the straight line."""
    return Obstacles(np.tile([s, d, 0.0], (1, 60, 1)), np.array([[4.6, 1.9]]), np.zeros((1, 60, 2, 2)), np.array([1.0]))


@pytest.mark.parametrize("acceleration", [-7.9, -3.0, -0.1, 0.0, 1.0, 4.0])
@pytest.mark.parametrize("speed", [0.2, 5.0, 19.0])
def test_stops_begin_with_all_the_braking_there_is_and_never_reverse(speed: float, acceleration: float) -> None:
    made = emergency_stops(PLANNER, scene(FrenetState(20.0, speed, acceleration, 0.0), Keep(0.0)), None, 0.0)
    for motion in map(made.longitudinal.motion.take, np.arange(len(made.longitudinal.cost))[:, None]):
        told = motion.at(np.linspace(0.0, motion.duration[0], 2001))[0]
        assert told[:, 1].min() > -1e-9 and told[-1, 1:] == pytest.approx([0.0, 0.0], abs=1e-9)
        hardest = -told[:, 2].min()
        assert hardest < PLANNER.able.braking + 1e-6
        if motion.duration[0] == made.longitudinal.motion.duration.min():
            assert hardest == pytest.approx(PLANNER.able.braking, rel=1e-4)


def test_a_path_that_is_told_by_the_way_is_there_for_every_stop() -> None:
    """Else a hard stop from a slope would end on the spot while the offset still moves: a turn that no car can do."""
    found = plan(PLANNER, scene(FrenetState(20.0, 4.0, 0.0, 0.0, 0.15), Keep(4.0), obstacles=standing(29.0, 0.0)))
    assert (found.tier, found.clear) == (EMERGENCY, True) or found.tier == RELAXED
    assert np.abs(found.trajectory(np.arange(0.0, 3.0, 0.01))[:, 5]).max() <= PLANNER.able.curvature


def test_a_stop_point_is_passed_by_as_little_as_can_be_rather_than_a_car_touched() -> None:
    state = FrenetState(20.0, 10.0, 0.0, 0.0)
    found = plan(PLANNER, scene(state, stop(25.0, FRONT), stop=25.0))
    assert (found.tier, found.clear) == (EMERGENCY, False)
    assert found.along(np.array([3.0]))[0, 0] == pytest.approx(20.0 + 10.0 * (1.5 * 10.0 / 8.0) / 2, abs=1e-9)
    ahead = 20.0 + FRONT + 100.0 / 2 / 8.0 + 2.3
    beside = plan(PLANNER, scene(state, stop(25.0, FRONT), stop=25.0, obstacles=standing(ahead, -1.2)))
    end = beside.states([3.0])[0]
    assert beside.tier == EMERGENCY and (end.d > 0.9 or end.s + FRONT < ahead - 2.3), end


def test_limits_broken_at_the_start_do_not_hide_what_is_touched() -> None:
    """All stops break a limit at once here; one of the sides is free."""
    state = FrenetState(20.0, 10.0, 0.0, 0.0, 0.0, 0.1)  # 10 m/s^2 across
    found = plan(PLANNER, scene(state, Keep(10.0), obstacles=standing(30.0, -2.2)))
    assert (found.tier, found.clear) == (EMERGENCY, False)
    end = found.states([3.0])[0]
    assert end.d > 0.0 or end.s + FRONT < 27.7


def test_a_car_in_the_car_is_answered_by_braking() -> None:
    for speed in (0.0, 8.0):
        found = plan(PLANNER, scene(FrenetState(20.0, speed, 0.0, 0.0), Keep(8.0), obstacles=standing(21.0, 0.3)))
        assert (found.tier, found.clear) == (EMERGENCY if speed else COMFORT, False)
        told = found.trajectory(np.arange(0.0, 3.0, 0.05))
        assert np.isfinite(told).all() and told[-1, 3] < 1e-9 and (np.diff(told[:, 3]) <= 1e-9).all()
        assert told[:, 4].min() == pytest.approx(-8.0 if speed else 0.0, abs=0.1)


@pytest.mark.parametrize("acceleration", [-0.05, -1.0])
def test_braking_told_at_rest_does_not_hold_a_vehicle(acceleration: float) -> None:
    found = plan(PLANNER, scene(FrenetState(20.0, 0.0, acceleration, 0.0), Keep(8.0)))
    assert found.tier == COMFORT and found.states([3.0])[0].ds > 3.0


def test_hard_braking_just_before_rest_ends_in_it() -> None:
    found = plan(PLANNER, scene(FrenetState(20.0, 0.3, -5.0, 0.0), Keep(8.0)))
    assert found.clear and found.along(np.array([0.3]))[0, 1] < 0.3


def test_a_vehicle_faster_than_comfortable_slows_down_and_does_not_stop() -> None:
    found = plan(PLANNER, scene(FrenetState(20.0, 20.5, 0.0, 0.0), Keep(15.0)))
    assert found.tier == RELAXED and 14.0 < found.states([3.0])[0].ds < 20.0


def test_a_stop_too_hard_for_comfort_is_made_by_what_the_vehicle_can() -> None:
    place = 20.0 + FRONT + 14.0
    found = plan(PLANNER, scene(FrenetState(20.0, 10.0, 0.0, 0.0), stop(place, FRONT), stop=place))
    hardest = -found.trajectory(np.arange(0.0, 3.0, 0.05))[:, 4].min()
    assert found.tier == RELAXED and PLANNER.comfort.braking < hardest < PLANNER.able.braking


def test_a_plan_never_goes_backwards_at_whatever_times_it_is_asked() -> None:
    begun = plan(PLANNER, scene(FrenetState(20.0, 1.0, 0.0, 0.0), Keep(1.0)))
    for motion in (
        quintics((20.0, 1.0, -3.0), [(18.0, 0.0, 0.0)], [2.0]),  # turns and stays away
        quintics((20.0, 1.0, -3.0), [(20.5, 2.0, 0.0)], [2.0]),  # turns and comes back
    ):
        turned: Plan = begun._replace(longitudinal=motion)
        t = np.linspace(0.0, 4.0, 4001)
        told, plain = turned.along(t), motion.at(t)[0]
        np.testing.assert_allclose(told[:, 0], np.maximum.accumulate(plain[:, 0]), atol=1e-6)
        assert (np.diff(told[:, 0]) >= -1e-12).all() and told[:, 1].min() == 0.0
        moves = told[:, 1] > 0.0
        np.testing.assert_array_equal(told[moves], plain[moves])
        assert not told[~moves, 1:].any() and moves.any() and not moves.all()
        for k in (300, 900, 1500, 3000):
            np.testing.assert_array_equal(turned.along(t[[k]])[0], told[k])


@pytest.mark.parametrize("seed", range(60))
def test_there_is_always_an_answer_that_can_be_driven_on(seed: int) -> None:
    """States out of all limits, off the road, beside the line's end, among others and in them: finite, never backwards,
    and what is called clear keeps what it promises."""
    rng = np.random.default_rng(seed)
    line = from_curvature(S, rng.choice([0.0, 0.05, 0.18]) * np.sin(S / rng.uniform(8.0, 40.0)))
    s = float(rng.choice([0.0, rng.uniform(0.0, 250.0), rng.uniform(290.0, line.length), line.length]))
    state = FrenetState(
        s, float(rng.choice([0.0, 1e-12, rng.uniform(0, 0.1), rng.uniform(0, 5), rng.uniform(5, 40)])),
        float(rng.choice([0.0, rng.uniform(-15, 10)])), rng.uniform(-5, 5), rng.normal(0, 0.3), rng.normal(0, 0.1),
    )  # fmt: skip
    num = int(rng.choice([0, 3, 200]))
    pose = np.repeat(np.column_stack([line.place(s, 0.0) + rng.normal(0, 15, (num, 2)), rng.normal(0, 2, num)]), 60, 0)
    others = Obstacles(
        pose.reshape(num, 60, 3), np.full((num, 2), 1.5), np.zeros((num, 60, 2, 2)), rng.uniform(0, 1, num)
    )
    lines = boundary([line.place(S, np.full(len(S), d)) for d in (-4.0, 4.0)], PLANNER.radius)
    limit = float(rng.choice([math.inf, -math.inf, s, s + 20.0]))
    found = plan(
        PLANNER,
        scene(state, Keep(rng.uniform(0, 20)), line=line, obstacles=others, boundary=lines, stop=limit, stand=limit),
    )
    t = np.arange(0.0, 3.001, 0.01)
    told, along = found.trajectory(t), found.along(t)
    assert np.isfinite(told).all() and (np.diff(along[:, 0]) >= -1e-12).all() and along[:, 1].min() >= 0.0
    assert set(found.rejected) <= set(REASONS[1:])
    stays = state.ds < AT_REST and "other road user" in found.rejected
    assert found.clear or found.tier == EMERGENCY or (stays and found.tier == COMFORT)
    if found.clear:
        assert along[-1, 0] + FRONT <= limit + 1e-9 and told[5:, 4].min() >= -PLANNER.able.braking - 0.05
        assert np.abs(told[5:, 3] ** 2 * told[5:, 5]).max() <= PLANNER.able.lateral_acceleration + 0.05
