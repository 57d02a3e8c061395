"""Recorded courses: frames, poles beside a course, and real files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.scenarios.junction import DATA_ROOT
from experiments.scenarios.kitti_course import (
    BEHIND,
    MOST_TURN,
    REACH,
    STEP,
    beside,
    in_car_frame,
    kitti_course,
    measure_poles,
    motorway_course,
    resample,
    to_car_frame,
)
from models.program import InputError
from models.road.course import RoadCourse

ROADS = Path(DATA_ROOT) / "road_course"
STRAIGHT = resample(np.array([[0.0, 0.0], [0.0, 400.0]]))  # to the north


def test_a_line_that_stands_still_is_resampled_evenly() -> None:
    points = resample(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 2.0]]))
    np.testing.assert_allclose(np.hypot(*np.diff(points, axis=0).T), STEP)


def test_the_car_stands_at_the_origin_and_looks_along_x() -> None:
    line = in_car_frame(STRAIGHT, 100.0)
    x, y, heading, curvature = (v.numpy() for v in line.points)
    np.testing.assert_allclose([x[0], x[-1]], [-BEHIND, REACH - BEHIND])
    np.testing.assert_allclose(np.stack([y, heading, curvature]), 0.0, atol=1e-12)
    west = to_car_frame(np.array([[-3.0, 100.0 + BEHIND]]), STRAIGHT, 100.0)
    np.testing.assert_allclose(west, [[0.0, 3.0]], atol=1e-12)  # west is on the left of a drive to the north


def test_a_pole_is_found_where_it_stands_and_not_beyond_ten_metres_or_the_ends() -> None:
    line = in_car_frame(STRAIGHT, 0.0)
    arc, aside = beside(line, np.array([[30.0, 4.0], [50.0, -6.0], [60.0, 12.0], [-40.0, 1.0], [300.0, 1.0]]))
    np.testing.assert_allclose(arc, [30.0 + BEHIND, 50.0 + BEHIND])
    np.testing.assert_allclose(aside, [4.0, -6.0])


def test_poles_are_measured_about_their_places_with_the_covariance_told() -> None:
    line, rng = in_car_frame(STRAIGHT, 0.0), np.random.default_rng(0)
    arc, aside = np.full(4000, 60.0 + BEHIND), np.full(4000, -5.0)
    cues = measure_poles(line, arc, aside, rng)
    assert not cues.left.any()
    gap = cues.position - [60.0, -5.0]
    white = np.linalg.solve(np.linalg.cholesky(cues.covariance), gap[..., None])[..., 0]
    np.testing.assert_allclose(white.mean(0), 0.0, atol=4 / 4000**0.5)
    np.testing.assert_allclose(white.T @ white / 4000, np.eye(2), atol=4 * (2 / 4000) ** 0.5)


def test_a_negative_seed_and_missing_data_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="seed is -1"):
        kitti_course(seed=-1)
    with pytest.raises(InputError, match="scenario=night_road"):
        kitti_course(data_root=str(tmp_path))


@pytest.mark.skipif(not ROADS.exists(), reason=f"no {ROADS}")
def test_real_courses_begin_behind_the_car_and_are_the_same_again() -> None:
    for scene, again in (
        (kitti_course("10", 3), kitti_course("10", 3)),
        (motorway_course(seed=1), motorway_course(seed=1)),
    ):
        line = scene.truth["line"]
        assert line[0, 0] == pytest.approx(-BEHIND, abs=1.0) and np.abs(line[20, :2]).max() < 1e-9
        assert np.ptp(line[:, 2]) < MOST_TURN
        np.testing.assert_array_equal(scene.data.position, again.data.position)
        RoadCourse().prepare(scene.data)


@pytest.mark.skipif(not ROADS.exists(), reason=f"no {ROADS}")
def test_an_unknown_sequence_is_named_with_those_there_are() -> None:
    with pytest.raises(InputError, match=r"no sequence is named '99'.*'?10"):
        kitti_course("99")
