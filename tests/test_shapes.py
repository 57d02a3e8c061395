"""What touches and what does not: never optimistic, against shapely and against simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from models.program import InputError
from planning.boundary_kernel import first_line
from planning.check_kernel import first_rectangle
from planning.shapes import (
    CLEARANCE,
    OUTLINE,
    ROUND,
    Boundary,
    Obstacles,
    Vehicle,
    boundary,
    check_obstacles,
    no_obstacles,
    outlines,
)  # fmt: skip

VEHICLE = Vehicle()
CERTAIN = (1e-3, np.ones(1), np.full(1, 3.0902), np.zeros(1))  # one rectangle that must not be touched


def rectangle(x: float, y: float, heading: float, length: float, width: float) -> shapely.Polygon:
    box = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    return affinity.translate(affinity.rotate(box, heading, (0, 0), use_radians=True), x, y)


def test_circles_cover_the_vehicle() -> None:
    for vehicle in (VEHICLE, Vehicle(12.0, 2.5, 3.0, 5), Vehicle(3.0, 1.5, 1.0, 1)):
        circles = shapely.union_all([shapely.Point(c, 0).buffer(vehicle.radius, 128) for c in vehicle.circles])
        body = rectangle(vehicle.middle, 0.0, 0.0, vehicle.length - 1e-2, vehicle.width - 1e-2)
        assert circles.buffer(1e-3).contains(body)
        assert vehicle.front == vehicle.middle + vehicle.length / 2


def margins(r: np.ndarray, centres: np.ndarray, radius: float) -> np.ndarray:
    return CLEARANCE(centres, np.array([[*r[:10], radius]]))[:, 0]


@settings(max_examples=200)
@given(
    x=st.floats(-6, 6), y=st.floats(-6, 6), heading=st.floats(-4, 4), length=st.floats(0.5, 8), width=st.floats(0.5, 3)
)  # fmt: skip
def test_the_distance_to_a_rectangle_is_shapelys_and_no_collision_is_missed(
    x: float, y: float, heading: float, length: float, width: float
) -> None:
    body = Obstacles(np.array([[[x, y, heading]]]), np.array([[length, width]]), np.zeros((1, 1, 2, 2)), np.ones(1))
    row = body.table(1e-3, VEHICLE.radius, 5.0)[0, :, 0]
    shape = rectangle(x, y, heading, length, width)
    centres = np.stack([VEHICLE.circles, np.zeros(3)], -1)
    gaps = shapely.distance(shapely.points(centres), shape)
    np.testing.assert_allclose(margins(row, centres, 0.0), gaps**2, atol=1e-9)
    touched = (margins(row, centres, VEHICLE.radius) <= 0).any()
    if shape.intersects(rectangle(VEHICLE.middle, 0.0, 0.0, VEHICLE.length, VEHICLE.width)):
        assert touched
    middle = np.hypot(x - VEHICLE.middle, y)
    if middle**2 > row[10]:
        assert not touched


def test_a_chance_constraint_at_its_limit_is_kept_in_simulation() -> None:
    """A circle just clear of an uncertain rectangle is touched no more often than allowed (Gaussian place)."""
    rng = np.random.default_rng(0)
    for covariance in ([[0.3, 0.1], [0.1, 0.2]], [[0.5, 0.0], [0.0, 0.01]]):
        for bearing in (0.3, 1.2, 2.0, 3.0):
            body = Obstacles(
                np.array([[[0.0, 0.0, 0.4]]]), np.array([[4.0, 2.0]]), np.array([[covariance]]), np.ones(1)
            )
            row = body.table(0.05, 1.0, 5.0)[0, :, 0]
            far = np.linspace(0.0, 8.0, 4001)[:, None] * [math.cos(bearing), math.sin(bearing)]
            centre = far[np.flatnonzero(margins(row, far, 1.0) <= 0)[-1] + 1]
            moved = centre - rng.multivariate_normal([0, 0], covariance, 40000)
            rate = (margins(row * [1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 1], moved, 1.0) <= 0).mean()
            assert rate < 0.05 + 3 * math.sqrt(0.05 * 0.95 / 40000)
            if bearing == 2.0:
                assert rate > 0.02, "a straight side is met about as often as allowed"


def test_a_place_uncertain_in_one_direction_only_is_met_beside_it_as_if_it_were_certain() -> None:
    """Rounding makes the variance across a flat covariance negative about as often as not."""
    for heading in np.linspace(-3.0, 3.0, 101):
        ahead = np.array([math.cos(heading), math.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        flat = 0.49 * np.outer(ahead, ahead)
        body = Obstacles(np.array([[[0.0, 0.0, heading]]]), np.array([[4.0, 2.0]]), flat[None, None], np.ones(1))
        row = body.table(1e-3, 1.0, 5.0)[0, :, 0]
        margin = margins(row, np.stack([1.9 * left, 2.1 * left]), 1.0)
        assert margin[0] < 0 < margin[1]
        pose = np.array([[1.9 * left[0]], [1.9 * left[1]], [1.0], [0.0]])
        assert first_rectangle(pose, row[None, :, None], CERTAIN, 0.0, np.zeros(1), 1.0, np.arange(1), False) == 0
        row[6] = math.nan
        assert (
            first_rectangle(pose * 1.2, row[None, :, None], CERTAIN, 0.0, np.zeros(1), 1.0, np.arange(1), False) == 0
        ), "NaN is not clear"


@pytest.mark.parametrize("seed", range(3))
def test_what_counts_as_far_touches_nothing_however_uncertain(seed: int) -> None:
    rng, reach = np.random.default_rng(seed), 4.0
    for _ in range(200):
        root = rng.normal(0, 1.0, (2, 2)) * [1.0, rng.choice([0.01, 1.0])]
        pose, size = np.array([[[0.0, 0.0, rng.uniform(-3, 3)]]]), rng.uniform(0.5, 5.0, (1, 2))
        row = Obstacles(pose, size, (root @ root.T)[None, None], np.ones(1)).table(1e-3, 1.0, reach)[0, :, 0]
        bearing = rng.uniform(-math.pi, math.pi, 200)
        far = math.sqrt(row[10]) * np.stack([np.cos(bearing), np.sin(bearing)], -1)
        assert (margins(row, far * (1 - (reach - 1.0) / math.sqrt(row[10])), 1.0) > -1e-9).all()


def test_a_chance_above_one_half_still_keeps_the_distance() -> None:
    body = Obstacles(np.zeros((1, 1, 3)), np.ones((1, 2)), np.eye(2)[None, None], np.ones(1))
    assert body.table(0.6, 1.0, 1.0)[0, 9, 0] == 0.0


def test_a_place_uncertain_ahead_does_not_count_as_uncertain_to_the_side() -> None:
    """Oncoming traffic in the next lane: where it is along its lane does not matter."""
    body = Obstacles(np.zeros((1, 1, 3)), np.array([[4.6, 1.9]]), np.array([[np.diag([9.0, 0.04])]]), np.ones(1))
    row = body.table(1e-3, VEHICLE.radius, 5.0)[0, :, 0]
    side = 0.95 + VEHICLE.radius + row[9] * 0.2
    way = np.linspace(-20.0, 20.0, 401)
    assert (margins(row, np.stack([way, np.full(401, side + 0.01)], -1), VEHICLE.radius) > 0).all()
    assert margins(row, np.array([[0.0, side - 0.01]]), VEHICLE.radius) < 0
    ahead = 2.3 + VEHICLE.radius + row[9] * 3.0
    assert margins(row, np.array([[ahead + 0.01, 0.0], [ahead - 0.01, 0.0]]), VEHICLE.radius).tolist()[0] > 0


def test_unlikely_objects_get_a_larger_chance_each_and_the_unlikeliest_none() -> None:
    same = Obstacles(
        np.zeros((3, 1, 3)), np.ones((3, 2)), np.full((3, 1, 2, 2), np.eye(2)), np.array([1.0, 0.1, 0.009])
    )
    rows = same.table(0.01, 1.0, 1.0)
    np.testing.assert_allclose(rows[:, 9, 0], [2.326347874, 1.281551566], atol=1e-8)


def wire(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [np.cumsum(rng.normal(0, 2.0, (20, 2)), 0) for _ in range(3)] + [np.array([(3.0, 3.0), (3.0, 3.0)])]


def hit(lines: Boundary, x: float, y: float, radius: float) -> bool:
    pose = np.array([[x, x], [y, y], [1.0, 1.0], [0.0, 0.0]])
    return bool(first_line(pose, tuple(lines[:6]), np.zeros(1), radius) == 0)


@pytest.mark.parametrize("seed", range(3))
def test_boundary_lines_are_touched_where_shapely_says(seed: int) -> None:
    lines, shapes = boundary(wire(seed), 1.3), shapely.multilinestrings([shapely.linestrings(w) for w in wire(seed)])
    points = np.random.default_rng(9).uniform(-15, 15, (2000, 2))
    for radius in (1.3, 0.4):
        expected = shapely.distance(shapely.points(points), shapes) <= radius
        assert [hit(lines, x, y, radius) for x, y in points] == expected.tolist()
        assert expected.any() and not expected.all()


def test_no_lines_and_lines_far_away_touch_nothing() -> None:
    assert not hit(boundary([], 1.0), 0.0, 0.0, 1.0)
    line = np.array([(0.0, 0.0), (100.0, 0.0)])
    near = boundary([np.array([(0.0, 150.0), (100.0, 150.0)]), line], 1.0, within=(0.0, 0.0, 20.0))
    assert len(near.segment) == 1 and hit(near, 5.0, 0.5, 1.0) and not hit(near, 5.0, 150.0, 1.0)


def test_circles_lie_along_the_heading() -> None:
    lines = tuple(boundary([np.array([(-9.0, 3.0), (9.0, 3.0)])], 1.0)[:6])
    pose = np.array([[0.0], [0.0], [0.6], [0.8]])  # 53 degrees to the left
    assert first_line(pose, lines, np.array([0.0, 2.6]), 0.9) == 1
    assert first_line(pose, lines, np.array([0.0, 2.7]), 0.9) == 0
    assert first_line(pose * [[1], [1], [1], [-1]], lines, np.array([0.0, 2.7]), 0.9) == 1


def test_long_segments_are_kept_where_they_pass_and_the_grid_ends_with_what_is_kept() -> None:
    line = [np.array([(-40000.0, 0.0), (40000.0, 1.0)])]
    near = boundary(line, 1.0, within=(0.0, 3.0, 20.0))
    assert near.shape.prod() < 45 * 10 and hit(near, 5.0, 1.0, 0.6) and not hit(near, 5.0, 1.2, 0.6)
    past = boundary([np.array([(-400.0, 300.0), (400.0, 300.0)])], 1.0, within=(0.0, 3.0, 20.0))
    assert not hit(past, 0.0, 0.0, 1.0)
    with pytest.raises(InputError, match=r"span 80000 by 80000 m.*within"):
        boundary([np.array([(0.0, 0.0), (8e4, 8e4)])], 1.0)


@pytest.mark.parametrize("line", [np.zeros((3, 3)), np.array([(0.0, math.nan), (1.0, 1.0)])])
def test_lines_that_are_none_are_refused(line: np.ndarray) -> None:
    with pytest.raises(InputError, match="boundary line 0"):
        boundary([line], 1.0)


@pytest.mark.parametrize("far", [math.nan, math.inf, -1.0])
def test_reaches_that_are_none_are_refused(far: float) -> None:
    line = np.array([(0.0, 0.0), (1.0, 1.0)])
    with pytest.raises(InputError, match="boundary lines: reach is"):
        boundary([line], far)
    if not far >= 0.0:
        with pytest.raises(InputError, match="boundary lines: within is"):
            boundary([line], 1.0, within=(0.0, 0.0, far))


def test_obstacles_of_words_are_refused() -> None:
    wrong = no_obstacles(3)._replace(probability=np.zeros(0, np.str_))
    with pytest.raises(InputError, match=r"probability is an array of .*, but must be one of numbers"):
        check_obstacles(wrong, 3)


@settings(max_examples=200)
@given(
    length=st.floats(0.3, 15), width=st.floats(0.3, 4), radius=st.floats(0.5, 2.0), std=st.floats(0, 2),
    ratio=st.floats(0, 1), turn=st.floats(-4, 4), seed=st.integers(0, 1000),
)  # fmt: skip
def test_the_smooth_outline_is_never_more_optimistic_than_the_clearance(
    length: float, width: float, radius: float, std: float, ratio: float, turn: float, seed: int
) -> None:
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    covariance = axes @ np.diag([std**2, (ratio * std) ** 2]) @ axes.T
    body = Obstacles(
        np.array([[[1.0, 2.0, 0.7]]]), np.array([[length, width]]), covariance[None, None], np.array([0.6])
    )
    row = body.table(1e-3, radius, 3.0)[0, :, 0]
    smooth = outlines(row, radius)
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(0, 2 * math.pi, 2000)
    edge = smooth[4:] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    edge /= (np.abs(edge / smooth[4:]) ** ROUND).sum(1)[:, None] ** (1 / ROUND)
    turned = np.array([[smooth[2], -smooth[3]], [smooth[3], smooth[2]]])
    centres = row[:2] + edge @ turned.T  # on the outline
    assert np.abs(OUTLINE(centres, smooth[None])).max() < 1e-9
    assert margins(row, centres, radius).min() > 0.0
    inside = rng.normal(0, 0.4, (2000, 2)) * smooth[4:]
    centres = row[:2] + inside @ turned.T
    assert (OUTLINE(centres, smooth[None])[:, 0] <= 0.0)[margins(row, centres, radius) <= 0.0].all()


def test_the_smooth_outline_of_a_car_costs_centimetres_at_its_sides() -> None:
    body = Obstacles(np.zeros((1, 1, 3)), np.array([[4.6, 1.9]]), np.zeros((1, 1, 2, 2)), np.ones(1))
    half = outlines(body.table(1e-3, 1.35, 5.0)[0, :, 0], 1.35)[4:]
    assert (half - [2.3 + 1.35, 0.95 + 1.35]).max() < 0.06
