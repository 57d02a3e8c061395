"""Scores of road courses on roads whose every distance is known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.special import ndtri

from experiments.road_figures import figures
from experiments.road_metrics import (
    LEAST_RANGE,
    RANGES,
    TOLD,
    RoadCheck,
    at_ranges,
    check_course,
    estimated_road,
    half_width,
    lateral_offsets,
    lay_courses,
    metrics,
    road_points,
    trusted_range,
)
from experiments.scenarios.road import night_rural
from inference.posterior import Posterior

STRAIGHT = np.array([-10.0, 0.0, 0.0, 150.0, 0.0, 0.0])
LINE = np.stack([np.arange(-10.0, 150.5, 0.5), np.zeros(321)], -1)


def shifted(*left: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Straight courses, each so many metres to the left of the straight line."""
    return np.array([STRAIGHT + np.array([0.0, d, 0.0, 0.0, d, 0.0]) for d in left])


def of_courses(courses: np.ndarray[Any, Any], log_weights: np.ndarray[Any, Any] | None = None) -> Posterior:
    weights = None if log_weights is None else log_weights[None]
    return Posterior({"course": courses[None]}, log_weights=weights)


def test_points_left_of_a_course_have_positive_offsets() -> None:
    points = np.array([[20.0, 1.0], [90.0, -2.0]])
    np.testing.assert_allclose(lateral_offsets(shifted(0.0, 0.5), points), [[1.0, -2.0], [0.5, -2.5]], atol=1e-9)


def test_distances_from_an_arc_are_those_from_its_circle() -> None:
    radius, turn = 200.0, 0.75  # 150 m
    course = np.array([0.0, 0.0, 0.0, radius * math.sin(turn), radius * (1 - math.cos(turn)), turn])
    angles, inward = np.linspace(0.1, 0.7, 30), np.linspace(-6.0, 6.0, 30)
    points = np.stack([(radius - inward) * np.sin(angles), radius - (radius - inward) * np.cos(angles)], -1)
    # inward is left; at d = 6 m the parabola through a sample b = 2 m away is off by b^2 d k^2 / 2 = .3 mm
    np.testing.assert_allclose(lateral_offsets(course[None], points)[0], inward, atol=5e-4)


def test_the_estimate_of_courses_that_end_here_and_there_lies_on_their_bend() -> None:
    """Arcs of one circle: the mean of their ends lies inside it by 1.1 m, the mean of their numbers on it."""
    radius = 150.0
    turn = np.array([1.0, 1.1, 1.2, 1.3])
    ends = np.stack([radius * np.sin(turn) - 10.0, radius * (1.0 - np.cos(turn)), turn], -1)
    courses = np.concatenate([np.broadcast_to([-10.0, 0.0, 0.0], (4, 3)), ends], 1)
    points = road_points(estimated_road(of_courses(courses)))[:25]
    from_centre = np.hypot(points[:, 0] + 10.0, points[:, 1] - radius)
    assert np.abs(from_centre - radius).max() < 0.02
    heavy = road_points(estimated_road(of_courses(courses, np.array([0.0, -50.0, -50.0, -50.0]))))
    np.testing.assert_allclose(heavy, road_points(lay_courses(courses[:1])), atol=1e-6)


def test_draws_that_are_no_roads_have_no_part_in_the_estimate() -> None:
    mixed = np.concatenate([shifted(0.4), np.zeros((1, 6))])
    assert road_points(estimated_road(of_courses(mixed)))[:, 1] == pytest.approx(0.4)


def test_ends_that_no_clothoid_joins_are_infinitely_far() -> None:
    same = np.zeros((1, 6))
    assert np.isinf(lateral_offsets(same, LINE[:3])).all()


def test_points_at_ranges_are_that_far_from_the_car() -> None:
    arc = np.linspace(-0.05, 0.8, 4000)
    bend = np.stack([200.0 * np.sin(arc), 200.0 * (1 - np.cos(arc))], -1)
    np.testing.assert_allclose(np.hypot(*at_ranges(bend).T), RANGES, atol=1e-3)


def test_the_error_is_the_way_from_the_estimate_left_to_the_truth() -> None:
    found = check_course(of_courses(shifted(0.3, 0.3)), LINE)
    np.testing.assert_allclose(found.error, -0.3, atol=1e-9)
    assert found.inside("tight") and found.reach == RANGES[-1] and found.outcome == "true"
    assert not found.covered.any()  # draws that agree have no band


def test_weights_decide_where_the_estimate_is() -> None:
    found = check_course(of_courses(shifted(0.0, 4.0), np.log([0.75, 0.25])), LINE)
    np.testing.assert_allclose(found.error, -1.0, atol=1e-9)
    np.testing.assert_allclose(found.spread, math.sqrt(0.75 * 0.25) * 4.0, rtol=1e-6)


def test_bands_cover_as_often_as_the_draws_say() -> None:
    rest = ndtri((np.arange(400) + 0.5) / 400)  # standard normal: the band is 1.645 to either side
    for shift, covered in ((0.0, True), (1.5, True), (1.8, False), (-1.8, False)):
        assert bool(check_course(of_courses(shifted(*(rest + shift))), LINE).covered.all()) is covered, shift


def test_the_calibrated_range_ends_where_a_tenth_of_the_draws_has_left_the_tube() -> None:
    width, apart = half_width("mid"), np.zeros((20, len(RANGES)))
    apart[:2, 9] = 1.01 * width[9]
    assert trusted_range(apart, 0.9, 0.0) == RANGES[-1]  # two of twenty may leave
    apart[2, 11] = -1.01 * width[11]
    assert trusted_range(apart, 0.9, 0.0) == RANGES[10]  # that the first two came back does not count
    apart[:, 0] = 1.01 * width[0]
    assert trusted_range(apart, 0.9, 0.0) == 0.0


def test_risk_is_taken_for_metres_that_are_worth_it() -> None:
    width, apart = half_width("mid"), np.zeros((20, len(RANGES)))
    apart[0, 7] = 1.01 * width[7]  # one of twenty leaves at 40 m: 105 m more for 5 % of the price
    apart[1, 27] = 1.01 * width[27]  # another at 140 m: 5 m more for as much
    assert trusted_range(apart, 0.8, 99.0) == 140.0
    assert trusted_range(apart, 0.8, 101.0) == 135.0
    assert trusted_range(apart, 0.8, 1999.0) == 135.0
    assert trusted_range(apart, 0.8, 2001.0) == 35.0


@pytest.mark.parametrize(
    ("reach", "outcome"), [(LEAST_RANGE - 5.0, "none"), (LEAST_RANGE, "true"), (80.0, "true"), (100.0, "false")]
)
def test_an_outcome_counts_up_to_the_calibrated_range_only(reach: float, outcome: str) -> None:
    error = np.where(RANGES < 90.0, 0.0, 5.0)
    assert RoadCheck(error, np.ones_like(error), np.ones(len(error), dtype=bool), reach).outcome == outcome


def test_tubes_are_as_wide_as_the_issue_says() -> None:
    assert [half_width(name)[-1] for name in ("tight", "mid", "wide")] == pytest.approx([1.24, 2.0, 2.9])


def test_scores_have_a_name_for_every_range_and_none_without_a_course() -> None:
    scene = night_rural(0)
    course = scene.truth["course"]
    scores = metrics(of_courses(np.stack([course, course])), scene)
    assert all(scores[f"error_{r:.0f}_m"] < 1e-3 for r in TOLD) and scores["trusted_true"] == 1.0
    assert metrics(Posterior({"z": np.zeros((1, 2))}), scene) == {}


def test_the_figure_shows_every_kind_the_band_and_the_truth() -> None:
    scene = night_rural(0)
    course = scene.truth["course"] + np.random.default_rng(0).normal(0, 1, (50, 1)) * [0, 0, 0, 0, 2.0, 0.03]
    drawn = figures(of_courses(course), scene)["road"]
    assert isinstance(drawn, Figure)
    labels = drawn.axes[0].get_legend_handles_labels()[1]
    assert {*scene.data.kind.tolist(), "90 % band", "true course", "calibrated range", "not to be trusted"} <= {*labels}
    drawn.canvas.draw()
    assert figures(Posterior({"z": np.zeros((1, 2))}), scene) == {}
