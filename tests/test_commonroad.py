"""CommonRoad scenarios are read as they are written, and driven through without a fault."""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.closed_loop import Drive, drive
from experiments.closed_loop_metrics import Contact, contacts, metrics
from experiments.driver import by_the_rules
from experiments.goal_metrics import goals, within_turn
from experiments.scenarios.commonroad import Light, read
from experiments.scenarios.commonroad_drive import commonroad, for_cars, moving
from experiments.scenarios.commonroad_stops import colours_of, is_for
from experiments.scenarios.lane_search import lanes_at, onwards, route_of, search, turn_of
from models.program import InputError
from planning.kinematics import Limits
from planning.planner import Planner
from planning.road import Lane, Lanes, route
from planning.shapes import Vehicle

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "planning"
FILES = {
    "DEU_A9-3_1_T-1": (32, 9),
    "DEU_AAH-2_26003_T-1": (48, 12),
    "DEU_AAH-3_33000_T-1": (56, 7),
    "DEU_AAH1-2_76900_T-7049": (26, 10),
    "DEU_Starnberg-1_1_T-1": (91, 0),
    "FRA_Anglet-1_1_T-1": (20, 8),
    "USA_Lanker-1_1_T-1": (95, 24),
    "USA_Peach-2_1_T-1": (75, 16),
    "USA_Peach-4_1_T-1": (79, 20),
    "USA_US101-3_3_T-1": (12, 12),
    "USA_US101-4_1_T-1": (12, 22),
}
recorded = pytest.mark.skipif(not DATA.is_dir(), reason=f"the recorded scenarios are not at {DATA}")


def points(*told: tuple[float, float]) -> str:
    return "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in told)


def lanelet(key: int, start: float, end: float, y: float, more: str = "") -> str:
    """Eastwards, 4 m wide, its middle at y."""
    left, right = (points((start, y + d), (end, y + d)) for d in (2.0, -2.0))
    return f'<lanelet id="{key}"><leftBound>{left}</leftBound><rightBound>{right}</rightBound>{more}</lanelet>'


def state(tag: str, step: int, x: float, y: float, speed: float, more: str = "") -> str:
    return (
        f"<{tag}><position>{points((x, y))}</position><orientation><exact>0.0</exact></orientation>"
        f"<time><exact>{step}</exact></time><velocity><exact>{speed}</exact></velocity>{more}</{tag}>"
    )


def scenario(version: str, body: str, root: str = "commonRoad") -> str:
    return f'<{root} commonRoadVersion="{version}" timeStepSize="0.5" benchmarkID="TEST-1">{body}</{root}>'


BESIDE = '<adjacentLeft ref="3" drivingDir="same"/>'
GOAL = (
    "<goalState><position><rectangle><length>10</length><width>4</width><orientation>0</orientation>"
    "<center><x>150</x><y>0</y></center></rectangle></position><time><intervalStart>4</intervalStart>"
    "<intervalEnd>30</intervalEnd></time><velocity><intervalStart>8</intervalStart><intervalEnd>12</intervalEnd>"
    "</velocity></goalState>"
)
OLD = scenario(
    "2018b",
    lanelet(1, 0, 100, 0, '<successor ref="2"/>' + BESIDE + "<speedLimit>12.5</speedLimit>")
    + lanelet(2, 100, 300, 0, '<predecessor ref="1"/>')
    + lanelet(3, 0, 100, 4, '<adjacentRight ref="1" drivingDir="same"/>')
    + '<obstacle id="7"><role>static</role><type>parkedVehicle</type><shape><circle><radius>1.5</radius></circle>'
    "</shape>" + state("initialState", 0, 60, 4, 0) + "</obstacle>"
    '<obstacle id="8"><role>dynamic</role><type>car</type><shape><rectangle><length>4</length><width>2</width>'
    "</rectangle></shape><initialState><position><rectangle><length>2</length><width>1</width><orientation>0"
    "</orientation><center><x>90</x><y>0</y></center></rectangle></position><orientation><intervalStart>-0.1"
    "</intervalStart><intervalEnd>0.3</intervalEnd></orientation><time><exact>0</exact></time><velocity>"
    "<intervalStart>9</intervalStart><intervalEnd>11</intervalEnd></velocity></initialState><trajectory>"
    + state("state", 1, 95, 0, 12)
    + state("state", 2, 101, 0, 14, "<acceleration><exact>-1</exact></acceleration>")
    + '</trajectory></obstacle><planningProblem id="5">'
    + state("initialState", 0, 20, 0, 10)
    + GOAL
    + "</planningProblem>",
)
NEW = scenario(
    "2020a",
    lanelet(
        1, 0, 100, 0,
        '<successor ref="2"/><stopLine>' + points((95, 2), (95, -2)) + "<lineMarking>solid</lineMarking></stopLine>"
        '<laneletType>urban</laneletType><userOneWay>car</userOneWay><trafficSignRef ref="11"/>'
        '<trafficLightRef ref="12"/>',
    )
    + lanelet(2, 100, 300, 0, "<laneletType>urban</laneletType>")
    + lanelet(4, 0, 300, 4, "<laneletType>sidewalk</laneletType>")
    + '<trafficSign id="11"><trafficSignElement><trafficSignID>274</trafficSignID><additionalValue>8.5'
    "</additionalValue></trafficSignElement><trafficSignElement><trafficSignID>206</trafficSignID>"
    "</trafficSignElement></trafficSign>"
    '<trafficLight id="12"><cycle><cycleElement><duration>20</duration><color>red</color></cycleElement>'
    "<cycleElement><duration>10</duration><color>green</color></cycleElement><timeOffset>4</timeOffset></cycle>"
    "<direction>all</direction><active>true</active></trafficLight>"
    '<dynamicObstacle id="21"><type>pedestrian</type><shape><polygon>' + points((0, 0), (2, 0), (2, 1), (0, 1))
    + "</polygon></shape>" + state("initialState", 2, 10, 4, 1) + "<trajectory>" + state("state", 4, 11, 4, 1)
    + "</trajectory></dynamicObstacle>"
    '<staticObstacle id="22"><type>unknown</type><shape><rectangle><length>2</length><width>1</width><orientation>'
    + f"{math.pi / 2}</orientation></rectangle></shape><initialState><position>" + points((200, 4))
    + "</position><orientation><exact>0</exact></orientation><time><exact>0</exact></time></initialState>"
    '</staticObstacle><planningProblem id="6">' + state("initialState", 0, 20, 0, 5)
    + '<goalState><position><lanelet ref="2"/></position><time><intervalStart>0</intervalStart><intervalEnd>60'
    "</intervalEnd></time></goalState></planningProblem>",
)  # fmt: skip


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def to_file(text: str, name: str = "made.xml") -> str:
        file = tmp_path / name
        file.write_bytes(gzip.compress(text.encode()) if name.endswith("gz") else text.encode())
        return str(file)

    return to_file


def test_a_2018b_scenario_is_read(write: Any) -> None:
    told = read(write(OLD, "made.xml.gz"))
    assert (told.name, told.version, told.step) == ("TEST-1", "2018b", 0.5)
    one = told.lanes[1]
    assert (one.successors, one.beside, one.opposite, one.speed) == ((2,), (3, None), (False, False), 12.5)
    assert math.isinf(told.lanes[2].speed)
    np.testing.assert_array_equal(one.left, [[0, 2], [100, 2]])
    parked, car = told.obstacles
    assert (parked.static, parked.kind, car.static, car.kind) == (True, "parkedVehicle", False, "car")
    np.testing.assert_allclose(parked.size, [3.0, 3.0])
    np.testing.assert_array_equal(car.time, [0.0, 0.5, 1.0])
    # the speeds 10, 12, 14 rise by 4 m/s^2; the last state tells another acceleration
    np.testing.assert_allclose(car.poses, [[90, 0, 0.1, 10, 4], [95, 0, 0, 12, 4], [101, 0, 0, 14, -1]])
    np.testing.assert_allclose(car.spread[0], [1.0, 0.5, 0.2, 1.0])
    problem = told.problems[5]
    np.testing.assert_array_equal(problem.start, [20, 0, 0, 10, 0])
    (goal,) = problem.goals
    assert (goal.time, goal.speed, goal.lanes) == ((2.0, 15.0), (8.0, 12.0), ())
    np.testing.assert_allclose(np.sort(goal.places[0][:, 0]), [145, 145, 155, 155])


def test_a_2020a_scenario_is_read(write: Any) -> None:
    told = read(write(NEW))
    assert told.lanes[1].speed == 8.5 and told.signs[1] == ("274", "206") and told.lane_lights[1] == (12,)
    assert told.kinds[1] == {"urban", "for car"} and for_cars(told.kinds[1]) and not for_cars(told.kinds[4])
    np.testing.assert_array_equal(told.stop_lines[1].ends, [[95, 2], [95, -2]])
    walker, thing = told.obstacles
    np.testing.assert_allclose(walker.size, [2.0, 1.0])
    np.testing.assert_allclose(walker.poses[:, :2], [[11, 4.5], [12, 4.5]])  # the polygon's middle is (1, .5) ahead
    np.testing.assert_allclose(thing.size, [1.0, 2.0])  # it lies across
    assert told.problems[6].goals[0].lanes == (2,)
    # red for 10 s, green for 5 s, begun at 2 s: green before that
    assert told.lights[12].colours(13.0) == ((0.0, "green"), (2.0, "red"), (12.0, "green"))


def test_lights_of_one_line_are_told_together() -> None:
    arrow = Light(((2.0, "red"), (2.0, "green")), 0.0, "right")
    main = Light(((3.0, "green"), (1.0, "yellow")), 0.0, "all")
    assert colours_of([main], 1.0, 2.5) == ((0.0, "green"), (2.0, "yellow"))
    assert colours_of([arrow], 0.0, 3.0) == ((0.0, "red"), (2.0, "green"))
    assert colours_of([arrow, main], 0.0, 7.0) == ((0.0, "green"),)
    assert is_for(arrow, -1.0) and not is_for(arrow, 0.0) and is_for(main, 1.0)
    assert is_for(Light((), 0.0, "straightRight"), 0.1) and not is_for(Light((), 0.0, "straightRight"), 0.9)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("<a", "is no XML"),
        (scenario("2020a", "", "osm"), "outermost element is <osm>"),
        (scenario("2017a", ""), "commonRoadVersion is 2017a; 2018b and 2020a can be read"),
        (scenario("2020a", ""), "no lanelets"),
        (scenario("2020a", '<lanelet id="3"></lanelet>'), "lanelet 3 has no leftBound"),
        (OLD.replace("<x>95</x>", "<x>nan</x>"), r"obstacle 8 at 0.5 s: position: x of a point is nan"),
        (OLD.replace('<successor ref="2"/>', '<successor ref="9"/>'), "lanelet 1 refers to lanelet 9"),
        (OLD.replace("12.5", "fast"), "lanelet 1: speedLimit is 'fast', but must be a number"),
        (OLD.replace("<radius>1.5</radius>", "<radius>0</radius>"), "obstacle 7: its size is"),
        (OLD.replace("<time><exact>2<", "<time><exact>1<"), "obstacle 8: the times of its states must rise"),
        (NEW.replace("<type>pedestrian</type>", ""), "dynamicObstacle 21 has no type"),
        (NEW.replace("<trajectory>", "<occupancySet/><trajectory>", 1), "only trajectories can be replayed"),
    ],
)
def test_wrong_files_are_one_sentence(write: Any, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        read(write(text))


def test_a_file_that_is_not_there_or_half_there_is_told(write: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        read(str(tmp_path / "none.xml"))
    file = Path(write(OLD, "half.xml.gz"))
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(InputError, match="cannot be read"):
        read(str(file))


def straight(start: float, end: float, y: float, **more: Any) -> Lane:
    x = np.array([start, end])
    return Lane(np.stack([x, x * 0 + y + 2], -1), np.stack([x, x * 0 + y - 2], -1), **more)


def grid() -> Lanes:
    """Two rows of three lanes; the upper row begins at the second."""
    return {
        1: straight(0, 50, 0, successors=(2,)),
        2: straight(50, 100, 0, successors=(3,), beside=(5, None)),
        3: straight(100, 150, 0, beside=(6, None)),
        5: straight(50, 100, 4, successors=(6,), beside=(None, 2)),
        6: straight(100, 150, 4, beside=(None, 3), successors=(7,)),
        7: straight(150, 200, 4),
    }


def test_the_shortest_path_changes_lanes_where_it_must() -> None:
    lanes = grid()
    assert search(lanes, lanes, 1, [3]) == [1, 2, 3]
    assert search(lanes, lanes, 2, [7]) in ([2, 5, 6, 7], [2, 3, 6, 7])
    assert search(lanes, lanes, 7, [1]) is None
    assert search(lanes, [1, 2, 3], 1, [7]) is None
    assert route_of(lanes, lanes, [2, 3, 6, 7]) == (lanes, [5, 6, 7])  # the lane changed to goes back all the way
    assert onwards(lanes, lanes, [5], 60.0) == [5, 6, 7]
    assert lanes_at(lanes, lanes, np.array([60.0, 1.0]), 0.1) == [2]
    assert lanes_at(lanes, lanes, np.array([60.0, 1.0]), math.pi) == []


def test_a_lane_is_made_where_the_other_does_not_reach_back() -> None:
    lanes, ids = route_of(grid(), grid(), [1, 2, 3, 6, 7])
    assert ids[0] == 1 and ids[2] == 7 and ids[1] not in grid()
    way = route(lanes, ids)
    # the line is smoothed by a tenth of a metre: within three of them
    np.testing.assert_allclose(way.line.project([[40.0, 0.0], [100.0, 2.0], [180.0, 4.0]])[0][:, 1], 0.0, atol=0.3)
    x, y = lanes[ids[1]].centre.T
    bend = np.abs(np.gradient(np.gradient(y, x), x)).max()
    most = 10 / math.sqrt(3)  # of the second derivative of u^3 (10 - 15 u + 6 u^2)
    assert bend == pytest.approx(most * 4 / 100**2, rel=0.03)
    assert turn_of(lanes[ids[1]]) == pytest.approx(0.0, abs=0.02)


def test_speeds_are_those_of_the_places() -> None:
    time = np.arange(0.0, 4.0, 0.1)
    x = 3.0 * time + 0.5 * 1.5 * time**2
    poses = np.stack([x * 0.6, x * 0.8, np.full_like(x, math.atan2(0.8, 0.6)), 99.0 + 0 * x, -9.0 + 0 * x], -1)
    told = moving(time, poses, 0.3)
    np.testing.assert_allclose(told[:, 3], 3.0 + 1.5 * time, atol=1e-9)
    np.testing.assert_allclose(told[:, 4], 1.5, atol=1e-9)
    np.testing.assert_array_equal(told[:, :3], poses[:, :3])


def test_the_made_scenario_is_driven_to_its_goal(write: Any) -> None:
    scene = commonroad(write(OLD), duration=15.0)
    assert scene.route[:2] == (1, 2) and scene.lanes[scene.route[-1]].left[-1, 0] == pytest.approx(400.0)
    assert scene.ego.x == 20.0 - Vehicle().middle and scene.wanted == 10.0
    kerbs = np.concatenate(scene.boundary)
    assert kerbs[:, 1].min() == pytest.approx(-2.0, abs=0.06) and kerbs[:, 1].max() == pytest.approx(6.0, abs=0.06)
    found = drive(scene, by_the_rules)
    told = metrics(found) | goals(found)
    assert (told["collisions"], told["limit_violations"], told["goal_reached"]) == (0.0, 0.0, 1.0)
    assert told["goal_time_s"] == pytest.approx(12.5, abs=0.1), "(145 - 20) m at 10 m/s"
    late = {**scene.info["goals"][0], "time": [0.0, 12.0]}
    missed = goals(found._replace(scene=scene._replace(info={"goals": [late]})))
    assert (missed["goal_reached"], missed["goal_place"], missed["goal_distance_m"]) == (0.0, 1.0, 0.0)


def test_lights_and_lines_are_stop_points(write: Any) -> None:
    scene = commonroad(write(NEW))
    (stop,) = scene.stops
    assert stop.kind == "light" and stop.s == pytest.approx(95.0, abs=0.2)
    assert scene.lights_at(1.0) == {stop.name: "green"} and scene.lights_at(3.0) == {stop.name: "red"}
    assert scene.duration == 2.0, "until the last record of others"
    without = commonroad(write(NEW.replace('<trafficLightRef ref="12"/>', "")))
    assert without.stops == (), "nobody crosses behind the line"


def test_scenarios_that_cannot_be_driven_are_one_sentence(write: Any) -> None:
    for knobs, sentence in (
        ({"problem": 9}, "scenario.problem is 9, but the planning problems are 5"),
        ({"start": 77}, "scenario.start is 77, but there is no such lane; cars may drive on 1, 2"),
        ({"goal": 3, "start": 2}, "no way leads from lane 2 to the goal on lane 3"),
        ({"duration": -1.0}, "scenario.duration is -1.0"),
    ):
        with pytest.raises(InputError, match=sentence):
            commonroad(write(OLD), **knobs)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="on no lane that a car may drive"):
        commonroad(write(OLD.replace("<x>20</x><y>0</y>", "<x>20</x><y>50</y>")))
    with pytest.raises(InputError, match=r"no planning problem; choose a lane as scenario.start \(1, 2.*\), and"):
        commonroad(write(OLD[: OLD.index("<planningProblem")] + "</commonRoad>"))
    empty = OLD[: OLD.index("<obstacle")] + "</commonRoad>"
    with pytest.raises(InputError, match="no goal and no road user says when the drive ends"):
        commonroad(write(empty), start=1)


def test_a_route_file_is_driven_along(write: Any, tmp_path: Path) -> None:
    way = tmp_path / "route.txt"
    way.write_text("1,\n2")
    assert commonroad(write(OLD), route=str(way)).route[:2] == (1, 2)
    way.write_text("1 3")  # into the lane beside
    assert 3 in commonroad(write(OLD), route=str(way), duration=5.0).route
    for text, sentence in (
        ("1 two", "has 'two' where a lane id should be"),
        ("1 --2", "has '--2' where"),
        ("1 \u00b2", "has '\u00b2' where"),
        ("1" * 5000, "where a lane id should be"),
        ("", "is empty"),
        ("1 9", "names lane 9, which is none that a car may drive on"),
        ("3 2", "lane 2 neither follows lane 3 nor lies beside it"),
        ("2", "begins on lane 2, but the vehicle starts on lane 1"),
    ):
        way.write_text(text)
        with pytest.raises(InputError, match=sentence):
            commonroad(write(OLD), route=str(way))
    with pytest.raises(InputError, match="cannot be read"):
        commonroad(write(OLD), route=str(tmp_path / "none.txt"))


def test_a_way_of_a_thousand_kilometres_is_refused(write: Any) -> None:
    with pytest.raises(InputError, match=r"scenario.beyond is 1e\+06 m"):
        commonroad(write(OLD), beyond=1e6)


def test_headings_are_within_a_span_whatever_full_turns_lie_between() -> None:
    heading = np.array([0.0, 3.2, -3.2 + 0.1, 3.4])
    np.testing.assert_array_equal(within_turn(heading, (3.1, 3.3)), [False, True, True, False])
    assert within_turn(heading, (-math.inf, math.inf)).all()


def test_who_has_stood_for_a_second_is_not_at_fault(write: Any) -> None:
    found = drive(commonroad(write(OLD), duration=3.0), by_the_rules)
    log, looked = found.log, found.log.looked
    ego = np.repeat(log.ego[:1], len(log.ego), 0)
    ego[:, 3:] = 0.0
    others = np.full_like(log.others, math.nan)
    others[:, 1] = [0.0, 0.0, math.pi, 10.0, 0.0]
    others[:, 1, 0] = 45.0 - 10.0 * looked  # its front meets ours after (45 - 2 - 20 - 2.45) / 10 = 2.055 s
    stands = found._replace(log=log._replace(ego=ego, others=others))
    assert contacts(stands) == [Contact(1, pytest.approx(2.1), "the vehicle had stood for 1 s")]
    ego = ego.copy()
    ego[log.time < 1.5, 3] = 1.0
    assert [one.excuse for one in contacts(found._replace(log=log._replace(ego=ego, others=others)))] == [""]


@recorded
@pytest.mark.parametrize("name", FILES)
def test_recorded_files_are_read_whole(name: str) -> None:
    told = read(str(DATA / f"{name}.xml.gz"))
    assert told.name == name and (len(told.lanes), len(told.obstacles)) == FILES[name]
    assert all(np.isfinite(one.poses).all() for one in told.obstacles)


def recorded_drive(name: str, **knobs: Any) -> Drive:
    vehicle, able = Vehicle(num_circles=5), Planner().able
    limits = {key: getattr(able, key) for key in able.__dataclass_fields__} | {"speed": 40.0}
    planner = Planner(vehicle=vehicle, comfort=Limits(speed=40.0), able=Limits(**limits))
    return drive(commonroad(str(DATA / f"{name}.xml.gz"), vehicle=vehicle, **knobs), by_the_rules, planner)


@recorded
@pytest.mark.parametrize("name", ["DEU_A9-3_1_T-1", "DEU_AAH-3_33000_T-1", "USA_US101-3_3_T-1", "USA_Lanker-1_1_T-1"])
def test_recorded_scenarios_are_driven_without_fault(name: str) -> None:
    told = (found := recorded_drive(name)) and metrics(found) | goals(found)
    assert (told["collisions_at_fault"], told["limit_violations"], told["stops_passed"]) == (0.0, 0.0, 0.0)
    assert told["goal_reached"] == 1.0
