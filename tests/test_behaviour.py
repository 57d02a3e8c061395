"""The behavioural layer in closed loop with a vehicle that does as planned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from models.program import InputError
from planning.behaviour import FOLLOW, KEEP, MERGE, STOP, Manners, Memory, behave
from planning.candidates import Keep
from planning.decision import Decided, Light, Permissions
from planning.frenet import FrenetState, to_pose
from planning.leads import Lead
from planning.planner import COMFORT
from planning.road import Lane, StopPoint, route
from planning.situation import network, predict
from tests.small_streets import (
    CROSSING_ZONE,
    PLANNER,
    SIZES,
    WIDTH,
    Cycle,
    User,
    arc,
    closed_loop,
    crossing,
    lane,
    straight,
    tracks,
    two_way,
)

VEHICLE = PLANNER.vehicle
TIMES = PLANNER.step * np.arange(1, PLANNER.num_steps + 1)
STREET = two_way()
ROADS, WAY = network(STREET), route(STREET, [1])
CROSSING = crossing()
CROSS_ROADS, ACROSS = network(CROSSING), route(CROSSING, [1, 2])
START = FrenetState(20.0, 8.0, 0.0, 0.0)
NONE = Permissions(frozenset(), {}, Decided())


def front(cycle: Cycle) -> float:
    return cycle.state.s + VEHICLE.front


def drive(world: Any = lambda t: [], *, state: FrenetState = START, **more: Any) -> list[Cycle]:
    """On the two-way street."""
    return closed_loop(ROADS, WAY, state, world, **more)


def body(x: float, y: float, heading: float, size: tuple[float, float]) -> shapely.Polygon:
    box = shapely.box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2)
    return affinity.translate(affinity.rotate(box, heading, (0, 0), use_radians=True), x, y)


def nearest(told: Sequence[Cycle], world: Any) -> float:
    """Least distance to any road user [m]."""
    least = math.inf
    for cycle in told:
        pose = to_pose(cycle.scene.line, cycle.state)
        ahead = np.array([math.cos(pose.heading), math.sin(pose.heading)]) * VEHICLE.middle
        own = body(pose.x + ahead[0], pose.y + ahead[1], pose.heading, (VEHICLE.length, VEHICLE.width))
        for u in world(cycle.time):
            least = min(least, own.distance(body(u.x, u.y, u.heading, SIZES[u.kind])))
    return least


def comfortable(told: Sequence[Cycle]) -> bool:
    return all(cycle.plan.tier == COMFORT for cycle in told)


def changes(told: Sequence[Cycle]) -> list[str]:
    """The goals in turn."""
    words = [told[0].memory.goal]
    return words + [b.memory.goal for a, b in pairwise(told) if a.memory.goal != b.memory.goal]


def test_a_free_road_is_driven_at_its_limit_and_stopped_at_its_end() -> None:
    told = drive(state=START._replace(s=300.0), cycles=110)
    assert max(c.state.ds for c in told) == pytest.approx(10.0, abs=0.05)
    assert WAY.line.length - 0.2 < front(told[-1]) <= WAY.line.length and told[-1].state.ds < 0.01
    assert comfortable(told) and changes(told) == [KEEP, STOP]


def test_limits_ahead_are_met_where_they_begin() -> None:
    lanes = {
        1: straight(0.0, 0.0, 100.0, 0.0, successors=(2,), speed=14.0),
        2: straight(100.0, 0.0, 300.0, 0.0, speed=7.0),
    }
    told = closed_loop(network(lanes), route(lanes, [1, 2]), START._replace(s=5.0, ds=12.0), lambda t: [], cycles=90)
    assert max(c.state.ds for c in told) > 12.5
    assert max(c.state.ds for c in told if c.state.s > 100.0) < 7.4
    assert comfortable(told)


def test_curves_are_driven_at_the_lateral_acceleration_wanted() -> None:
    lanes = {
        1: straight(0.0, 0.0, 80.0, 0.0, successors=(2,), speed=13.0),
        2: arc(80.0, 25.0, 25.0, -math.pi / 2, math.pi, successors=(3,), speed=13.0),
        3: straight(80.0, 50.0, -60.0, 50.0, speed=13.0),
    }
    told = closed_loop(network(lanes), route(lanes, [1, 2, 3]), START, lambda t: [], cycles=130)
    in_curve = [c.state.ds for c in told if 85.0 < c.state.s < 150.0]
    assert math.sqrt(1.6 * 25.0) * 0.93 < max(in_curve) < math.sqrt(2.0 * 25.0)
    assert comfortable(told)


def test_a_lead_is_followed_at_gap_and_headway_and_the_goal_does_not_flicker() -> None:
    told = drive(lambda t: [User(60.0, 0.0, 0.0, 6.0).after(t)], cycles=110)
    rear = 60.0 + 6.0 * told[-1].time - SIZES["car"][0] / 2
    assert rear - front(told[-1]) == pytest.approx(4.0 + 1.2 * 6.0, abs=0.05)
    assert changes(told) == [KEEP, FOLLOW] and comfortable(told)
    assert max(c.state.ds for c in told) < 10.1, "not above the limit to catch up"


def test_noisy_tracks_do_not_make_goals_flicker() -> None:
    rng = np.random.default_rng(0)

    def world(t: float) -> list[User]:
        lead = User(60.0, 0.0, 0.0, 6.0).after(t)
        dx, dy, dv, da = rng.normal(0, [0.2, 0.1, 0.2, 0.1])
        return [lead._replace(x=lead.x + dx, y=lead.y + dy, speed=6.0 + dv, acceleration=da)]

    told = drive(world, cycles=130)
    assert changes(told) == [KEEP, FOLLOW] and {c.memory.lead for c in told} == {0}


def test_who_crosses_or_drives_beside_does_not_lead() -> None:
    for user in (User(60.0, -12.0, math.pi / 2, 8.0), User(60.0, WIDTH, math.pi, 8.0), User(60.0, WIDTH, 0.0, 2.0)):
        scene, memory = scene_of([user])
        assert memory.lead == -1 and scene.goal == Keep(10.0), user


def test_who_cuts_in_leads_before_he_is_there() -> None:
    """Heading into the own lane from the one beside, where lanes run the same way."""
    lanes = {1: straight(0.0, 0.0, 400.0, 0.0, speed=10.0), 2: straight(0.0, WIDTH, 400.0, WIDTH, speed=10.0)}
    steady, turns = User(45.0, WIDTH, 0.0, 6.0), User(45.0, 2.8, -0.2, 6.0)
    found = [scene_of([u], lanes)[1].lead for u in (steady, turns)]
    assert found == [-1, 0]


def scene_of(
    users: list[User],
    lanes: dict[int, Lane] = STREET,
    state: FrenetState = START,
    memory: Memory = Memory(),
    points: Sequence[StopPoint] = (),
    permissions: Permissions = NONE,
) -> Any:
    found = predict(network(lanes), tracks(users), TIMES)
    return behave(PLANNER, route(lanes, [1]), state, found, points, permissions, memory)


def test_one_brakes_for_a_standing_car_beyond_the_horizon() -> None:
    """At 10 m/s a stop takes 25 m, and 30 m are driven within the horizon."""
    state = START._replace(s=20.0, ds=10.0)
    far, near = (scene_of([User(x, 0.0)], state=state)[0] for x in (120.0, 65.0))
    assert far.goal == Keep(10.0) and near.goal != Keep(10.0)
    assert near.stand == pytest.approx(65.0 - 2.3 - 1.0, abs=0.01)


def test_behind_a_lead_one_can_stand_if_it_brakes_all_it_can_after_the_horizon() -> None:
    lead = Lead(0, 60.0, 8.0, 0.0, 0.5)
    assert lead.stands(PLANNER) == pytest.approx(60.0 + 24.0 + 64.0 / 16.0 - 1.0 - 0.5)
    slows = lead._replace(acceleration=-1.0)
    assert slows.stands(PLANNER) == pytest.approx(60.0 + 24.0 - 4.5 + 25.0 / 16.0 - 1.0 - 0.5)
    assert lead._replace(acceleration=-4.0).stands(PLANNER) == pytest.approx(60.0 + 8.0 - 1.0)


def test_a_goal_is_left_later_than_it_is_taken() -> None:
    """Between once and one and a half times the way of comfortable braking, the lead is followed if it was before."""
    user, words = [User(85.0, 0.0, 0.0, 6.0)], []
    for memory in (Memory(), Memory(FOLLOW, 0), Memory(FOLLOW, 7)):
        words.append(scene_of(user, state=START._replace(s=51.0, ds=10.0), memory=memory)[1].goal)
    assert words == [KEEP, FOLLOW, KEEP]


def test_scenes_do_not_pass_lines_without_permission() -> None:
    point = StopPoint("lamp", "light", 95.0, 105.0, CROSSING_ZONE)
    closed = scene_of([], points=[point])[0]
    assert closed.stop == closed.stand == 95.0
    opened = scene_of([], points=[point], permissions=NONE._replace(granted=frozenset(["lamp"])))[0]
    assert opened.stop == opened.stand == WAY.line.length


LIGHT = StopPoint("lamp", "light", 70.0, 80.0, np.array([[70.0, -3.0], [80.0, -3.0], [80.0, 3.0], [70.0, 3.0]]))
GIVE_WAY = StopPoint("give way", "yield", 95.0, 105.0, CROSSING_ZONE)
ZEBRA = StopPoint("zebra", "crosswalk", 140.0, 144.0, np.array([[140, -4.0], [144, -4.0], [144, 4.0], [140, 4.0]]))


@settings(max_examples=12)
@given(
    s=st.floats(2.0, 40.0), speed=st.floats(0.0, 12.0), acceleration=st.floats(-1.0, 1.0), d=st.floats(-0.35, 0.35),
    green=st.floats(0.0, 9.0), cars=st.lists(st.floats(-150.0, -20.0), max_size=3), walks=st.floats(-25.0, 25.0),
)  # fmt: skip
def test_a_stop_point_is_never_passed_without_permission(
    s: float, speed: float, acceleration: float, d: float, green: float, cars: list[float], walks: float
) -> None:
    """Random starts (from which a stop is possible), lights, crossing cars, pedestrians."""
    points = [LIGHT, GIVE_WAY, ZEBRA]
    speed = min(speed, math.sqrt(4.0 * max(LIGHT.s - s - VEHICLE.front - 8.0, 0.0)))

    def lights(t: float) -> dict[str, str | Light]:
        phase = (t - green) % 16.0
        return {"lamp": "yellow" if phase < 3.5 else "red" if phase < 9.0 else "green"}

    def world(t: float) -> list[User]:
        users = [User(100.0, y, math.pi / 2, 9.0).after(t) for y in cars]
        return [*users, User(142.0, walks, -math.copysign(math.pi / 2, walks), 1.4, "pedestrian").after(t)]

    start = FrenetState(s, speed, acceleration if speed > 2.0 else 0.0, d)
    told = closed_loop(
        CROSS_ROADS, ACROSS, start, world, stop_points=points, lights=lights, cycles=110,
        until=lambda cycle: front(cycle) > ZEBRA.s + 1.0,
    )  # fmt: skip
    for before, after in pairwise(told):
        for point in points:
            if front(before) <= point.s < front(after) - 1e-6:
                assert point.name in before.permissions.granted, (point.name, before.time)
        if before.scene.stop < math.inf and before.plan.clear:
            assert front(after) <= before.scene.stop + 1e-6


def test_a_red_light_is_stood_before_and_green_lets_go() -> None:
    told = closed_loop(
        CROSS_ROADS, ACROSS, START, lambda t: [], stop_points=[LIGHT], cycles=110,
        lights=lambda t: {"lamp": "red" if t < 12.0 else "green"},
    )  # fmt: skip
    standing = [c for c in told if 10.0 < c.time < 12.0]
    assert all(c.state.ds < 0.05 and 0.0 <= LIGHT.s - front(c) < 0.15 for c in standing)
    assert told[-1].state.ds > 5.0 and changes(told) == [KEEP, STOP, KEEP] and comfortable(told)


def test_crossing_traffic_goes_first() -> None:
    def world(t: float) -> list[User]:
        return [User(100.0, y, math.pi / 2, 8.0).after(t) for y in (-75.0, -95.0)]

    told = closed_loop(CROSS_ROADS, ACROSS, START, world, stop_points=[GIVE_WAY], cycles=120)
    gone = [world(c.time)[-1].y > 3.0 for c in told if front(c) > GIVE_WAY.s]
    assert gone and all(gone) and comfortable(told) and nearest(told, world) > 1.0


def test_a_roundabout_is_entered_behind_who_drives_in_it() -> None:
    r, turn = 18.0, math.pi / 2
    ring = {n: arc(0.0, 0.0, r, (n - 1) * turn, turn, successors=(n % 4 + 1,), speed=8.0) for n in (1, 2, 3, 4)}
    # from the south, along a bend into the ring where lane 4 begins
    entry = arc(-16.0, -r - 16.0, 16.0, turn, -turn, speed=8.0)
    south = straight(-80.0, -r, -16.0, -r, successors=(6,), speed=8.0)
    lanes = {**ring, 5: south, 6: straight(-16.0, -r, 0.0, -r, successors=(4,), speed=8.0), 7: entry}
    way = route(lanes, [5, 6, 4, 1])
    line = float(way.start[2]) - 12.0
    zone = np.array([[-14.0, -22.0], [8.0, -22.0], [8.0, -9.0], [-14.0, -9.0]])
    point = StopPoint("ring", "yield", line, line + 22.0, zone)

    def world(t: float) -> list[User]:
        angle = math.pi * 0.55 + 7.0 * t / r
        return [User(r * math.cos(angle), r * math.sin(angle), angle + turn, 7.0)] if t < 14.0 else []

    told = closed_loop(network(lanes), way, FrenetState(15.0, 8.0, 0.0, 0.0), world, stop_points=[point], cycles=130)
    refused = [c for c in told if "ring" not in c.permissions.granted]
    assert refused and "car 0 is in the zone" in refused[-1].permissions.reasons["ring"]
    assert front(told[-1]) > line and nearest(told, world) > 1.0
    assert min(c.state.ds for c in told) < 3.0, "it waits"
    assert comfortable(told)


def parked(t: float) -> list[User]:
    return [User(100.0, -1.2)]


def test_a_parked_car_is_passed_in_the_opposite_lane_when_that_is_free() -> None:
    told = drive(parked, cycles=100)
    released = [c for c in told if c.memory.passing.going]
    assert released and comfortable(told) and nearest(told, parked) > 0.3
    assert max(c.state.d for c in told) > 1.2 and abs(told[-1].state.d) < 0.05
    assert min(c.state.ds for c in told) > 7.0, "without waiting"


def test_oncoming_traffic_is_waited_for() -> None:
    def world(t: float) -> list[User]:
        return [*parked(t), *(User(x, WIDTH, math.pi, 8.0).after(t) for x in (150.0, 200.0))]

    told = drive(world, cycles=150)
    assert comfortable(told) and nearest(told, world) > 0.3
    released = next(c for c in told if c.memory.passing.going)
    assert min(c.state.ds for c in told) < 0.1 and world(released.time)[-1].x < 105.0
    assert told[-1].state.s > 110.0


def test_a_row_is_passed_as_one_and_who_has_no_room_waits() -> None:
    row = [User(x, -1.2) for x in (90.0, 105.0, 120.0)]
    told = drive(lambda t: row, cycles=120)
    going = [c.memory.passing.going for c in told]
    assert sum(a != b for a, b in pairwise(going)) == 2 and told[-1].state.s > 130.0
    blocked = drive(lambda t: [User(100.0, 0.0), User(110.0, WIDTH, math.pi)], cycles=90)
    assert not any(c.memory.passing.going for c in blocked) and blocked[-1].state.ds < 0.01
    assert comfortable(blocked) and changes(blocked) == [KEEP, FOLLOW]


def test_a_queue_before_a_line_is_not_passed() -> None:
    point = StopPoint("lamp", "light", 110.0, 115.0, CROSSING_ZONE)
    told = drive(lambda t: [User(104.0, 0.0)], stop_points=[point], lights=lambda t: {"lamp": "red"}, cycles=90)
    assert not any(c.memory.passing.going for c in told)
    assert 104.0 - 2.3 - front(told[-1]) == pytest.approx(4.0, abs=0.1)


def test_what_leaves_room_is_passed_within_the_lane() -> None:
    lanes = {1: straight(0.0, 0.0, 300.0, 0.0, width=5.5, speed=10.0)}
    told = closed_loop(network(lanes), route(lanes, [1]), START, lambda t: [User(100.0, -1.9)], cycles=100)
    assert comfortable(told) and min(c.state.ds for c in told) > 7.0
    assert {c.memory.passing.side for c in told} == {-1} and max(c.state.d for c in told) > 0.5
    assert nearest(told, lambda t: [User(100.0, -1.9)]) > 0.3


@pytest.mark.parametrize("ahead", [True, False])
def test_a_lane_is_changed_into_a_gap(ahead: bool) -> None:
    """Not beside the car beside, but before or behind it, whichever is nearer."""
    lanes = {
        1: straight(0.0, 0.0, 500.0, 0.0, beside=(2, None), speed=12.0),
        2: straight(0.0, WIDTH, 500.0, WIDTH, beside=(None, 1), speed=12.0),
    }

    def world(t: float) -> list[User]:
        return [User(x, WIDTH, 0.0, 9.0).after(t) for x in ((57.0, 140.0) if ahead else (66.0, 10.0))]

    told = closed_loop(
        network(lanes), route(lanes, [2]), FrenetState(60.0, 9.0, 0.0, -WIDTH), world, cycles=120,
        until=lambda c: abs(c.state.d) < 0.05,
    )  # fmt: skip
    assert comfortable(told) and nearest(told, world) > 0.5
    assert abs(told[-1].state.d) < 0.05 and MERGE in changes(told)
    other = world(told[-1].time)[0].x
    assert (told[-1].state.s > other) == ahead
    assert len(changes(told)) <= 4


def ramp() -> dict[int, Lane]:
    """Lane 2 comes from the right, bends into the direction of lane 1 and ends where that ends, in lane 3."""
    turn, radius = 0.166, 150.0
    angle = math.pi / 2 + turn * np.linspace(1.0, 0.0, 14)
    bend = np.array([200.0, -radius]) + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    back = np.linspace(150.0, 2.0, 75)[:, None] * [math.cos(turn), math.sin(turn)]
    return {
        1: straight(0.0, 0.0, 200.0, 0.0, successors=(3,), speed=12.0),
        2: lane(np.concatenate([bend[0] - back, bend]), successors=(3,), speed=12.0, gives_way=True),
        3: straight(200.0, 0.0, 400.0, 0.0, speed=12.0),
    }


def test_a_ramp_is_left_between_two_cars() -> None:
    lanes = ramp()

    def world(t: float) -> list[User]:
        return [User(x, 0.0, 0.0, 9.0).after(t) for x in (105.0, 75.0, 42.0)]

    told = closed_loop(network(lanes), route(lanes, [2, 3]), FrenetState(40.0, 9.0, 0.0, 0.0), world, cycles=120)
    assert comfortable(told) and nearest(told, world) > 3.0
    pose = to_pose(told[-1].scene.line, told[-1].state)
    before, after = (User(x, 0.0, 0.0, 9.0).after(told[-1].time).x for x in (75.0, 42.0))
    assert after < pose.x < before and MERGE in changes(told)


def test_who_is_in_no_gap_stands_before_the_lane_that_joins() -> None:
    lanes = ramp()

    def world(t: float) -> list[User]:
        return [User(150.0 - 16.0 * n, 0.0, 0.0, 9.0).after(t) for n in range(22)]

    way = route(lanes, [2, 3])
    told = closed_loop(network(lanes), way, FrenetState(40.0, 9.0, 0.0, 0.0), world, cycles=130)
    assert max(front(c) for c in told) < way.joins[0] - 15.0 and nearest(told, world) > 0.5
    assert comfortable(told) and told[-1].state.ds < 0.5, "beside the others it stands where there is room"


def test_nothing_is_hidden_the_same_cycle_is_the_same_again() -> None:
    users = [User(60.0, -1.2), User(120.0, WIDTH, math.pi, 8.0)]
    first, second = scene_of(users), scene_of(users)
    assert first[1] == second[1] and first[0].goal == second[0].goal
    np.testing.assert_array_equal(first[0].offsets, second[0].offsets)


def test_manners_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="manners: gap is -1"):
        Manners(gap=-1.0)


@pytest.mark.parametrize("speed", [1.2, 0.9])
def test_a_lead_that_is_too_near_and_brakes_is_followed_comfortably(speed: float) -> None:
    """One wants to be farther back than one is, also when it stands in the end; but there is room to stop."""
    user = User(75.6 + VEHICLE.front + 6.0 + SIZES["car"][0] / 2, 0.0, 0.0, speed, acceleration=-1.5)
    told = closed_loop(ROADS, WAY, FrenetState(75.6, 1.66, -0.75, 0.0), lambda t: [user], cycles=1)
    assert told[0].memory.goal == FOLLOW and comfortable(told)
