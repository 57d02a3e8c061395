"""Lanelet maps as files: what lanelet2 reads is what was written, and vehicles find every route in it."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from experiments.lanelet_osm import KARLSRUHE, geographic, read_osm, routes_ok, write_osm
from experiments.lanelets import LaneletMap, lanelet_map
from experiments.scenarios.protocol import protocol
from models.program import InputError

needs_lanelet2 = pytest.mark.skipif(find_spec("lanelet2") is None, reason="lanelet2 comes with the extra 'maps' only")
ORIGINS = {
    "Karlsruhe": KARLSRUHE,
    "Los Angeles": (34.1391, -118.3617),
    "edge of a zone": (52.0, 5.9999),
    "south": (-33.87, 151.21),
    "Bergen": (60.39, 5.32),  # zone 32 by exception
    "near a pole": (-79.5, 100.0),
}
POINTS = np.array([[0.0, 0.0], [150.0, -80.0], [-2000.0, 3000.0]])


@pytest.fixture(scope="module")
def junction() -> LaneletMap:
    truth = protocol(0).truth
    return lanelet_map(truth.lines, truth.connections)


def test_metres_to_the_north_follow_the_curvature_of_the_meridian() -> None:
    latitude, a, e2 = 49.0, 6378137.0, 0.00669437999014
    radius = a * (1 - e2) / (1 - e2 * np.sin(np.radians(latitude)) ** 2) ** 1.5
    place = geographic(np.array([[0.0, 100.0]]), (latitude, 9.0))  # 9 degrees is the middle of a zone
    np.testing.assert_allclose(place, [[latitude + np.degrees(100.0 / 0.9996 / radius), 9.0]], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ORIGINS)
def test_the_origin_is_where_it_is_said_to_be(name: str) -> None:
    np.testing.assert_allclose(geographic(POINTS, ORIGINS[name])[0], ORIGINS[name], rtol=0, atol=1e-11)


@needs_lanelet2
@pytest.mark.parametrize("name", ORIGINS)
def test_places_are_those_of_lanelet2(name: str) -> None:
    from lanelet2 import core, io, projection

    projector = projection.UtmProjector(io.Origin(*ORIGINS[name]))
    for point, (latitude, longitude) in zip(POINTS, geographic(POINTS, ORIGINS[name]), strict=True):
        there = projector.forward(core.GPSPoint(latitude, longitude, 0.0))
        np.testing.assert_allclose([there.x, there.y], point, rtol=0, atol=2e-4)


@needs_lanelet2
@pytest.mark.parametrize("origin", [KARLSRUHE, ORIGINS["Bergen"]])
def test_borders_survive_the_file(junction: LaneletMap, tmp_path: Path, origin: tuple[float, float]) -> None:
    write_osm(tmp_path / "map.osm", junction, origin)
    stored = read_osm(tmp_path / "map.osm", origin)
    assert len(stored.laneletLayer) == len(junction.lanelets)
    for number, lanelet in enumerate(junction.lanelets):
        there = stored.laneletLayer[number + 1]
        for border, line in ((lanelet.left, there.leftBound), (lanelet.right, there.rightBound)):
            np.testing.assert_allclose([[point.x, point.y] for point in line], border, rtol=0, atol=0.001)


@needs_lanelet2
@pytest.mark.parametrize("seed", range(3))
def test_vehicles_find_every_route_and_no_other_follower(seed: int, tmp_path: Path) -> None:
    from lanelet2 import routing, traffic_rules

    truth = protocol(seed).truth
    lanelets = lanelet_map(truth.lines, truth.connections)
    write_osm(tmp_path / "map.osm", lanelets)
    assert routes_ok(lanelets, tmp_path / "map.osm") == 1.0

    stored = read_osm(tmp_path / "map.osm")
    rules = traffic_rules.create(traffic_rules.Locations.Germany, traffic_rules.Participants.Vehicle)
    graph = routing.RoutingGraph(stored, rules)
    pairs = {(one.id - 1, other.id - 1) for one in stored.laneletLayer for other in graph.following(one)}
    assert pairs == set(lanelets.followers)
    for route in lanelets.routes:
        path = graph.shortestPath(stored.laneletLayer[route[0] + 1], stored.laneletLayer[route[-1] + 1])
        assert [lanelet.id - 1 for lanelet in path] == route


@needs_lanelet2
def test_a_route_that_is_cut_is_missed(junction: LaneletMap, tmp_path: Path) -> None:
    before, after = max(junction.followers)
    cut = junction._replace(followers=[pair for pair in junction.followers if pair != (before, after)])
    write_osm(tmp_path / "map.osm", cut)
    hit = [before in route and after in route for route in junction.routes]
    assert any(hit)
    assert routes_ok(junction, tmp_path / "map.osm") == pytest.approx(1 - np.mean(hit))


@needs_lanelet2
def test_a_lanelet_closed_to_vehicles_is_no_route(tmp_path: Path) -> None:
    lines = [np.array([[0.0, y], [30.0, y]]) for y in (0.0, 5.0)]
    lanelets = lanelet_map(lines, np.array([[0, 0, 1, 0], [0, 1, 1, 1]]))
    write_osm(tmp_path / "map.osm", lanelets)
    tree = ElementTree.parse(tmp_path / "map.osm")
    for tag in tree.findall("relation[@id='1']/tag[@k='subtype']"):
        tag.set("v", "walkway")
    tree.write(tmp_path / "map.osm")
    assert routes_ok(lanelets, tmp_path / "map.osm") == 0.5


def test_lanelets_that_follow_one_another_have_nodes_in_common(junction: LaneletMap, tmp_path: Path) -> None:
    write_osm(tmp_path / "map.osm", junction)
    osm = ElementTree.parse(tmp_path / "map.osm").getroot()
    nodes = {node.get("id") for node in osm.iter("node")}
    ways = {way.get("id"): [nd.get("ref") for nd in way.iter("nd")] for way in osm.iter("way")}
    assert nodes == {node for way in ways.values() for node in way}
    sides = {
        (int(relation.get("id", "0")) - 1, str(member.get("role"))): ways[member.get("ref")]
        for relation in osm.iter("relation")
        for member in relation.iter("member")
    }
    assert len(sides) == 2 * len(junction.lanelets)
    for side in ("left", "right"):
        for before, after in junction.followers:
            assert sides[before, side][-1] == sides[after, side][0]


def test_without_the_library_one_sentence_names_the_extra(
    junction: LaneletMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_osm(tmp_path / "map.osm", junction)
    monkeypatch.setitem(sys.modules, "lanelet2", None)
    with pytest.raises(InputError, match="install the extra 'maps'"):
        routes_ok(junction, tmp_path / "map.osm")


@pytest.mark.parametrize("origin", [(78.2, 15.6), (49.0, 200.0), (float("nan"), 8.0)])
def test_an_origin_beyond_the_usual_zones_is_refused(
    junction: LaneletMap, tmp_path: Path, origin: tuple[float, float]
) -> None:
    with pytest.raises(InputError, match="the origin must be a latitude from -80 to 72"):
        write_osm(tmp_path / "map.osm", junction, origin)
    assert not list(tmp_path.iterdir())
