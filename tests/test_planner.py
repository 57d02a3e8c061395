"""A planning cycle: the cheapest good candidate, the same again in a world that does not change, always an answer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from models.program import InputError
from planning.candidates import Goal, Keep, Reach, follow, merge, stop
from planning.check_kernel import REASONS
from planning.frenet import FrenetState, Pose
from planning.kinematics import KINEMATICS, LIMITS, MARGINS, Limits
from planning.planner import COMFORT, EMERGENCY, RELAXED, Planner, candidates_of, judge, judge_states, plan
from planning.plans import Plan
from planning.polynomials import NOTHING, Polynomials
from planning.reference import from_curvature
from planning.scene import Scene
from planning.shapes import CLEARANCE, SIGMAS, Obstacles, Vehicle, boundary, no_obstacles

PLANNER = Planner()
S = np.arange(0.0, 301.0, 0.5)
LINE = from_curvature(S, 0.012 * np.sin(S / 25))
GENTLE = from_curvature(S, 0.006 * np.sin(S / 25))
OPEN = boundary([], PLANNER.radius)


def scene(state: FrenetState, goal: Goal, **more: Any) -> Scene:
    given = {"offsets": np.linspace(-0.5, 0.5, 5), "wanted": 0.0, "boundary": OPEN} | more
    return Scene(LINE, state, goal, obstacles=given.pop("obstacles", no_obstacles(60)), **given)


def rectangle(s: float, d: float, speed: float = 0.0, std: float = 0.0, probability: float = 1.0) -> Obstacles:
    """A car along the line."""
    t = 0.05 * np.arange(1, 61)
    pose = np.column_stack([LINE.place(s + speed * t, np.full(60, d)), LINE.at(s + speed * t)[:, 2]])
    return Obstacles(
        pose[None], np.array([[4.6, 1.9]]), np.full((1, 60, 2, 2), np.eye(2) * std**2), np.array([probability])
    )


START = FrenetState(20.0, 10.0, 0.0, 0.3)


def test_a_free_road_is_driven_at_the_speed_wanted_on_the_offset_wanted() -> None:
    found = plan(PLANNER, scene(START, Keep(11.0)))
    end = found.states([3.0])[0]
    assert found.tier == COMFORT and found.clear and found.cost == found.candidates.cost.min()
    assert (end.ds, end.d) == (pytest.approx(11.0, abs=1e-9), pytest.approx(0.0, abs=1e-9))


GOALS = {
    "keep": lambda t: Keep(11.0),
    "follow": lambda t: follow(55.0 + 8.0 * t, 8.0, 0.0, 3.85, gap=4.0, headway=1.2),
    "stop": lambda t: stop(50.0, 3.85),
    "merge": lambda t: merge((40.0 + 9.0 * t, 9.0), (20.0 + 9.0 * t, 9.0)),
}


@pytest.mark.parametrize("name", GOALS)
@pytest.mark.parametrize("speed", [10.0, 6.0])
def test_a_world_that_does_not_change_is_planned_as_before(name: str, speed: float) -> None:
    """[K15], section IV-C: a plan is the rest of the one before, to rounding, where limits turn nothing down."""
    state, previous = FrenetState(20.0, speed, 0.3, 0.4, 0.05), None
    t, gaps = np.arange(0.0, 2.851, 0.05), []
    for cycle in range(12):
        found = plan(PLANNER, scene(state, GOALS[name](0.15 * cycle))._replace(line=GENTLE), previous, 0.15)
        assert found.clear
        if previous is not None:
            gaps.append(np.abs(found.trajectory(t)[:, :2] - previous.trajectory(t + 0.15)[:, :2]).max())
        state, previous = found.states([0.15])[0], found
    assert np.quantile(gaps, 0.95) < 1e-9, gaps


def test_the_rest_of_a_plan_is_told_by_todays_target() -> None:
    first = plan(PLANNER, scene(START, Keep(12.0)))
    state = first.states([0.15])[0]
    again = plan(PLANNER, scene(state, Keep(7.0)), first, 0.15)
    assert again.states([3.0])[0].ds == pytest.approx(7.0, abs=0.1)


def test_a_vehicle_that_left_its_plan_does_not_get_the_rest_of_it() -> None:
    first = plan(PLANNER, scene(START, Keep(12.0)))
    state = first.states([0.15])[0]
    with_rest = candidates_of(PLANNER, scene(state, Keep(12.0)), first, 0.15)
    moved = candidates_of(PLANNER, scene(state._replace(d=state.d + 0.1), Keep(12.0)), first, 0.15)
    assert len(with_rest.lateral.cost) == len(moved.lateral.cost) + 1


def test_a_rest_told_by_the_way_begins_where_the_vehicle_is() -> None:
    first = plan(PLANNER, scene(FrenetState(20.0, 2.0, 0.0, 0.4), Keep(2.0)))
    assert first.lateral.by_way[0] and first.states([0.0])[0].d == pytest.approx(0.4, abs=1e-12)
    state = first.states([0.6])[0]
    rest = candidates_of(PLANNER, scene(state, Keep(2.0)), first, 0.6).lateral.motion
    np.testing.assert_allclose(rest.at([0.0])[-1, 0], (state.d, state.slope, state.bend), atol=1e-12)


def test_the_rest_of_a_plan_on_another_line_is_none() -> None:
    first = plan(PLANNER, scene(START, Keep(12.0)))
    given = scene(first.states([0.15])[0], Keep(12.0))
    other = given._replace(line=LINE._replace(table=LINE.table.copy()))
    here, there = (candidates_of(PLANNER, each, first, 0.15) for each in (given, other))
    assert len(here.lateral.cost) == len(there.lateral.cost) + 1


def test_asking_for_all_reasons_changes_no_plan() -> None:
    given = scene(START, Keep(12.0), obstacles=rectangle(50.0, 1.0))
    some, every = plan(PLANNER, given), plan(PLANNER, given, all_reasons=True)
    assert (every.candidates.reason >= 0).all() and (some.candidates.reason < 0).any()
    assert (some.cost, some.rejected) == (every.cost, every.rejected) and some.rejected


def brute(planner: Planner, given: Scene, found: Any, c: int, limits: Limits) -> str:
    """The reason of a candidate by numpy, formula by formula."""
    i, j = divmod(c, len(found.lateral.cost))
    t = planner.step * np.arange(1, planner.num_steps + 1)
    s, ds, dds = found.longitudinal.motion.take([i]).at(t)[0].T
    if found.lateral.by_way[j]:
        d, slope, bend = found.lateral.motion.take([j]).at(s - given.state.s)[0].T
        dd, ddd = slope * ds, bend * ds**2 + slope * dds
    else:
        d, dd, ddd = found.lateral.motion.take([j]).at(t)[0].T
    told = given.line.at(s)
    x = np.stack([ds, dds, told[:, 3], told[:, 4], d, dd, ddd], -1)
    margins = MARGINS(x, np.array([[getattr(limits, name) for name in LIMITS]]))
    xy = given.line.place(s, d)
    w = 1 - told[:, 3] * d
    heading = told[:, 2] + np.arctan2(dd, ds * w)
    curvature = KINEMATICS(x, NOTHING)[:, 2]
    vehicle, radius = planner.vehicle, planner.radius
    import shapely

    lines = shapely.multilinestrings([shapely.linestrings(part.reshape(2, 2)) for part in given.boundary.segment])
    rectangles = given.obstacles.table(1e-12, radius, 10.0)
    chance = np.zeros((len(rectangles), planner.num_steps))
    from planning.frenet import to_pose

    if (margins[:, :10] < 0).any():
        return REASONS[1 + int(np.argmax(margins[np.argmax((margins[:, :10] < 0).any(1)), :10] < 0))]
    quick = np.r_[True, margins[:-1, 10] > 0.1] & (margins[:, 10] > 0.1)
    turned = np.abs(np.diff(np.r_[to_pose(given.line, given.state).curvature, curvature]))
    if (quick & (turned > limits.curvature_rate * planner.step)).any():
        return "curvature rate"
    for k in range(planner.num_steps):
        if s[k] > given.stop - vehicle.front:
            return "stop point"
        if s[k] > given.line.length:
            return "end of the reference line"
        centres = xy[k] + vehicle.circles[:, None] * [np.cos(heading[k]), np.sin(heading[k])]
        if (shapely.distance(shapely.points(centres), lines) <= radius).any():
            return "boundary line"
        for m, r in enumerate(rectangles[..., k]):
            z = float(SIGMAS(centres, np.array([[*r[:9], radius]])).min())
            chance[m, k] = given.obstacles.probability[m] * 0.5 * math.erfc(z / math.sqrt(2))
        if (chance[:, k] > planner.risk).any():
            return "other road user"
    if chance.max(1, initial=0.0).sum() > planner.risk:
        return "other road user"
    if s[-1] + ds[-1] ** 2 / (2 * limits.braking) > given.stand - vehicle.front:
        return "cannot stop beyond the horizon"
    return "none"


@pytest.mark.parametrize("speed", [10.0, 2.0])
def test_every_judgement_is_that_of_the_formulas(speed: float) -> None:
    both = [rectangle(45.0, 3.0, 3.0, 0.2), rectangle(60.0, -2.5, -4.0, 0.3, 0.5)]
    obstacles = Obstacles(*(np.concatenate(parts) for parts in zip(*both, strict=True)))
    lines = boundary([LINE.place(np.arange(0, 120, 1.0), d) for d in (-2.6, 4.5)], PLANNER.radius)
    given = scene(
        FrenetState(20.0, speed, 0.5, 0.6, 0.05, 0.01), Keep(14.0), offsets=np.linspace(-2.0, 3.5, 6), boundary=lines,
        obstacles=obstacles, stop=62.0, stand=64.0,
    )  # fmt: skip
    limits = Limits(speed=12.0, acceleration=2.2, power=18.0, braking=3.0, curvature=0.05, curvature_rate=0.1)
    found = judge(PLANNER, given, candidates_of(PLANNER, given), limits, first_good=False)
    rng = np.random.default_rng(0)
    chosen = np.concatenate(
        [rng.permutation(np.flatnonzero(found.reason == reason))[:12] for reason in np.unique(found.reason)]
    )
    reasons = [REASONS[found.reason[c]] for c in chosen]
    assert reasons == [brute(PLANNER, given, found, c, limits) for c in chosen]
    assert len(set(reasons)) >= 6, set(reasons)
    first = judge(PLANNER, given, candidates_of(PLANNER, given), limits)
    good = found.reason == 0
    assert first.best == (found.order[good[found.order]][0] if good.any() else -1)


@pytest.mark.parametrize("seed", range(4))
def test_in_a_hurry_the_same_candidates_are_good(seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = [rectangle(rng.uniform(35, 80), rng.uniform(-4, 6), rng.uniform(-4, 6), 0.3, rng.uniform()) for _ in "1234"]
    obstacles = Obstacles(*(np.concatenate(parts) for parts in zip(*boxes, strict=True)))
    open_ = scene(START, Keep(14.0), offsets=np.linspace(-2.0, 3.5, 6), obstacles=obstacles)
    lines = boundary([LINE.place(np.arange(0, 120, 1.0), d) for d in (-2.6, 4.5)], PLANNER.radius)
    given = open_._replace(boundary=lines, stop=62.0, stand=64.0)
    made = candidates_of(PLANNER, given)
    exact = judge(PLANNER, given, made, PLANNER.able, first_good=False)
    bad, good = (exact.order[part] for part in (exact.reason[exact.order] > 0, exact.reason[exact.order] == 0))
    assert len(good) and len(bad) > 100
    hurried = judge(PLANNER, given, made._replace(order=np.r_[bad, good]), PLANNER.able)
    assert hurried.best == good[0] and (hurried.reason[good[1:]] == -1).all()
    other = bad[hurried.reason[bad] != exact.reason[bad]]
    assert {REASONS[r] for r in hurried.reason[other]} <= {"other road user"}
    touching = judge(PLANNER, open_, made, PLANNER.able, first_good=False)
    assert {REASONS[r] for r in touching.reason[other]} <= {"other road user"}


@pytest.mark.parametrize(
    ("change", "reason", "stand"),
    [
        ({"curvature_rate": 1e-4}, "curvature rate", math.inf),
        ({"braking": 0.5}, "cannot stop beyond the horizon", 75.0),
        ({"speed": 9.0}, "speed", math.inf),
    ],
)
def test_what_comfort_alone_forbids_is_tried_again(change: dict[str, float], reason: str, stand: float) -> None:
    planner = Planner(comfort=Limits(**change))
    given = scene(START, Keep(10.0), stand=stand)
    found, made = plan(planner, given), candidates_of(planner, given)
    assert found.tier == RELAXED and found.rejected[reason] > 0
    wider = candidates_of(planner, given, both=True)
    costs = [c.cost[best] for c in (made, wider) if (best := judge(planner, given, c, planner.able).best) >= 0]
    assert found.cost == min(costs)


def test_a_motion_told_as_states_is_judged_like_a_candidate() -> None:
    given = scene(START, Keep(14.0), offsets=np.linspace(-2.0, 3.5, 6), obstacles=rectangle(45.0, 1.0, 3.0, 0.2))
    limits = Limits(speed=12.0, acceleration=2.2, curvature_rate=0.1)
    found = judge(PLANNER, given, candidates_of(PLANNER, given), limits, first_good=False)
    t, reasons = 0.05 * np.arange(1, 61), set[str]()
    for c in np.random.default_rng(0).permutation(found.cost.size)[:60]:
        i, j = divmod(int(c), len(found.lateral.cost))
        along, across = found.longitudinal.motion.take([i]).at(t)[0], found.lateral.motion.take([j]).at(t)[0]
        told = judge_states(PLANNER, given, along, across, limits)
        assert told == (REASONS[found.reason[c]], found.when[c])
        reasons.add(told[0])
    assert len(reasons) >= 3, reasons


def test_a_lead_vehicle_is_followed_at_the_gap_wanted() -> None:
    state, previous = START, None
    for cycle in range(80):
        goal = follow(55.0 + 6.0 * 0.15 * cycle, 6.0, 0.0, PLANNER.vehicle.front, gap=4.0, headway=1.2)
        previous = plan(PLANNER, scene(state, goal), previous, 0.15)
        state = previous.states([0.15])[0]
    assert 55.0 + 6.0 * 12.0 - (state.s + PLANNER.vehicle.front) == pytest.approx(4.0 + 1.2 * 6.0, abs=0.05)


def test_a_stop_point_is_never_passed() -> None:
    state, previous = START, None
    for _ in range(80):
        previous = plan(PLANNER, scene(state, stop(70.0, PLANNER.vehicle.front), stop=70.0), previous, 0.15)
        assert previous.tier == COMFORT
        assert previous.along(np.arange(0, 12, 0.05))[:, 0].max() + PLANNER.vehicle.front <= 70.0 + 1e-9
        state = previous.states([0.15])[0]
    assert state.ds == pytest.approx(0.0, abs=0.01)
    assert 70.0 - (state.s + PLANNER.vehicle.front) < 0.15


def test_a_stop_within_comfortable_braking_needs_no_more_than_comfort() -> None:
    """Beside the offset wanted and turned against the line: what is told by time alone turns on the spot there."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        speed, braking = rng.uniform(3.0, 12.0), rng.uniform(0.8, 3.5)
        state = FrenetState(20.0, speed, rng.uniform(-1.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-0.05, 0.05))
        line = state.s + PLANNER.vehicle.front + speed**2 / (2 * braking) + 1.0
        found = plan(PLANNER, scene(state, stop(line, PLANNER.vehicle.front), stop=line + 0.1, stand=line + 0.1))
        assert found.tier == COMFORT, (state, braking)


def test_a_parked_car_is_passed_beside() -> None:
    state, previous, clearance = START, None, math.inf
    for _ in range(60):
        given = scene(state, Keep(10.0), offsets=np.linspace(-0.5, 3.0, 15), obstacles=rectangle(65.0, -1.3))
        previous = plan(PLANNER, given, previous, 0.15)
        assert previous.clear
        x, y, heading = previous.trajectory([0.15])[0, :3]
        centres = np.array([x, y]) + PLANNER.vehicle.circles[:, None] * [math.cos(heading), math.sin(heading)]
        r = given.obstacles.table(1e-3, 1.0, 1.0)[0, :, 0]
        gap = CLEARANCE(centres, np.array([[*r[:9], 0.0, 0.0]])).min() ** 0.5
        clearance, state = min(clearance, gap - PLANNER.vehicle.radius), previous.states([0.15])[0]
    assert state.s > 80.0 and clearance >= PLANNER.margin - 0.05


def test_the_answer_in_a_box_is_an_emergency_stop_that_goes_as_far_as_it_can() -> None:
    """Walls all around, nearer than braking can stop: still a plan, braking all it can."""
    walls = [LINE.place(np.arange(0, 60, 1.0), d) for d in (-1.5, 1.5)] + [LINE.place([26.0, 26.0], [-2.0, 2.0])]
    lines = boundary(walls, PLANNER.radius)
    found = plan(PLANNER, scene(START._replace(d=0.0), Keep(10.0), boundary=lines))
    assert (found.tier, found.clear) == (EMERGENCY, False)
    assert found.rejected.get("boundary line", 0) > 0
    assert found.states([3.0])[0].ds == pytest.approx(0.0, abs=1e-6)
    hardest = found.trajectory(np.arange(0.0, 2.0, 0.05))[:, 4].min()
    assert -PLANNER.able.braking * 1.05 < hardest < -0.8 * PLANNER.able.braking


def test_where_comfort_does_not_do_what_the_vehicle_can_is_used() -> None:
    ahead = rectangle(20.0 + PLANNER.vehicle.front + 11.0 + 2.3, 0.0)
    found = plan(PLANNER, scene(START, Keep(10.0), obstacles=ahead, stand=math.inf))
    assert found.tier in (RELAXED, EMERGENCY) and found.clear


def test_a_standing_vehicle_starts() -> None:
    found = plan(PLANNER, scene(FrenetState(20.0, 0.0, 0.0, 0.4, 0.1), Keep(8.0)))
    assert found.tier == COMFORT and found.states([3.0])[0].ds > 3.0


def test_who_stands_stays_without_an_emergency_whoever_comes() -> None:
    """Somebody drives at it from ahead, another stands behind: nothing is clear, and there is nothing to brake for."""
    given = scene(FrenetState(20.0, 0.0, 0.0, 0.0), Keep(8.0), obstacles=rectangle(32.0, 0.0, -6.0))
    found = plan(PLANNER, given)
    assert (found.tier, found.clear) == (COMFORT, False) and found.rejected["other road user"] > 0
    assert found.along(np.arange(0.0, 3.0, 0.05))[:, 0].max() == pytest.approx(20.0, abs=1e-9)
    on_a_kerb = boundary([LINE.place([18.0, 24.0], 0.5)], PLANNER.radius)
    assert plan(PLANNER, given._replace(boundary=on_a_kerb)).tier == EMERGENCY, "it may not be where it is"
    moving = plan(PLANNER, given._replace(state=FrenetState(20.0, 0.5, 0.0, 0.0)))
    assert (moving.tier, moving.clear) == (EMERGENCY, False)


def test_unlikely_and_uncertain_road_users() -> None:
    beside = scene(START._replace(d=0.0), Keep(10.0), offsets=np.array([0.0]), obstacles=rectangle(40.0, 2.6, 0.0))
    assert plan(PLANNER, beside).states([3.0])[0].ds == pytest.approx(10.0)
    uncertain = beside._replace(obstacles=rectangle(40.0, 2.6, 0.0, 0.5))
    assert plan(PLANNER, uncertain).rejected["other road user"] > 0
    unlikely = beside._replace(obstacles=rectangle(40.0, 2.6, 0.0, 0.5, 1e-4))
    assert plan(PLANNER, unlikely).rejected == {}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"state": START._replace(ds=math.nan)}, "ds = nan"),
        ({"state": START._replace(s=400.0)}, "choose a longer one"),
        ({"goal": Reach(math.inf)}, "not finite"),
        ({"goal": Reach(50.0, until=math.nan)}, "not finite"),
        ({"goal": Keep(-1.0)}, "negative speed"),
        ({"goal": Keep("8")}, "not of numbers"),
        ({"state": START._replace(s=-0.1)}, "choose a longer one"),
        ({"offsets": np.zeros((2, 2))}, "one or more numbers"),
        ({"wanted": math.nan}, "one or more numbers"),
        ({"stand": math.nan}, "stand is nan, but must be a number"),
        ({"offsets": np.zeros(0)}, "one or more numbers"),
        ({"boundary": boundary([], 0.5)}, "build them with that reach"),
        ({"stop": math.nan}, "stop is nan, but must be a number; infinity means none"),
        ({"obstacles": rectangle(40, 0)._replace(size=np.array([[4.0, -1.0]]))}, "obstacle 0: its size"),
        ({"obstacles": rectangle(40, 0)._replace(probability=np.array([1.5]))}, "between 0 and 1"),
        ({"obstacles": rectangle(40, 0)._replace(size=np.array([[4.0, 0.0]]))}, "obstacle 0: its size"),
        ({"obstacles": rectangle(40, 0)._replace(probability=np.array([-0.5]))}, "between 0 and 1"),
        ({"obstacles": rectangle(40, 0, math.nan)}, "obstacle 0: pose is not finite"),
        ({"obstacles": rectangle(40, 0)._replace(covariance=np.full((1, 60, 2, 2), [[1, 0.5], [0, 1]]))}, "symmetric"),
        ({"obstacles": rectangle(40, 0)._replace(covariance=np.full((1, 60, 2, 2), -np.eye(2)))}, "negative eigen"),
        ({"stop": None}, "stop is None, but must be a number"),
        ({"stand": "far"}, "stand is 'far', but must be a number"),
        ({"wanted": None}, "None is wanted, but they must be one or more numbers"),
        ({"state": START._replace(d="0")}, "state has d = '0', but must have a number"),
        ({"state": START._replace(ds=-0.1)}, "drives backwards, at -0.1 m/s"),
        ({"line": LINE._replace(table=LINE.table[:, :2])}, "table has shape \\(\\d+, 2\\)"),
        ({"line": LINE._replace(table=LINE.table * math.nan)}, "must be finite"),
        ({"state": Pose(25.0, 0.0, 0.0, 9.0)}, "state is of type Pose, but must be FrenetState"),
        ({"goal": 9.0}, "goal is of type float, but must be Keep or Reach"),
        ({"line": np.zeros((9, 2))}, "line is of type ndarray, but must be ReferenceLine"),
        ({"obstacles": None}, "obstacles is of type NoneType, but must be Obstacles"),
        ({"obstacles": no_obstacles(60)._replace(size=[[2.0, 1.0]])}, "size is a list, but must be an array"),
        ({"obstacles": no_obstacles(7)}, "must be \\(0, 60, 3\\)"),
    ],
)
def test_scenes_that_are_none_are_refused_in_words(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        plan(PLANNER, scene(START, Keep(10.0))._replace(**change))


@pytest.mark.parametrize(("previous", "elapsed"), [("last", 0.1), (None, -0.1), (None, math.nan)])
def test_last_plans_that_are_none_are_refused(previous: Any, elapsed: float) -> None:
    with pytest.raises(InputError, match="give a Plan and 0 s or more"):
        plan(PLANNER, scene(START, Keep(10.0)), previous, elapsed)


def test_limits_that_contradict_are_refused() -> None:
    with pytest.raises(InputError, match=r"comfort.braking is 9.0, more than the vehicle can: able.braking is 8.0"):
        Planner(comfort=Limits(braking=9.0))
    with pytest.raises(InputError, match=r"comfort.curvature_rate is 0.5, more than the vehicle can"):
        Planner(comfort=Limits(curvature_rate=0.5))
    for value in (-1.0, 0.0, math.inf, math.nan):
        with pytest.raises(InputError, match=f"limits: power is {value}"):
            Limits(power=value)
    with pytest.raises(InputError, match="vehicle: length is 0"):
        Vehicle(length=0.0)


def test_plans_are_the_same_bits_again() -> None:
    def trajectory() -> np.ndarray:
        found: Plan = plan(PLANNER, scene(START, Keep(12.0), obstacles=rectangle(50.0, 1.0)))
        return found.trajectory(np.arange(0, 3.0, 0.1))

    assert isinstance(candidates_of(PLANNER, scene(START, Keep(12.0))).longitudinal.motion, Polynomials)
    np.testing.assert_array_equal(trajectory(), trajectory())
