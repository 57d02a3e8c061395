"""Lanes of traffic from tracks to files: drawn crossings, simulated drives on real lanes, recorded vehicles."""

from __future__ import annotations

import csv
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from experiments.lane_metrics import lane_error
from experiments.scenarios import junction as junctions
from experiments.scenarios.scene import Scene
from experiments.scenarios.traffic import traffic
from experiments.traffic_figures import figures
from experiments.traffic_lanes import TrafficPosterior, estimate
from experiments.traffic_metrics import map_distance, metrics
from inference import least_squares
from models.intersection.state import Junction
from models.intersection.traffic_lanes import TrafficLanes
from models.program import InputError, check
from tests.drawn_traffic import corner, noisy, straight

DATA = Path(junctions.DATA_ROOT)
with_junctions = pytest.mark.skipif(
    not (DATA / "intersections").is_dir(), reason=f"the real junctions are not at {DATA / 'intersections'}"
)
with_recordings = pytest.mark.skipif(
    not (DATA / "trajectories").is_dir(), reason=f"the recorded vehicles are not at {DATA / 'trajectories'}"
)
COURSES = [
    straight((-60, -2), (60, -2)),
    straight((60, 2), (-60, 2)),
    corner(-5.0),
    straight((2, -60), (2, -10)),  # seen up to the junction only
]


def found(scene: Scene, refine: Callable[..., object] = least_squares.run) -> TrafficPosterior:
    model = TrafficLanes()
    return estimate(model, model.prepare(scene.data), seed=1, refine=partial(refine, tolerance=0.1, num_draws=100))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def drawn() -> tuple[Scene, TrafficPosterior]:
    scene = Scene(noisy([course for course in COURSES for _ in range(4)]), None, "drawn", {})
    return scene, found(scene)


def test_drawn_lanes_are_found_where_they_are(drawn: tuple[Scene, TrafficPosterior]) -> None:
    """White noise of .3 m in four tracks leaves about .3 / sqrt(4 x 8) = .05 m over two knots; three times that."""
    lanes = drawn[1].lanes
    assert lanes is not None and len(lanes.lines) == 4
    for number, course in enumerate(COURSES):
        line = lanes.lines[lanes.routes.track_route[4 * number]]
        apart = np.linalg.norm(course[3:-3, None] - line, axis=-1).argmin(1)
        tangent = np.gradient(line, axis=0)[apart]
        gap = course[3:-3] - line[apart]
        across = np.abs(tangent[:, 0] * gap[:, 1] - tangent[:, 1] * gap[:, 0]) / np.linalg.norm(tangent, axis=1)
        assert across.mean() < 0.15


def test_the_model_is_a_program_and_its_squares_are_its_density(drawn: tuple[Scene, TrafficPosterior]) -> None:
    model = TrafficLanes()
    evidence = model.prepare(drawn[0].data)
    check(model, evidence)
    squares = model.squares(evidence)
    cost = squares.evaluate(squares.loc, np.zeros((len(squares.loc),) * 2), np.zeros(len(squares.loc)))
    assert np.isfinite(cost) and cost > 0


def test_a_half_lane_is_stored_as_one_and_exported_with_a_dead_end(
    drawn: tuple[Scene, TrafficPosterior], tmp_path: Path
) -> None:
    posterior = drawn[1]
    assert posterior.info["half_lanes"] == 1 and posterior.info["tracks_on_lanes"] == 16
    posterior.save(tmp_path)
    with (tmp_path / "lanes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row["exit_lane"] == "nan" for row in rows) == 1
    assert (tmp_path / "lanes.osm").read_text().count('v="lanelet"') >= 4


def test_its_pictures_need_no_map(drawn: tuple[Scene, TrafficPosterior]) -> None:
    scene, posterior = drawn
    assert set(figures(posterior, scene)) == {"traffic_lanes", "lanes"}
    assert metrics(posterior, scene) == {}


def test_lanes_can_be_learnt_again_from_other_tracks(drawn: tuple[Scene, TrafficPosterior]) -> None:
    scene, posterior = drawn
    assert posterior.again is not None
    together, alone = posterior.again(scene.data)
    assert posterior.lanes is not None
    for one, other, by_itself in zip(posterior.lanes.lines, together.lines, alone.lines, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
        assert by_itself.shape[1] == 2


def test_another_model_is_refused_in_words(drawn: tuple[Scene, TrafficPosterior]) -> None:
    with pytest.raises(InputError, match=r"lanes_traffic needs model=traffic_lanes.*not Junction"):
        estimate(Junction(), drawn[0].data, seed=0, refine=least_squares.run)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"min_tracks is 0.*choose 1"):
        TrafficLanes(min_tracks=0)


@with_junctions
@pytest.mark.parametrize("name", ["munich_tumdot_5", "usa_ep_t"])
def test_every_lane_of_a_junction_not_marked_clean_is_found(name: str) -> None:
    """From vehicles simulated with a metre of noise, where no threshold was chosen."""
    scene = junctions.junction(name, 0)
    lanes = found(scene).lanes
    assert lanes is not None
    error = lane_error(lanes.lines, scene.truth)
    assert error["lanes_missed"] == error["lanes_phantom"] == 0.0 and error["lane_error_cm"] < 15.0


@with_recordings
def test_lanes_of_few_recorded_vehicles_are_nearer_to_the_map_than_the_vehicles() -> None:
    scene = traffic("aachen_heckstrasse")
    posterior = found(scene)
    scores = metrics(posterior, scene)
    assert scores["traffic_m"] < scores["traffic_raw_m"] < 0.6 and scores["traffic_precision_1m"] > 0.95
    assert posterior.lanes is not None
    assert np.isfinite(map_distance(posterior.lanes.lines, scene.truth)[0]).mean() > 0.99


@with_recordings
def test_where_no_lane_is_shared_the_recording_is_named_by_its_tracks() -> None:
    with pytest.raises(InputError, match="none of 3 tracks shares its lane"):
        found(traffic("aachen_frankenburg"))
