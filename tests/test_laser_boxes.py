"""Beams end at the nearest rectangle; boxes fitted to where they end have middles as good as their covariances say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from experiments.scenarios.laser_beams import Laser, Sweep, ranges, sweep
from experiments.scenarios.laser_boxes import boxes, clusters
from experiments.scenarios.urban_sensors import urban_sensors

LASER = Laser()
EVERYWHERE = math.radians(210.0)


def look(*rectangles: tuple[float, ...], seed: int = 0) -> Sweep:
    return sweep(LASER, np.zeros(3), EVERYWHERE, 200.0, np.array(rectangles), np.random.default_rng(seed))


def test_beams_end_where_segments_are_cut() -> None:
    """Against the cuts of each beam with the four sides, one at a time."""
    rng = np.random.default_rng(0)
    rectangles = np.stack(
        [*rng.uniform(-30, 30, (2, 12)), *rng.uniform(-3, 3, (1, 12)), *rng.uniform(0.5, 6, (2, 12))], -1
    )
    at, direction = np.array([1.0, -2.0, 0.3]), np.linspace(-3.1, 3.1, 200)
    rectangles = rectangles[np.hypot(*(rectangles[:, :2] - at[:2]).T) > 6.0]
    found = ranges(at, direction, rectangles)
    corner = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    for i, angle in enumerate(direction):
        d, best = np.array([math.cos(angle), math.sin(angle)]), math.inf
        for x, y, heading, length, width in rectangles:
            turn = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
            points = corner * [length, width] @ turn + [x, y]
            for a, b in zip(points, np.roll(points, -1, 0), strict=True):
                t, s = np.linalg.solve(np.stack([d, a - b], -1), a - at[:2])
                if t > 0.0 and 0.0 <= s <= 1.0:
                    best = min(best, t)
        assert found[i] == pytest.approx(best, abs=1e-9)


def test_what_is_behind_is_not_seen_and_nothing_is_no_return() -> None:
    seen = look((20.0, 0.0, 0.0, 4.5, 1.8), (40.0, 0.0, 0.0, 4.5, 1.8))
    assert np.isfinite(seen.distance).sum() == pytest.approx(2 * math.atan(0.9 / 17.75) / LASER.step, abs=2)
    assert np.nanmax(np.where(np.isfinite(seen.distance), seen.distance, np.nan)) < 19.0
    assert not np.isfinite(look((250.0, 0.0, 0.0, 4.5, 1.8)).distance).any()
    assert not np.isfinite(
        sweep(LASER, np.zeros(3), 1.0, 50.0, np.zeros((0, 5)), np.random.default_rng(0)).distance
    ).any()
    assert len(boxes(Sweep(seen.bearing, np.full(len(seen.bearing), np.inf)), LASER).values) == 0


def test_neighbours_are_apart_and_what_is_partly_hidden_is_left_out() -> None:
    assert len(clusters(look((20.0, 3.0, 0.0, 4.5, 1.8), (20.0, -3.0, 0.0, 4.5, 1.8)))) == 2
    front, hidden = (20.0, 0.0, 0.0, 4.5, 1.8), (40.0, 2.0, 0.0, 4.5, 1.8)
    (only,) = clusters(look(front, hidden))
    assert only[:, 0].max() < 25.0
    assert len(clusters(look(hidden))) == 1


@pytest.mark.parametrize(
    ("size", "spread", "near", "far", "accuracy"),
    [
        ((4.5, 1.8), (0.3, 0.1), 8.0, 40.0, 0.06),
        ((4.5, 1.8), (0.3, 0.1), 40.0, 90.0, 0.1),
        ((1.8, 0.6), (0.1, 0.05), 8.0, 40.0, 0.08),
        ((0.5, 0.5), (0.05, 0.05), 8.0, 40.0, 0.12),
    ],
    ids=["car near", "car far", "bicycle", "pedestrian"],
)
def test_middles_are_as_good_as_their_covariances_say(
    size: tuple[float, float], spread: tuple[float, float], near: float, far: float, accuracy: float
) -> None:
    """150 rectangles at random headings: the median error [m], and squares by covariance that have the mean 2 at most,
    with four standard errors of it (2 / sqrt(150)); less, for shapes vary less than the fit believes."""
    rng = np.random.default_rng(1)
    errors, squares, turned = list[float](), list[float](), list[float]()
    for _ in range(150):
        distance, bearing, heading = rng.uniform(near, far), rng.uniform(-1.4, 1.4), rng.uniform(-3.0, 3.0)
        own = np.array(size) + np.array(spread) * rng.standard_normal(2)
        middle = distance * np.array([math.cos(bearing), math.sin(bearing)])
        found = boxes(sweep(LASER, np.zeros(3), EVERYWHERE, 200.0, np.array([[*middle, heading, *own]]), rng), LASER)
        assert len(found.values) == 1
        off = found.middle[0] - middle
        errors.append(float(np.hypot(*off)))
        squares.append(float(off @ np.linalg.solve(found.covariance[0], off)))
        turned.append(abs((found.heading[0] - heading + math.pi / 4) % (math.pi / 2) - math.pi / 4))
    assert np.median(errors) < accuracy
    assert np.mean(squares) < 2.0 + 8.0 / math.sqrt(150)
    assert np.median(turned) < math.radians(5.0 if size[0] < 1.0 else 1.0)


def test_an_unseen_half_of_a_car_is_in_the_covariance() -> None:
    """From straight behind only the width is seen: along the line of sight the length of a car is believed."""
    found = boxes(look((30.0, 0.0, 0.0, 4.5, 1.8)), LASER)
    along, across = np.sqrt(np.diag(found.covariance[0]))
    assert along > 5.0 * across and across < 0.1
    assert abs(found.middle[0, 0] - 30.0) < 3.0 * along


def test_values_and_noise_are_range_and_bearing() -> None:
    """The covariance of what is measured, by 20000 draws of the middle: within four standard errors."""
    found = boxes(look((20.0, 10.0, 0.7, 4.5, 1.8)), LASER)
    drawn = np.random.default_rng(0).multivariate_normal(found.middle[0], found.covariance[0], 20000)
    polar = np.stack([np.hypot(*drawn.T), np.arctan2(drawn[:, 1], drawn[:, 0])], -1)
    np.testing.assert_allclose(polar.mean(0), found.values[0], atol=1e-3)
    spread = np.sqrt(np.diag(found.noise[0]))
    np.testing.assert_allclose(polar.std(0), spread, rtol=4.0 / math.sqrt(2 * 20000) + 0.01)


def test_the_city_offers_boxes_instead_of_middles() -> None:
    scene = urban_sensors(0, number=10, duration=1.0, raw_laser=True)
    lasers = [scan for scan in scene.data.scans if scan.sensor == "laser"]
    assert all(scan.noise is not None and scan.noise.shape == (len(scan.values), 2, 2) for scan in lasers)
    assert sum(len(scan.values) for scan in lasers) > 4 * len(lasers)
    others = urban_sensors(0, number=10, duration=1.0)
    for a, b in zip(scene.data.scans, others.data.scans, strict=True):
        if a.sensor != "laser":
            np.testing.assert_array_equal(a.values, b.values)
