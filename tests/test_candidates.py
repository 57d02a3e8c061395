"""Candidate motions: their ends, and their costs by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from models.program import InputError
from planning.candidates import Fans, Keep, Lateral, Reach, Weights, follow, lateral, longitudinal, merge, stop
from planning.frenet import FrenetState
from planning.planner import Planner
from planning.polynomials import Polynomials, quintics, squared_jerk
from planning.shapes import Vehicle

FANS = Fans(cycle=0.5, soonest=1.0, latest=2.0, latest_speed=3.0, latest_place=4.0, num_speeds=3, num_places=3)
WEIGHTS = Weights(jerk=0.2, time=0.3, along=5.0, across=7.0)
STATE = FrenetState(10.0, 8.0, 0.5, 0.6, 0.1, 0.01)


def grid(a: list[float], b: list[float]) -> np.ndarray:
    return np.array([(x, y) for x in a for y in b])


def test_speeds_and_times_of_keeping() -> None:
    found = longitudinal(STATE, Keep(6.0), FANS, WEIGHTS, None)
    ends = grid([1.0, 1.5, 2.0, 2.5, 3.0], [0.0, 4.0, 6.0, 8.0])
    np.testing.assert_allclose(np.stack([found.motion.duration, found.motion.end()[:, 1]], -1), ends, atol=1e-9)
    by_hand = 0.2 * squared_jerk(found.motion) + 0.3 * ends[:, 0] + 5.0 * (ends[:, 1] - 6.0) ** 2
    np.testing.assert_allclose(found.cost, by_hand, rtol=1e-9)


def test_places_and_times_of_reaching_a_target_that_moves() -> None:
    goal = Reach(30.0, 4.0, -1.0, behind=3.0, past=1.0)
    found = longitudinal(STATE, goal, FANS, WEIGHTS, None)
    T, offset = grid([1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0], [-3.0, -1.0, 0.0, 1.0]).T
    end = found.motion.at([9.0])[:, 0] - np.stack([(4.0 - T) * (9.0 - T), 0 * T, 0 * T], -1)  # uniform beyond T
    np.testing.assert_allclose(end[:, 0], 30.0 + 4.0 * T - T**2 / 2 + offset, atol=1e-9)
    np.testing.assert_allclose(end[:, 1], 4.0 - T, atol=1e-9)
    np.testing.assert_allclose(found.cost, 0.2 * squared_jerk(found.motion) + 0.3 * T + 5.0 * offset**2, rtol=1e-9)
    rest = Polynomials(np.array([[10.0, 8.0, 0.0, 0.0, 0.0, 0.0]]), np.array([1.0]))
    uniform = longitudinal(STATE, goal, FANS, WEIGHTS, rest).cost[-1]
    assert uniform == pytest.approx(0.3 + 5.0 * ((18.0 - 33.5) ** 2 + (8.0 - 3.0) ** 2))


def test_a_target_that_brakes_stands_in_the_end() -> None:
    place, speed = Reach(30.0, 4.0, -2.0).target([1.0, 2.0, 5.0])
    assert (place.tolist(), speed.tolist()) == ([33.0, 34.0, 34.0], [2.0, 0.0, 0.0])


@pytest.mark.parametrize(("speed", "acceleration"), [(10.0, 0.0), (10.0, -5.0), (10.0, 1.0), (0.0, -2.0), (3.0, -0.5)])
def test_a_lead_vehicle_is_followed_at_gap_and_headway_until_it_stands(speed: float, acceleration: float) -> None:
    t = np.linspace(0.0, 9.0, 60)
    stands = speed / -acceleration if acceleration < 0 else math.inf
    moving = np.minimum(t, stands)
    rear, pace = 50.0 + speed * moving + acceleration * moving**2 / 2, speed + acceleration * moving
    place, wanted = follow(50.0, speed, acceleration, 3.5, gap=4.0, headway=1.2).target(t)
    np.testing.assert_allclose(place, rear - 3.5 - 4.0 - 1.2 * pace, atol=1e-9)
    if 1.2 * acceleration <= speed:
        np.testing.assert_allclose(wanted, np.where(t < stands, speed - 1.2 * acceleration + acceleration * t, 0.0))


def test_stops_and_gaps() -> None:
    assert stop(50.0, 3.5) == Reach(46.5, 0.0, 0.0, behind=1.0, past=0.0)
    assert merge((40.0, 9.0), (20.0, 6.0)) == Reach(30.0, 7.5)
    assert merge((40.0, -0.2), (20.0, 0.1)).speed == 0.0
    assert follow(50.0, 1.0, 3.0, 3.5, gap=4.0, headway=1.2).speed == 0.0


@pytest.mark.parametrize(("speed", "by_way"), [(8.0, False), (3.0, False), (2.9, True)])
def test_lateral_motions_and_their_costs(speed: float, by_way: bool) -> None:
    state, targets = STATE._replace(ds=speed), np.array([-1.0, 0.5])
    rest = Lateral(quintics((0.6, 0.0, 0.0), [(0.2, 0.0, 0.0)], [5.0]), np.array([True]), np.array([0.2]), np.zeros(1))
    found = lateral(state, targets, 0.1, FANS, WEIGHTS, rest)
    ends, pace = (list(FANS.ways), 3.0) if by_way else ([1.0, 1.5, 2.0], 1.0)
    T, d = grid(ends, [-1.0, 0.5]).T
    assert found.by_way.tolist() == [by_way] * len(T) + [True]
    np.testing.assert_allclose(found.motion.duration[:-1], T)
    np.testing.assert_allclose(found.motion.at([0.0])[0, 0], (0.6, 0.1, 0.01) if by_way else state.lateral, atol=1e-12)
    np.testing.assert_allclose(found.motion.at([99.0])[:, 0], np.outer(found.target, [1.0, 0.0, 0.0]), atol=1e-9)
    T, d, pace = np.r_[T, 5.0], np.r_[d, 0.2], np.r_[np.full(len(T), pace), 3.0]
    jerk = squared_jerk(found.motion) * pace**5
    np.testing.assert_allclose(found.cost, 0.2 * jerk + 0.3 * T / pace + 7.0 * (d - 0.1) ** 2, rtol=1e-9)
    np.testing.assert_array_equal(found.target, d)


def test_a_motion_by_the_way_costs_what_the_same_motion_in_time_does() -> None:
    """At a steady speed d(w) and d(t), w = v t, are one motion."""
    way, time = (quintics((0.6, 0.0, 0.0), [(0.2, 0.0, 0.0)], [T]) for T in (6.0, 2.0))
    assert 3.0**5 * squared_jerk(way)[0] == pytest.approx(squared_jerk(time)[0], rel=1e-12)


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        (Weights, {"jerk": math.nan}, "weights: jerk is nan"),
        (Weights, {"lateral": -1.0}, "weights: lateral is -1"),
        (Fans, {"cycle": 0.0}, "fans: cycle is 0"),
        (Fans, {"slow": math.nan}, "fans: slow is nan"),
        (Fans, {"soonest": 0.05}, "less than half a cycle"),
        (Fans, {"soonest": 5.0}, "fans: latest is 3.0, sooner than soonest, 5.0"),
        (Fans, {"latest_place": math.nan}, "fans: latest_place is nan"),
        (Fans, {"num_places": 0}, "fans: num_places is 0"),
        (Fans, {"ways": ()}, "fans: ways are"),
        (Fans, {"ways": (4.0, 0.0)}, "fans: ways are"),
        (Vehicle, {"middle": math.nan}, "vehicle: middle is nan"),
        (Vehicle, {"num_circles": 2.5}, "num_circles 2.5"),
        (Planner, {"margin": math.nan}, "planner: margin is nan"),
        (Planner, {"margin": -0.1}, "planner: margin is -0.1"),
        (Planner, {"horizon": 0.01}, "no step of 0.05"),
        (Planner, {"horizon": 1e9}, "more than 10000"),
        (Planner, {"horizon": 0.025}, "no step of 0.05"),
        (Planner, {"risk": 1.0}, "risk is 1.0"),
    ],
)
def test_settings_that_are_none_are_refused_in_words(kind: Any, given: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        kind(**given)
