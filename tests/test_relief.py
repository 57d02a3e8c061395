"""Who is across a border, or has somebody close behind, can drive on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from planning.behaviour import behave
from planning.candidates import Keep
from planning.decision import Decided, Permissions
from planning.frenet import FrenetState
from planning.planner import COMFORT, EMERGENCY, emergency_stops, judge, plan
from planning.relief import LEFT, RIGHT, SPARE, eased, needed
from planning.road import route
from planning.scene import Scene
from planning.shapes import boundary, no_obstacles
from planning.situation import network, predict
from tests.small_streets import PLANNER, WIDTH, User, tracks, two_way

STREET = two_way()
ROADS, WAY = network(STREET), route(STREET, [1])
TIMES = PLANNER.step * np.arange(1, PLANNER.num_steps + 1)
NONE = Permissions(frozenset(), {}, Decided())
EDGE = WIDTH / 2


def asked(state: FrenetState, *users: User) -> Scene:
    seen = predict(ROADS, tracks(users), TIMES)
    return behave(PLANNER, WAY, state, seen, [], NONE)[0]


def test_relief_is_what_the_circles_and_turning_back_need() -> None:
    middle = FrenetState(50.0, 5.0, 0.0, 0.0)
    assert needed(PLANNER, WAY, middle, RIGHT, 2) == pytest.approx(PLANNER.radius - EDGE, abs=0.01)
    beside = middle._replace(d=-1.0)
    assert needed(PLANNER, WAY, beside, RIGHT, 2) == pytest.approx(1.0 + PLANNER.radius - EDGE, abs=0.01)
    turned = beside._replace(slope=-0.2, ds=0.5)
    foremost = PLANNER.vehicle.circles[-1] * math.sin(math.atan(0.2))
    more = foremost + 0.2**2 / (2 * 0.12)  # at 0.5 m/s the curvature decides
    assert needed(PLANNER, WAY, turned, RIGHT, 2) == pytest.approx(1.0 + PLANNER.radius - EDGE + more, abs=0.01)
    quick = turned._replace(ds=10.0)
    more = foremost + 2.0**2 / (2 * 1.2)  # at 10 m/s lateral acceleration does
    assert needed(PLANNER, WAY, quick, RIGHT, 2) == pytest.approx(1.0 + PLANNER.radius - EDGE + more, abs=0.01)
    assert needed(PLANNER, WAY, quick, LEFT, 1) < 0.0


def test_an_eased_border_is_farther_out_near_the_vehicle_only() -> None:
    state = FrenetState(50.0, 4.0, 0.0, -1.0)
    told, _ = WAY.line.project(eased(WAY, state, RIGHT, 2, 0.5, 60.0))
    near, far = told[:, 0] < 50.0 + 15.0, told[:, 0] > 50.0 + 33.0
    np.testing.assert_allclose(told[near, 1], -EDGE - 0.5 - SPARE, atol=0.01)
    np.testing.assert_allclose(told[far, 1], -EDGE, atol=0.01)


def test_who_stands_across_the_edge_of_the_road_drives_back_onto_it() -> None:
    state = FrenetState(50.0, 0.0, 0.0, -0.9, slope=-0.2)
    found = plan(PLANNER, asked(state))
    assert found.tier == COMFORT and found.states([3.0])[0].s > 50.5
    kept = asked(state)._replace(boundary=boundary([STREET[1].right], PLANNER.radius))
    assert plan(PLANNER, kept).tier == EMERGENCY


def test_who_drives_close_behind_does_not_keep_one_from_braking() -> None:
    state = FrenetState(50.0, 8.0, 0.0, 0.0)
    x, y = WAY.line.place(50.0 - 4.5, 0.0)
    chases, overtakes = User(x, y, 0.0, 14.0), User(x, y + WIDTH, 0.0, 14.0)
    assert len(asked(state, chases).obstacles.probability) == 0
    assert len(asked(state, overtakes).obstacles.probability) > 0
    ahead = User(x + 25.0, y, 0.0, 8.0)
    assert len(asked(state, ahead).obstacles.probability) > 0


@pytest.mark.parametrize(
    ("speed", "d", "slope"), [(6.0, 1.0, 0.0), (8.0, 1.0, 0.08), (12.0, 2.0, 0.0), (12.0, 3.0, 0.15)]
)
def test_a_vehicle_on_its_way_to_another_offset_can_stop_at_once(speed: float, d: float, slope: float) -> None:
    """Told by time, no lateral motion stays drivable up to the stop; told by the way, some do."""
    state = FrenetState(50.0, speed, 0.0, d, slope=slope)
    end = 50.0 + speed**2 / (2 * 5.2) + PLANNER.vehicle.front
    wide, nobody = boundary([], PLANNER.radius), no_obstacles(PLANNER.num_steps)
    scene = Scene(WAY.line, state, Keep(speed), np.array([0.0]), 0.0, wide, nobody, stop=end)
    stops = emergency_stops(PLANNER, scene, None, 0.0)
    judged = judge(PLANNER, scene, stops, PLANNER.able, first_good=False)
    good = judged.reason.reshape(len(stops.longitudinal.cost), -1) == 0
    assert good[:, stops.lateral.by_way].any() and not good[:, ~stops.lateral.by_way].any()
