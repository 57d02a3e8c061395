"""Distances of lanes from a map, exact on lines drawn by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from experiments.lanes import LanePosterior, Lanes
from experiments.scenarios import paths
from experiments.scenarios.scene import JunctionTruth, Scene
from experiments.traffic_metrics import metrics, recall
from models.intersection.routes import Routes
from models.intersection.tracks import Tracks
from tests.drawn_traffic import Floats, noisy, straight

NONE = np.zeros(0)


def drawn_map(*lines: Floats) -> JunctionTruth:
    """A map of lines; arms begin 10 m from the centre."""
    fine = [paths.resample(line, 0.25) for line in lines]
    count = np.zeros(0, dtype=np.int64)
    arms = (np.zeros(2), NONE, NONE, count, count, NONE, np.array([10.0]))
    return JunctionTruth(*arms, fine, np.zeros((len(lines), 4), dtype=np.int64), count)


def found(*lines: Floats) -> LanePosterior:
    zeros = [np.zeros(len(line)) for line in lines]
    routes = Routes(np.zeros((len(lines), 4), dtype=np.int64), np.zeros(0, dtype=np.int64))
    return LanePosterior({"x": np.zeros((1, 1))}, lanes=Lanes(list(lines), zeros, zeros, routes))


def score(posterior: LanePosterior, truth: JunctionTruth | None, tracks: Tracks) -> dict[str, float]:
    return metrics(posterior, Scene(tracks, truth, "drawn", {}))


EAST, WEST = straight((-50, 0), (50, 0)), straight((50, 3), (-50, 3))
TRACKS = noisy([EAST, EAST], std=0.0)


def test_distances_are_those_of_the_lines() -> None:
    """20 + 20 points are .5 m beside the map and outside the crossing area, 10 are 2 m beside it and inside."""
    lanes = [straight((-31, 0.5), (-11, 0.5)), straight((-5, 2), (5, 2)), straight((11, 0.5), (31, 0.5))]
    scores = score(found(*lanes), drawn_map(EAST), TRACKS)  # the last point of each line is not measured
    assert scores["traffic_m"] == pytest.approx(0.5)
    assert scores["traffic_p90_m"] == pytest.approx(2.0)
    assert scores["traffic_precision_1m"] == pytest.approx(40 / 50)
    assert scores["traffic_arms_precision_1m"] == 1.0
    assert scores["traffic_raw_m"] == pytest.approx(0.0, abs=1e-9)


def test_a_lane_of_the_other_direction_is_not_near() -> None:
    scores = score(found(straight((-30, 3), (30, 3))), drawn_map(EAST, WEST), TRACKS)
    assert scores["traffic_m"] == pytest.approx(3.0)
    assert score(found(straight((30, 3), (-30, 3))), drawn_map(EAST, WEST), TRACKS)["traffic_m"] == pytest.approx(0.0)


def test_where_the_map_has_no_lane_of_the_direction_distances_are_infinite() -> None:
    """20 points of 40 run across the only map lane: more than a tenth of them, and half."""
    scores = score(found(straight((-30, 0), (-10, 0)), straight((5, -30), (5, -10))), drawn_map(EAST), TRACKS)
    assert scores["traffic_p90_m"] == scores["traffic_m"] == math.inf
    assert scores["traffic_precision_1m"] == 0.5


def test_points_beyond_the_end_of_the_map_are_left_out() -> None:
    scores = score(found(straight((20, 0), (90, 0))), drawn_map(EAST), TRACKS)
    assert scores["traffic_p90_m"] == pytest.approx(0.0, abs=1e-9) and scores["traffic_precision_1m"] == 1.0
    assert scores["traffic_arms_precision_1m"] == 1.0


def test_recall_asks_for_driven_lanes_only() -> None:
    """Two vehicles drove east, one west: the lane to the west is not asked for."""
    truth = drawn_map(EAST, WEST)
    tracks = [EAST, EAST + 0.2, WEST]
    assert recall([EAST], tracks, truth) == 1.0
    assert recall([WEST], tracks, truth) == 0.0
    assert recall([EAST], [*tracks, WEST], truth) == 0.5
    assert math.isnan(recall([EAST], [EAST, WEST], truth))


def test_a_lane_is_found_if_four_fifths_of_its_driven_places_are() -> None:
    tracks = [EAST[:71], EAST[:71]]
    assert recall([EAST[:60]], tracks, drawn_map(EAST)) == 1.0
    assert recall([EAST[:54]], tracks, drawn_map(EAST)) == 0.0
    assert math.isnan(recall([EAST], [EAST[:40], EAST[:40]], drawn_map(EAST)))  # less than half of it is driven


def test_without_a_map_or_lanes_there_is_nothing_to_say() -> None:
    assert score(found(EAST), None, TRACKS) == {}
    assert metrics(LanePosterior({"x": np.zeros((1, 1))}), Scene(TRACKS, drawn_map(EAST), "drawn", {})) == {}
