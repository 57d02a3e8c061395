"""Reference lines are what their points say, and Frenet coordinates lead back to where they came from."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.program import InputError
from planning.reference import ReferenceLine, from_curvature, from_points
from planning.reference_kernel import BEYOND_ENDS, CURVATURE_CENTRE, FOUND

S = np.arange(0.0, 201.0, 2.0)


def winding(amplitude: float = 0.05, period: float = 12.0) -> ReferenceLine:
    s = np.arange(0.0, 200.01, 0.5)
    return from_curvature(s, amplitude * np.sin(s / period), (3.0, -2.0, 0.7))


def circle(radius: float, angle: float = 4.0, num: int = 60) -> np.ndarray:
    phi = np.linspace(0.0, angle, num)
    return radius * np.stack([np.sin(phi), 1 - np.cos(phi)], -1)


def test_a_circle_has_its_length_curvature_and_heading() -> None:
    line = from_points(circle(20.0), std=0.0)
    assert line.length == pytest.approx(80.0, abs=1e-6)
    inner = np.linspace(5.0, 75.0, 50)
    told = line.at(inner)
    np.testing.assert_allclose(told[:, 2], inner / 20.0, atol=1e-5)
    np.testing.assert_allclose(told[:, 3], 1 / 20.0, atol=2e-5)
    np.testing.assert_allclose(told[:, 4], 0.0, atol=2e-5)
    np.testing.assert_allclose(np.hypot(told[:, 0], told[:, 1] - 20.0), 20.0, atol=1e-6)


def test_the_table_is_consistent() -> None:
    """c' = (cos theta, sin theta), theta' = kappa, kappa' is the slope: by central differences."""
    for line in (winding(), from_points(circle(20.0) + np.random.default_rng(0).normal(0, 0.03, (60, 2)), std=0.03)):
        s, h = np.linspace(1.0, line.length - 1.0, 400), 1e-4
        ahead, behind, told = line.at(s + h), line.at(s - h), line.at(s)
        slope = (ahead - behind) / (2 * h)
        np.testing.assert_allclose(slope[:, 0], np.cos(told[:, 2]), atol=1e-5)
        np.testing.assert_allclose(slope[:, 1], np.sin(told[:, 2]), atol=1e-5)
        np.testing.assert_allclose(slope[:, 2], told[:, 3], atol=1e-4)
        np.testing.assert_allclose(slope[:, 3], told[:, 4], atol=1e-3)


def test_curvature_and_its_slope_are_those_given() -> None:
    s = np.linspace(0.0, 200.0, 3001)
    told = winding(0.05, 12.0).at(s)
    np.testing.assert_allclose(told[:, 3], 0.05 * np.sin(s / 12.0), atol=1e-7)
    np.testing.assert_allclose(told[:, 4], 0.05 / 12.0 * np.cos(s / 12.0), atol=4e-6)


def test_beyond_its_ends_a_line_goes_on() -> None:
    line = from_curvature([0.0, 5.0, 10.1], [0.0, 0.0, 0.0])
    assert line.length == 10.0
    np.testing.assert_allclose(
        line.at([-3.0, 10.0, 12.0])[:, :4], [[-3, 0, 0, 0], [10, 0, 0, 0], [12, 0, 0, 0]], atol=1e-9
    )


@pytest.mark.parametrize("num", [3, 4, 5])
def test_a_few_points_make_a_line(num: int) -> None:
    line = from_points(circle(20.0, 1.0, num), std=0.0)
    assert line.length == pytest.approx(20.0, abs=0.2) and np.isfinite(line.table).all()
    assert line.at(10.0)[3] == pytest.approx(1 / 20.0, abs=0.01)


@pytest.mark.parametrize(
    ("s", "kappa"),
    [([0, 1, 2], [0, math.nan, 0]), ([1, 2, 3], [0, 0, 0]), ([0, 2, 1], [0, 0, 0]), ([0, 1], [0, 0, 0]),
     ([0, 0.1], [0, 0]), ([0, math.nan], [0, 0]), ([0, math.inf], [0, 0])],
)  # fmt: skip
def test_curvatures_that_make_no_line_are_refused(s: list[float], kappa: list[float]) -> None:
    with pytest.raises(InputError, match="a line from curvature"):
        from_curvature(s, kappa)


@pytest.mark.parametrize("std", [-0.1, math.nan])
def test_errors_of_points_are_not_negative(std: float) -> None:
    with pytest.raises(InputError, match="std is"):
        from_points(circle(20.0), std=std)


def test_smoothing_takes_noise_away() -> None:
    noisy = circle(30.0, 3.0, 120) + np.random.default_rng(1).normal(0, 0.1, (120, 2))
    told = from_points(noisy, std=0.1).at(np.linspace(5, 85, 100))
    assert np.std(np.hypot(told[:, 0], told[:, 1] - 30.0)) < 0.05
    assert np.abs(told[:, 3] - 1 / 30).max() < 0.02


@pytest.mark.parametrize("amplitude", [0.012, 0.08, 0.15])
def test_projection_leads_back(amplitude: float) -> None:
    line, rng = winding(amplitude, 10.0), np.random.default_rng(2)
    s = rng.uniform(2.0, 195.0, 5000)
    room = 0.8 / np.maximum(np.abs(line.at(s)[:, 3]), 0.1)
    d = rng.uniform(-1, 1, 5000) * np.minimum(room, 4.0)
    found, ended = line.project(line.place(s, d), s + rng.uniform(-0.5, 0.5, 5000))
    assert (ended == FOUND).all()
    np.testing.assert_allclose(found, np.stack([s, d], -1), atol=1e-8)


def test_without_a_warm_start_the_nearest_row_is_one() -> None:
    line = winding()
    s, d = np.array([10.0, 90.0, 150.0]), np.array([1.0, -2.0, 0.0])
    found, ended = line.project(line.place(s, d))
    assert (ended == FOUND).all()
    np.testing.assert_allclose(found[:, 0], s, atol=1e-8)


def test_points_at_the_curvature_centre_and_beyond_the_ends_are_refused() -> None:
    line = from_points(circle(10.0, 2.0), std=0.0)
    _, ended = line.project([(0.0, 10.0), (0.3, 9.5), (-3.0, 0.0)], [10.0, 10.0, 1.0])
    assert ended[0] != FOUND and ended[1] == CURVATURE_CENTRE and ended[2] == BEYOND_ENDS


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((0, 2)), "0 points make no line"),
        ([(0.0, 0.0)], "1 points make no line"),
        ([(0.0, 0.0), (1.0, 0.0)], "2 points make no line"),
        ([(0.0, 0.0), (1.0, math.nan), (2.0, 0.0)], "point 1 is"),
        ([(0.0, 0.0), (1.0, 0.0), (1.0, 0.0), (2.0, 0.0)], "points 1 and 2 are the same"),
        (circle(10.0, 7.0), "crosses itself"),
        ([(0.0, 0.0), (1e9, 0.0), (2e9, 0.0)], "is 2e+09 m long"),
        ([0.0, 1.0, 2.0], "must be (N, 2)"),
    ],
)
def test_bad_lines_are_refused_in_words(points: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=r"lane 7: .*") as refused:
        from_points(points, std=0.0, name="lane 7")
    assert words in str(refused.value)


def test_three_points_make_a_line() -> None:
    line = from_points([(0.0, 0.0), (50.0, 0.0), (100.0, 0.0)], std=0.0)
    np.testing.assert_allclose(line.at(30.0), [30.0, 0.0, 0.0, 0.0, 0.0], atol=1e-9)
