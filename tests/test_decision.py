"""Manoeuvre permissions: truth tables, gap acceptance, and what is remembered."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from models.program import InputError
from planning.decision import Decided, Light, Permissions, Rules, decide, in_zone, time_of
from planning.frenet import FrenetState
from planning.road import StopPoint, route
from planning.shapes import Vehicle
from planning.situation import network, predict
from tests.small_streets import CROSSING_ZONE, User, crossing, tracks

VEHICLE = Vehicle()
LANES = crossing()
ROADS, WAY = network(LANES), route(LANES, [1, 2])
TIMES = 0.05 * np.arange(1, 61)
LINE, END = 95.0, 105.0
AT_LINE = LINE - VEHICLE.front - 0.05
NORTH = math.pi / 2


def decided(
    kind: str, s: float, speed: float, users: list[User], lights: Any = None, memory: Decided = Decided(), **more: Any
) -> Permissions:
    point = StopPoint("here", kind, LINE, END, CROSSING_ZONE)
    told = tracks(users, **{k: v for k, v in more.items() if k in ("existence", "std")})
    rules = more.get("rules", Rules())
    found = predict(ROADS, told, TIMES)
    return decide(WAY, FrenetState(s, speed, 0.0, 0.0), VEHICLE, found, [point], lights, memory, rules)


def may(*given: Any, **more: Any) -> bool:
    return "here" in decided(*given, **more).granted


@pytest.mark.parametrize(
    ("light", "expected"),
    [
        ("green", True), ("yellow", False), ("red", False), ("red-yellow", False), ("", False),
        (Light("green"), True), (Light("green", 9.0), True), (Light("green", 1.0), False), (Light("red", 0.1), False),
    ],
)  # fmt: skip
def test_a_light_is_passed_at_green_that_lasts(light: str | Light, expected: bool) -> None:
    """60 m away at 10 m/s the line is reached in 6 s."""
    s = LINE - VEHICLE.front - 60.0
    assert may("light", s, 10.0, [], {"here": light}) is expected


def test_a_light_that_nobody_tells_is_not_passed_and_the_reason_says_so() -> None:
    for lights in (None, {}, {"another": "green"}):
        found = decided("light", 40.0, 10.0, [], lights)
        assert not found.granted and "nobody tells the light's state" in found.reasons["here"]


def test_others_do_not_matter_at_a_light() -> None:
    assert may("light", AT_LINE, 0.0, [User(100.0, 0.0, NORTH, 0.0)], {"here": "green"})


@pytest.mark.parametrize(
    ("user", "expected"),
    [
        (User(100.0, -60.0, NORTH, 10.0), True),  # in the zone from 5.5 s on, when we have left it
        (User(100.0, -40.0, NORTH, 10.0), False),  # from 3.5 s on
        (User(100.0, -20.0, NORTH, 10.0), False),
        (User(100.0, 0.0, NORTH, 0.0), False),  # stands in it
        (User(100.0, -30.0, NORTH, 0.0), True),  # stands before it
        (User(100.0, 15.0, NORTH, 10.0), True),  # has left it
        (User(100.0, -40.0, NORTH + math.pi, 10.0), True),  # drives away from it
        (User(60.0, 0.0, 0.0, 10.0), True),  # follows us
        (User(103.0, 0.0, 0.0, 0.0), False),  # our lead stands in it
        (User(100.0, 20.0, -NORTH, 1.5, "pedestrian"), True),
        (User(100.0, 6.0, -NORTH, 1.5, "pedestrian"), False),
    ],
)
def test_right_of_way_is_given_to_whoever_comes_while_we_are_there(user: User, expected: bool) -> None:
    """From standing, the rear leaves the zone, 15 m on, after sqrt(2 15 / 1.5) = 4.5 s."""
    found = decided("yield", AT_LINE, 0.0, [user], rules=Rules(margin=0.5, spread=0.5))
    assert ("here" in found.granted) is expected, found.reasons


def test_the_reason_names_who_when_and_how_likely() -> None:
    found = decided("yield", AT_LINE, 0.0, [User(100.0, -40.0, NORTH, 10.0)])
    assert found.reasons["here"].startswith("car 0 is in the zone in 3.") and "chance 1.00" in found.reasons["here"]


def test_a_longer_margin_asks_for_a_larger_gap() -> None:
    far = [User(100.0, -60.0, NORTH, 10.0)]
    told = [may("yield", AT_LINE, 0.0, far, rules=Rules(margin=m, spread=0.5)) for m in (0.5, 1.0, 2.0, 3.0)]
    assert told == sorted(told, reverse=True) and told[0] and not told[-1]


def test_the_window_moves_with_the_own_arrival() -> None:
    """Who crosses in 2 s is in nobody's way who comes in 6."""
    soon = [User(100.0, -15.0, NORTH, 10.0)]
    assert may("yield", LINE - VEHICLE.front - 60.0, 10.0, soon)
    assert not may("yield", LINE - VEHICLE.front - 20.0, 10.0, soon)


def test_unlikely_users_do_not_count_and_many_of_them_do() -> None:
    coming = User(100.0, -20.0, NORTH, 10.0)
    assert may("yield", AT_LINE, 0.0, [coming], existence=0.08)
    assert not may("yield", AT_LINE, 0.0, [coming], existence=0.12)
    assert not may("yield", AT_LINE, 0.0, [coming, coming._replace(y=-24.0)], existence=0.08)


@pytest.mark.parametrize(
    ("user", "expected"),
    [
        (User(100.0, 2.0, -NORTH, 1.4, "pedestrian"), False),
        (User(100.0, 6.0, -NORTH, 1.4, "pedestrian"), False),  # approaches
        (User(100.0, 6.0, NORTH, 1.4, "pedestrian"), True),  # walks away
        (User(100.0, 6.0, 0.0, 0.0, "pedestrian"), True),  # stands apart
        (User(100.0, 3.9, 0.0, 0.0, "pedestrian"), False),  # waits at it
        (User(80.0, 4.6, 0.0, 1.4, "pedestrian"), True),  # walks along the road
        (User(100.0, -12.0, NORTH, 4.0, "bicycle"), False),
        (User(100.0, -12.0, NORTH, 4.0, "car"), True),
    ],
)
def test_a_crosswalk_belongs_to_who_walks(user: User, expected: bool) -> None:
    found = decided("crosswalk", AT_LINE, 0.0, [user])
    assert ("here" in found.granted) is expected, found.reasons


def test_who_walks_gets_a_margin_too() -> None:
    """In the zone after 5 s, when we have left it for .5 s."""
    walks = [User(100.0, 3.3 + 1.4 * 5.0, -NORTH, 1.4, "pedestrian")]
    told = [may("crosswalk", AT_LINE, 0.0, walks, rules=Rules(margin=m, spread=0.01)) for m in (0.2, 1.0)]
    assert told == [True, False]


def test_at_a_stop_sign_one_stands_once_and_then_gives_way() -> None:
    coming = [User(100.0, -20.0, NORTH, 10.0)]
    moving = decided("stop", AT_LINE - 5.0, 4.0, [])
    assert not moving.granted and moving.reasons["here"] == "stand before it first"
    assert not may("stop", AT_LINE - 5.0, 0.0, []), "standing farther away does not count"
    stood = decided("stop", AT_LINE, 0.0, coming, memory=moving.memory)
    assert not stood.granted and "car 0" in stood.reasons["here"]
    assert may("stop", AT_LINE + 0.02, 0.3, [], memory=stood.memory), "it is remembered"


def test_a_permission_stays_once_no_comfortable_stop_is_possible() -> None:
    coming, s = [User(100.0, -20.0, NORTH, 10.0)], LINE - VEHICLE.front - 10.0
    free = decided("yield", s - 1.5, 10.0, [])
    assert "here" in free.memory.used
    kept = decided("yield", s, 10.0, coming, memory=free.memory)
    assert kept.granted and "no comfortable stop" in kept.reasons["here"]
    assert not may("yield", s, 10.0, coming), "but none is given by being fast"
    assert not may("yield", s, 4.0, coming, memory=free.memory), "and it goes while one can stop"


def test_yellow_is_passed_where_green_was_and_stopping_is_hard_and_red_never() -> None:
    s = LINE - VEHICLE.front - 10.0
    green = decided("light", s - 1.5, 10.0, [], {"here": "green"}).memory
    assert may("light", s, 10.0, [], {"here": "yellow"}, green)
    assert not may("light", s, 10.0, [], {"here": "red"}, green)
    assert not may("light", s, 10.0, [], {"here": "?"}, green)


def test_past_the_line_no_permission_is_asked() -> None:
    found = decided("light", LINE - VEHICLE.front + 1.0, 5.0, [], {"here": "red"})
    assert found.granted and found.reasons["here"] == "the front is past the line"


def test_kinds_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="stop point here is a 'gate'"):
        decided("gate", 0.0, 5.0, [])
    with pytest.raises(InputError, match="rules: margin is 0"):
        Rules(margin=0.0)


@pytest.mark.parametrize("speed", [0.0, 3.0, 10.0, 12.0])
@pytest.mark.parametrize("way", [0.0, 5.0, 80.0])
def test_times_are_those_of_integration(way: float, speed: float) -> None:
    t = np.arange(0.0, 40.0, 1e-4)
    v = np.maximum(np.minimum(speed + 1.5 * t, 10.0), speed)
    gone = np.r_[0.0, np.cumsum((v[1:] + v[:-1]) / 2) * 1e-4]
    assert time_of(way, speed, 1.5, 10.0) == pytest.approx(float(np.interp(way, gone, t)), abs=1e-3)


def test_who_is_in_a_zone_is_told_by_rectangles() -> None:
    """A car of 4.6 m at 10 m/s to the north, its middle at y = 10 t - 20: in |y| < 3 while |y| < 3 + 2.3."""
    found = predict(ROADS, tracks([User(100.0, -20.0, NORTH, 10.0)]), TIMES)
    hit = in_zone(CROSSING_ZONE, found, np.ones(1, bool), 0.0, 10.0)[0]
    np.testing.assert_array_equal(hit, np.abs(10.0 * found.times - 20.0) <= 5.3)
    some = in_zone(CROSSING_ZONE, found, np.ones(1, bool), 1.8, 2.1)[0]
    np.testing.assert_array_equal(some, hit & (found.times >= 1.8) & (found.times <= 2.1))
    assert not in_zone(CROSSING_ZONE, found, np.zeros(1, bool), 0.0, 10.0).any()
