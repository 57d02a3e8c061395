"""The score of unseen vehicles: its density, its folds, and what it prefers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from experiments.held_out import (
    STRAY,
    TRUST,
    Predictive,
    folds_of,
    lateral,
    log_density,
    pick,
    point_log_density,
    predictive,
    scores,
)
from experiments.lanes import Lanes
from experiments.scenarios.scene import join_tracks
from models.intersection.routes import Routes
from models.intersection.tracks import Tracks
from models.program import InputError
from tests.drawn_traffic import Floats, corner, noisy, straight

EAST, SOUTH = straight((-40, 0), (40, 0)), corner(0.0, reach=40.0)


def normal(d: float, variance: float) -> float:
    return math.exp(-0.5 * d * d / variance) / math.sqrt(2 * math.pi * variance)


def test_the_density_is_that_of_the_mixture() -> None:
    """Brute force on straight lanes, where lateral distances are coordinates."""
    north = straight((5, -30), (5, 30))
    given = Predictive([EAST, north], [np.full(81, 0.3), np.linspace(0.2, 0.5, 61)], np.array([0.7, 0.3]), 5000.0)
    track = np.array([[-3.0, 0.5], [-2.0, 0.2], [-1.0, -0.9], [38.0, 0.1], [41.5, 0.1]])  # the last one beyond the end
    each = [0.3 * (1 - STRAY), 0.7 * (1 - STRAY)]
    for x, y in track:
        on_east = normal(y, 0.3) / 80 if x <= 40 else 0.0
        each[1] *= (1 - STRAY) * on_east + STRAY / 5000
        each[0] *= STRAY / 5000  # driven east: north's lane is not against it, but far away
    exact = each[0] + each[1] + STRAY / 5000 ** len(track)
    found = log_density(given, join_tracks([track], None))
    assert found == pytest.approx([math.log(exact)], abs=1e-6)


def test_the_density_of_one_point_sums_to_one_over_the_area() -> None:
    """Of the points of a track on one lane; summed over a grid of places."""
    given = Predictive([EAST], [np.full(81, 0.25)], np.array([1.0]), 100.0 * 20.0)
    x, y = np.meshgrid(np.arange(-50, 50, 0.5) + 0.25, np.arange(-10, 10, 0.1) + 0.05)
    places = np.stack([x.ravel(), y.ravel()], 1)
    across, nearest = lateral(places, np.zeros(len(places)), EAST)
    point = point_log_density(across, given.variance[0][nearest], EAST, given.area)
    assert np.exp(point).sum() * 0.05 == pytest.approx(1.0, abs=1e-3)
    against = lateral(places, np.full(len(places), math.pi), EAST)[0]
    assert np.isinf(against).all()


def test_every_track_is_possible() -> None:
    given = Predictive([EAST], [np.full(81, 0.1)], np.array([1.0]), 1e4)
    stray = noisy([straight((0, -300), (0, 300)), EAST[::-1]], std=0.0)
    assert np.isfinite(log_density(given, stray)).all()


def test_folds_are_frozen_even_and_disjoint() -> None:
    fold = folds_of(23, 5)
    np.testing.assert_array_equal(fold, folds_of(23, 5))
    assert sorted(np.bincount(fold)) == [4, 4, 5, 5, 5]
    with pytest.raises(InputError, match=r"5 folds of 3 vehicles.*choose 2 to 3"):
        folds_of(3, 5)


def test_variances_are_of_vehicles_and_of_the_course() -> None:
    """Tracks 1 and -1 m beside a lane: spread 1 m, and bands of 1.645 m add another square metre."""
    train = noisy([EAST + np.array([0, 1.0]), EAST - np.array([0, 1.0])], std=0.0)
    band = [np.full(81, 1.6448536269514722)]
    lanes = Lanes([EAST], band, band, Routes(np.zeros((1, 4), dtype=np.int64), np.zeros(2, dtype=np.int64)))
    given = predictive(lanes, train, 1e4)
    assert given.variance[0] == pytest.approx(2.0) and given.share.tolist() == [1.0]
    assert TRUST > 0


def learn_from(lines: list[Floats], bands: float) -> Lanes:
    wide = [np.full(len(line), bands) for line in lines]
    return Lanes(lines, wide, wide, Routes(np.zeros((2, 4), dtype=np.int64), np.zeros(0, dtype=np.int64)))


def test_true_lanes_score_better_than_lanes_beside_them() -> None:
    tracks = noisy([EAST, SOUTH] * 10, std=0.4)

    def learn(train: Tracks) -> tuple[Lanes, Lanes]:
        route = np.arange(len(train.offsets) - 1) * 0
        for i, end in enumerate(train.points[train.offsets[1:] - 1]):
            route[i] = int(end[1] < -5)
        right, off = learn_from([EAST, SOUTH], 0.05), learn_from([EAST + 0.4, SOUTH + 0.4], 0.05)
        return tuple(each._replace(routes=Routes(each.routes.connections, route)) for each in (right, off))  # type: ignore[return-value]

    right, off = scores(learn, tracks, 5).sum(1)
    assert right < off - 100


def test_picking_tracks_keeps_their_headings() -> None:
    tracks = noisy([EAST, SOUTH, EAST])._replace(heading=np.arange(81 * 2 + len(SOUTH), dtype=np.float64))
    part = pick(tracks, np.array([1, 2]))
    np.testing.assert_array_equal(part.points, tracks.points[81:])
    np.testing.assert_array_equal(part.heading, tracks.heading[81:])
    assert part.offsets.tolist() == [0, len(SOUTH), len(SOUTH) + 81]
