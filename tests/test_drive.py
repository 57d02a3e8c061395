"""Drives in closed loop: nobody is touched, no limit broken, lines and gaps are met; what goes wrong is told."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.closed_loop import Drive, Loop, Mind, Thought, drive, stop_along
from experiments.closed_loop_figures import Fan, candidate_handles, colours_of, figures
from experiments.closed_loop_metrics import contacts, gap_error, metrics, stop_error, violations
from experiments.drive import touches
from experiments.driver import by_the_rules
from experiments.run import check_read
from experiments.scenarios import driven_roads
from experiments.scenarios.driving import Body, DriveScene, Noise, Reacting, Recorded, Scripted, observe
from models.program import InputError
from planning.candidates import Fans, Keep
from planning.control import Control
from planning.frenet import FrenetState, Pose
from planning.planner import COMFORT, EMERGENCY, Planner, plan
from planning.reference import from_curvature
from planning.road import Route, Tracks
from planning.scene import Scene as PlanScene
from planning.shapes import boundary, no_obstacles
from tests.conftest import Command

LINE = from_curvature(np.arange(0.0, 201.0, 2.0), np.zeros(101))


def steady(speed: float = 9.0, *, fails: tuple[float, float] = (math.inf, math.inf), offset: float = 0.0) -> Any:
    """A mind that only keeps a speed on an offset, and that is at a loss between two times."""

    def mind(scene: DriveScene, route: Route, planner: Planner) -> Mind:
        lines = boundary(scene.boundary, planner.radius)

        def think(now: float, state: FrenetState, tracks: Tracks) -> Thought:
            if fails[0] <= now < fails[1]:
                raise InputError("nothing is seen")
            none = no_obstacles(planner.num_steps)
            return Thought(PlanScene(route.line, state, Keep(speed), np.array([offset]), offset, lines, none))

        return think

    return mind


CASES: dict[str, dict[str, Any]] = {
    "follow": {"duration": 24.0},
    "follow, noisy": {"duration": 28.0, "noise": 0.2},
    "stop_line": {"green": 8.0, "duration": 36.0},
    "parked_car": {"duration": 18.0},
    "parked_car, nobody comes": {"oncoming": False, "duration": 14.0},
    "cut_in": {"duration": 18.0},
    "merge": {"duration": 22.0},
    "roundabout": {"duration": 30.0},
    "box": {"duration": 3.0},
}


@pytest.fixture(scope="module")
def driven() -> dict[str, Drive]:
    return {
        name: drive(getattr(driven_roads, name.partition(",")[0])(**knobs), by_the_rules)
        for name, knobs in CASES.items()
    }


@pytest.mark.parametrize("name", CASES)
def test_nobody_is_touched_and_no_limit_broken(driven: dict[str, Drive], name: str) -> None:
    found = metrics(driven[name])
    assert (found["collisions_at_fault"], found["limit_violations"], found["stops_passed"]) == (0, 0, 0)
    assert found["stated"] == 0
    assert found["tracking_m"] < 0.02


@pytest.mark.parametrize("name", ["follow", "follow, noisy", "cut_in", "merge"])
def test_the_gap_is_met(driven: dict[str, Drive], name: str) -> None:
    assert metrics(driven[name])["gap_error_m"] < 0.3


def test_lights_are_obeyed(driven: dict[str, Drive]) -> None:
    found = driven["stop_line"]
    assert metrics(found)["stop_error_m"] < 0.15
    front = found.route.line.project(found.log.ego[:, :2])[0][:, 0] + found.planner.vehicle.front
    assert front[found.log.time < 8.0].max() <= 80.0 < front[-1] <= 200.0
    assert front[-1] > 199.8 and found.log.ego[-1, 3] < 1e-3


def test_the_ring_is_entered_after_those_on_it(driven: dict[str, Drive]) -> None:
    log = driven["roundabout"].log
    entry = np.array(driven["roundabout"].route.line.at(78.0)[:2])
    passed = [np.nanargmin(np.hypot(*(log.others[:, n, :2] - entry).T)) for n in range(2)]
    own = np.hypot(*(log.ego[::5, :2] - entry).T).argmin()
    assert own > max(passed) + 40, "two seconds after the second car"
    assert metrics(driven["roundabout"])["clearance_m"] > 2.0 and metrics(driven["roundabout"])["way_m"] > 120.0


def test_the_oncoming_car_is_let_through(driven: dict[str, Drive]) -> None:
    """Alone, the lane beside is used at once; otherwise only once the other car has passed."""
    for name in ("parked_car", "parked_car, nobody comes"):
        assert driven[name].log.ego[-1, 0] > 100.0, "it got past"
        assert metrics(driven[name])["clearance_m"] > 0.25
    waited, alone = (driven[name].log.time[np.argmax(driven[name].log.ego[:, 0] > 95.0)] for name in list(CASES)[3:5])
    assert waited > alone + 1.0


def test_the_box_is_an_emergency_that_ends_before_the_wall(driven: dict[str, Drive]) -> None:
    log = driven["box"].log
    assert log.tier[0] == EMERGENCY and driven["box"].plans[0].rejected
    assert log.ego[-1, 3] < 1e-3 and 0.0 < metrics(driven["box"])["boundary_clearance_m"]
    unclear = [metrics(driven["box"]._replace(log=log._replace(clear=np.arange(len(log.clear)) >= n))) for n in (0, 2)]
    assert [found["unclear"] for found in unclear] == [0.0, pytest.approx(2 / len(log.clear))]


def test_a_world_that_does_not_change_is_planned_as_before() -> None:
    scene = driven_roads.follow(duration=4.0)._replace(actors=())
    found = drive(scene, steady())
    assert np.nanquantile(found.log.consistency, 0.95) < 1e-9
    assert set(found.log.tier) == {COMFORT}


def test_the_same_seed_gives_the_same_drive() -> None:
    scene = driven_roads.follow(noise=0.3, duration=1.5)
    one, same, other = (drive(scene, by_the_rules, seed=seed).log.ego for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1e-6


def test_a_cycle_that_cannot_be_planned_is_an_emergency_stop_on_the_same_path_and_told() -> None:
    scene = driven_roads.follow(duration=6.0)._replace(actors=())
    found = drive(scene, steady(fails=(1.5, 4.2)))
    log = found.log
    lost = (log.cycle >= 1.5 - 1e-9) & (log.cycle < 4.2 - 1e-9)
    assert set(log.stated[lost]) == {"nothing is seen"} and not log.stated[~lost].any()
    assert set(log.tier[lost]) == {EMERGENCY} and not log.clear[lost].any()
    assert log.ego[log.time < 4.2, 3].min() < 1e-3, "it stands"
    assert log.ego[:, 4].min() > -1.02 * Planner().able.braking
    offset = found.route.line.project(log.ego[:, :2])[0][:, 1]
    assert np.abs(offset).max() < 0.03, "and stays on its path"
    assert log.ego[-1, 3] > 1.0, "and drives on when it sees again"


def test_an_emergency_stop_keeps_the_path_of_a_lateral_motion() -> None:
    planner = Planner()
    given = PlanScene(
        LINE, FrenetState(20.0, 10.0, 0.0, 0.0), Keep(10.0), np.array([2.0]), 2.0, boundary([], planner.radius),
        no_obstacles(planner.num_steps),
    )  # fmt: skip
    last = plan(planner, given)
    stop = stop_along(planner, last, 0.6)
    s, d = last.states([0.6])[0][0::3][:2]
    assert (stop.start.s, stop.start.d) == (s, d)
    there, then = stop.states([10.0])[0], np.array([state.s for state in last.states(np.arange(0, 3, 0.01))])
    assert there.ds == 0.0
    before = last.states([0.01 * float(np.argmin(np.abs(then - there.s)))])[0]
    assert there.d == pytest.approx(before.d, abs=0.15)
    braking = np.diff(stop.along(np.arange(0.0, 4.0, 0.01))[:, 1]) / 0.01
    assert braking.min() > -1.02 * planner.able.braking


REFINED = Loop(refine=True)


@pytest.mark.parametrize(("name", "speed"), [("follow", 10.0), ("parked_car", 6.0)])
def test_refined_motions_are_followed_within_all_limits(name: str, speed: float) -> None:
    scene = getattr(driven_roads, name)(duration=4.5)
    found = drive(scene._replace(ego=scene.ego._replace(speed=speed)), by_the_rules, loop=REFINED)
    log, told = found.log, metrics(found)
    assert (told["collisions"], told["limit_violations"], told["stops_passed"], told["stated"]) == (0, 0, 0, 0)
    assert told["refined"] > 0.5 and told["cost_mean"] < told["plan_cost_mean"]
    assert (log.cost[log.refined] <= log.plan_cost[log.refined]).all()
    np.testing.assert_array_equal(log.cost[~log.refined], log.plan_cost[~log.refined])
    assert ((log.unrefined != "") == ~log.refined).all()
    gone = round(found.planner.fans.cycle / found.planner.step)
    np.testing.assert_allclose(log.planned[1:, 0], log.planned[:-1, gone], atol=1e-6)  # each begins on what is followed
    assert told["tracking_m"] < 0.02


def test_a_refined_drive_that_loses_sight_stops_from_what_it_followed() -> None:
    scene = driven_roads.follow(duration=4.5)._replace(actors=())
    scene = scene._replace(ego=scene.ego._replace(y=scene.ego.y + 0.8))
    found = drive(scene, steady(6.0, fails=(0.9, math.inf)), loop=REFINED)
    log, gone = found.log, round(found.planner.fans.cycle / found.planner.step)
    first = int(np.argmax(log.stated != ""))
    assert log.refined[:first].all() and not log.refined[first:].any() and set(log.tier[first:]) == {EMERGENCY}
    np.testing.assert_allclose(log.planned[1:, 0], log.planned[:-1, gone], atol=1e-6)
    unrefined = found.plans[first - 1].trajectory([found.planner.fans.cycle])[0]
    assert np.abs(log.planned[first, 0] - unrefined).max() > 1e-3, "and not from the plan"
    there = found.route.line.project(log.ego[:, :2])[0][:, 1]
    assert np.diff(there).max() < 1e-3 and there.min() > -0.05, "towards the offset that it was on its way to"
    assert not violations(found).any() and log.ego[-1, 3] < 1e-3


def test_a_scene_that_cannot_be_begun_is_refused() -> None:
    scene = driven_roads.follow()
    with pytest.raises(InputError, match="before or after the line"):
        drive(scene._replace(ego=scene.ego._replace(x=-50.0)), steady())
    with pytest.raises(InputError, match="names lane 7"):
        drive(scene._replace(route=(7,)), steady())
    with pytest.raises(InputError, match="nothing is seen"):
        drive(scene, steady(fails=(0.0, 1.0)))
    with pytest.raises(InputError, match=r"answered with a NoneType; return experiments.closed_loop.Thought"):
        drive(scene, lambda *given: lambda *seen: None)  # type: ignore[arg-type, return-value]
    with pytest.raises(InputError, match=r"the driver gave a NoneType; return a mind"):
        drive(scene, lambda *given: None)  # type: ignore[arg-type, return-value]
    with pytest.raises(InputError, match=r"would have a NoneType planned in; give planning.scene.Scene"):
        drive(scene, lambda *given: lambda *seen: Thought(None))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"horizon is 0.1 s, but must be a cycle, "):
        drive(scene, steady(), Planner(horizon=0.1))
    with pytest.raises(InputError, match="seed is -1"):
        drive(scene, steady(), seed=-1)
    with pytest.raises(InputError, match=r"world is 1e\+308 s, but must be a multiple"):
        Loop(world=1e308)


def test_a_scene_with_parts_that_cannot_be_is_refused_before_the_drive() -> None:
    scene = driven_roads.stop_line()
    first, lane = scene.stops[0], scene.lanes[1]
    nan = math.nan
    for wrong, sentence in (
        (scene._replace(ego=scene.ego._replace(speed=-5.0)), "the vehicle's speed is -5.0 m/s"),
        (scene._replace(wanted=nan), "the speed wanted is nan m/s"),
        (scene._replace(actors=("car",)), "road user 0 is a str"),  # type: ignore[arg-type]
        (scene._replace(stops=(first._replace(s=nan),)), "stop point first is from nan to"),
        (
            scene._replace(stops=(first._replace(zone=first.zone[:0]),)),
            r"the zone of stop point first has shape \(0, 2",
        ),
        (scene._replace(lights={"last": ((0.0, "red"),)}), "the light 'last' is of no stop point"),
        (scene._replace(lights={"first": ((1.0, "red"),)}), r"the light 'first' changes at \[1.0\] s"),
        (
            scene._replace(lights={"first": ((0.0, "rot"),)}),
            "the light 'first' is 'rot' once, but must be one of green",
        ),
        (scene._replace(lanes={1: lane._replace(speed=nan)}), "lane 1: its speed limit is nan"),
        (scene._replace(lanes={**scene.lanes, 1: lane._replace(left=lane.right, right=lane.left)}), "exchange them"),
        (scene._replace(lanes={}), "which the map has not; it has none"),
    ):
        with pytest.raises(InputError, match=sentence):
            drive(wrong, steady())


def test_road_users_that_cannot_be_are_refused() -> None:
    going = ((0.0, 5.0),)
    for make, sentence in (
        (lambda: Scripted(LINE, math.nan, going), "start is nan"),
        (lambda: Scripted(LINE, 0.0, 5.0), "speed is 5.0, but must be"),  # type: ignore[arg-type]
        (lambda: Scripted(LINE, 0.0, ()), "speed is"),
        (lambda: Scripted(LINE, 0.0, ((3.0, 5.0), (1.0, 5.0))), "times of its speed must rise"),
        (lambda: Scripted(LINE, 0.0, ((0.0, -5.0),)), "its speed is -5.0 m/s; give it a line that runs the other way"),
        (lambda: Scripted(LINE, 0.0, going, ((0.0, math.nan),)), "offset is"),
        (lambda: Scripted(LINE, 0.0, going, size=(4.0, 0.0)), "its size is"),
        (lambda: Reacting(LINE, 0.0, 5.0, 0.0), "wanted is 0.0, but must be positive"),
        (lambda: Reacting(LINE, 0.0, -5.0, 8.0), "speed is -5.0, but must be 0 or more"),
        (lambda: Recorded(np.zeros(1), np.zeros((1, 5)), size=(-1.0, 2.0)), "its size is"),
    ):
        with pytest.raises(InputError, match=sentence):
            make()


def test_a_vehicle_off_its_plan_is_planned_from_where_it_is() -> None:
    """A drive that lags more than its controller believes falls behind; the tolerance decides."""
    from planning.control import Lags

    scene = driven_roads.follow(duration=3.0)._replace(actors=())
    scene = scene._replace(ego=scene.ego._replace(speed=2.0))
    slow = Lags(drive=1.2)
    near, far = (drive(scene, steady(), loop=Loop(lags=slow, tolerance=tolerance)).log for tolerance in (0.1, 50.0))
    apart = [np.hypot(*(log.ego - log.wanted)[:, :2].T).max() for log in (near, far)]
    assert apart[0] < 0.2 < apart[1]


def record(track: list[tuple[float, float, float, float]]) -> Recorded:
    """(t, x, y, speed), heading east."""
    t, x, y, v = np.array(track).T
    return Recorded(t, np.stack([x, y, np.zeros_like(x), v, np.zeros_like(x)], -1))


@pytest.mark.parametrize(
    ("actor", "fault"),
    [
        (record([(0.0, -20.0, 0.0, 15.0), (3.0, 60.0, 0.0, 15.0)]), False),
        (record([(0.0, 60.0, 0.0, 0.0), (9.0, 60.0, 0.0, 0.0)]), True),
        (record([(0.0, 60.0, -5.0, 0.0), (9.0, 60.0, -5.0, 0.0)]), None),
    ],
)
def test_who_drives_into_the_vehicle_from_behind_is_at_fault_himself(actor: Recorded, fault: bool | None) -> None:
    straight = driven_roads.box(duration=6.0)._replace(boundary=(), actors=(actor,))
    found = drive(straight, steady(10.0))
    assert [(one.actor, not one.excuse) for one in contacts(found)] == ([] if fault is None else [(0, fault)])
    words = {None: [], False: [("road user 0", "from behind")], True: [("road user 0", "at fault")]}
    assert [told[1:] for told in touches(found)] == words[fault]


def test_touched_walls_and_broken_limits_are_counted() -> None:
    blind = drive(driven_roads.box(duration=3.0), steady(10.0))
    through = blind._replace(log=blind.log._replace(ego=blind.log.ego + np.eye(6)[0] * 8.0))
    assert contacts(blind) == [] and [(one.actor, one.excuse) for one in contacts(through)] == [(-1, "")]
    assert all(made.candidates is None for made in blind.plans), "they would fill the memory"
    assert metrics(through)["boundary_clearance_m"] == 0.0
    quick = drive(driven_roads.follow(duration=3.0)._replace(actors=()), steady(9.0))
    assert not violations(quick).any()
    for values in ({3: 14.5}, {4: 3.1}, {4: -5.2}, {5: 0.03}, {3: 1.0, 5: 0.21}):
        ego = quick.log.ego.copy()
        for column, value in values.items():
            ego[100:, column] = value
        assert violations(quick._replace(log=quick.log._replace(ego=ego)))[100:].all()
    stopped = quick._replace(log=quick.log._replace(stop=np.full(len(quick.log.stop), 30.0)))
    assert metrics(stopped)["stops_passed"] == 1.0
    assert stop_error(quick) is None and gap_error(quick, 4.0, 1.2) is None


def test_actors_move_as_told() -> None:
    brakes = Scripted(LINE, 10.0, ((1.0, 8.0), (3.0, 4.0)), ((0.0, 0.0), (2.0, 3.0)), there=(0.0, 5.0))
    at = [brakes.moved(t, 0.05, None, ()) for t in (0.0, 1.0, 3.0, 4.0)]
    assert [p.x for p in at if p] == pytest.approx([10.0, 18.0, 30.0, 34.0], abs=1e-6)
    assert [p.y for p in at if p] == pytest.approx([0.0, 1.5, 3.0, 3.0], abs=1e-6)
    middle = brakes.moved(2.0, 0.05, None, ())
    assert middle is not None and middle.acceleration == pytest.approx(-2.0, abs=1e-5)
    assert brakes.moved(5.1, 0.05, None, ()) is None
    way = np.array([brakes.moved(t, 0.05, None, ())[:2] for t in np.arange(0.0, 4.0, 1e-3)])  # type: ignore[index]
    for t in (0.7, 1.8, 2.6):
        pose, k = brakes.moved(t, 0.05, None, ()), round(t * 1000)
        assert pose is not None
        moved = (way[k + 1] - way[k - 1]) / 2e-3
        assert np.hypot(*moved) == pytest.approx(pose.speed, rel=1e-3)
        assert math.atan2(moved[1], moved[0]) == pytest.approx(pose.heading, abs=1e-3)


def test_who_reacts_keeps_his_distance_and_his_speed() -> None:
    alone, behind = Reacting(LINE, 0.0, 6.0, 8.0), Reacting(LINE, 0.0, 8.0, 12.0)
    free, kept = alone.moved(0.0, 0.05, None, ()), behind.moved(0.0, 0.05, None, ())
    for k in range(300):
        assert free is not None and kept is not None
        free = alone.moved(0.05 * (k + 1), 0.05, free, ())
        ahead = Body(Pose(30.0 + 5.0 * 0.05 * k, 0.2, 0.0, 5.0), (4.0, 2.0))
        aside = Body(Pose(30.0, 3.5, 0.0, 0.0), (4.0, 2.0))
        kept = behind.moved(0.05 * (k + 1), 0.05, kept, (ahead, aside))
    assert free is not None and kept is not None
    assert free.speed == pytest.approx(8.0, abs=0.05)
    balance = (2.0 + 5.0 * 1.2) / math.sqrt(1 - (5.0 / 12.0) ** 4)
    assert kept.speed == pytest.approx(5.0, abs=0.1)
    assert 30.0 + 5.0 * 15.0 - kept.x - 4.3 == pytest.approx(balance, abs=0.5)


def test_tracks_are_the_truth_with_the_noise_told() -> None:
    poses: list[Pose | None] = [Pose(1.0, 2.0, 0.3, 4.0, 0.5), None, Pose(5.0, 6.0, 0.1, 0.0)]
    actors = tuple(Scripted(LINE, 0.0, ((0.0, 0.0),), kind=kind) for kind in ("car", "bicycle", "pedestrian"))
    scene = driven_roads.follow()._replace(actors=actors, noise=Noise(position=0.3, speed=0.2))
    told = [observe(scene, poses, np.random.default_rng(seed)) for seed in range(2000)]
    assert told[0].label.tolist() == [0, 2] and told[0].kind.tolist() == ["car", "pedestrian"]
    place = np.array([tracks.position[0] for tracks in told])
    # of 2000 draws, mean and sd have standard errors of .3 / sqrt(2000) = .0067 and .3 / sqrt(4000) = .0047: 4 of them
    assert np.abs(place.mean(0) - [1.0, 2.0]).max() < 0.027 and np.abs(place.std(0) - 0.3).max() < 0.019
    assert all((tracks.speed >= 0).all() for tracks in told)
    np.testing.assert_allclose(told[0].covariance, [np.eye(2) * 0.09] * 2)
    quiet = observe(scene._replace(noise=Noise()), poses, np.random.default_rng(0))
    np.testing.assert_allclose(quiet.position, [[1.0, 2.0], [5.0, 6.0]])


def test_what_is_no_record_or_loop_is_refused() -> None:
    with pytest.raises(InputError, match="must rise"):
        record([(0.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)])
    with pytest.raises(InputError, match="finite poses"):
        Recorded(np.arange(2.0), np.full((2, 5), math.nan))
    with pytest.raises(InputError, match=r"loop: world is 0.05 s, but must be a multiple of control.step, 0.02 s"):
        Loop(control=Control(step=0.02))
    with pytest.raises(InputError, match=r"loop: cycle is 0.16 s, but must be a multiple of world, 0.05 s"):
        drive(driven_roads.box(), steady(), Planner(fans=Fans(cycle=0.16)))
    with pytest.raises(InputError, match=r"duration is 0.1 s, but must be a cycle"):
        drive(driven_roads.box(duration=0.1), steady())
    with pytest.raises(InputError, match="noise: position is -1"):
        driven_roads.follow(noise=-1.0)
    with pytest.raises(InputError, match=r"gap is 5.0 m"):
        driven_roads.merge(gap=5.0)
    with pytest.raises(InputError, match="tolerance is 0"):
        Loop(tolerance=0.0)
    with pytest.raises(InputError, match=r"one to drive in.*python -m experiments.drive"):
        check_read(driven_roads.follow())  # type: ignore[arg-type]


def test_pictures_have_axes_with_units_and_a_legend(driven: dict[str, Drive]) -> None:
    for name in ("box", "parked_car"):
        drawn = figures(driven[name])
        (above,) = drawn["cycle"].axes
        assert (above.get_xlabel(), above.get_ylabel()) == ("x [m]", "y [m]")
        told = [text.get_text() for text in drawn["cycle"].legends[0].get_texts()]
        assert {"plan (3 s)", "boundary lines"} <= set(told)
        assert any(text.startswith("good: " if name == "parked_car" else "boundary line: ") for text in told)
        assert all("[m" in axes.get_ylabel() for axes in drawn["drive"].axes)
        assert drawn["drive"].axes[-1].get_xlabel() == "time [s]"


def test_reasons_of_one_colour_are_one_entry_of_the_legend() -> None:
    none, fan = np.zeros(0), {reason: 100 - reason for reason in range(10)}
    told = Fan(np.zeros((0, 2, 2)), none.astype(np.int64), fan)
    handles = candidate_handles(told, colours_of(told))
    assert len({handle.get_color() for handle in handles}) == len(handles) == 8
    assert handles[0].get_label() == "good: 100" and handles[-1].get_label() == "other reasons: 276"


def test_who_is_passed_is_told(driven: dict[str, Drive]) -> None:
    words = driven["parked_car, nobody comes"].log.words
    assert words[0] == "keep" and "keep; passing road user 0" in words.tolist()


def test_a_drive_by_command_is_stored_whole_and_not_repeated(launch: Command) -> None:
    words = ["scenario=drive_box", "scenario.duration=1.5", "figures=[]"]
    done = launch(*words, module="experiments.drive")
    assert done.returncode == 0, done.stderr
    (folder,) = Path("runs").iterdir()
    assert folder.name.startswith("drive_box-frenet-")
    stored = {path.name for path in folder.iterdir()}
    assert stored == {"manifest.json", "scores.json", "drive.npz", "cycles.csv", "report.html"}
    assert json.loads((folder / "scores.json").read_text())["collisions_at_fault"] == 0
    with np.load(folder / "drive.npz", allow_pickle=False) as log:
        assert log["ego"].shape == (151, 6) and log["tier"][0] == EMERGENCY
    report = (folder / "report.html").read_text()
    assert "http://" not in report and "boundary lines that were touched" in report
    again = launch(*words, module="experiments.drive")
    assert "done already" in again.stdout


@pytest.mark.parametrize(
    ("module", "words", "sentence"),
    [
        ("drive", ["scenario=line"], "none to drive in; choose one whose name begins with drive_"),
        ("drive", ["scenario=drive_folow"], "did you mean 'drive_follow'?"),
        ("drive", ["planner.riks=1"], "planner has no knob 'riks'; did you mean 'risk'?"),
        ("drive", ["planner.comfort.braking=9"], "comfort.braking is 9.0, more than the vehicle can"),
        ("drive", ["seed=-1"], "seed is -1; choose 0 or more"),
        ("drive", ["experiment=demo"], "experiment=demo chooses a model, which this command has not"),
        ("run", ["experiment=commonroad"], "experiment=commonroad chooses a planner, which this command has not"),
        ("drive", ["engine=lmb"], "this command has no engine"),
        ("run", ["driver=by_the_rules"], "this command has no driver"),
        ("drive", ["scenario=drive_box", "scenario.distance=-5"], "distance is -5.0 m"),
        ("run", ["scenario=drive_box"], "`python -m experiments.drive` drives it"),
    ],
)
def test_mistakes_are_one_sentence(launch: Command, module: str, words: list[str], sentence: str) -> None:
    done = launch(*words, module=f"experiments.{module}")
    assert done.returncode == 2 and sentence in done.stderr and "Traceback" not in done.stderr, done.stderr
    assert not Path("runs").exists() or not list(Path("runs").iterdir())
