"""Which tracks drove the same lane, on drawn cases whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from models.intersection.between_lanes import in_between
from models.intersection.laid_tracks import BIN, WINDOW, distances, lay, ways
from models.intersection.track_groups import from_group, group_tracks
from models.intersection.tracks import Tracks
from models.intersection.traffic_lanes import find_lanes
from models.program import InputError
from tests.drawn_traffic import corner, noisy, shifting, shuffled, straight

EAST = [straight((-60, y), (60, y)) for y in (0.0, 3.0)]
Ints = NDArray[np.int64]


def groups(tracks: Tracks, sigma: float = 0.3) -> Ints:
    return group_tracks(ways(tracks), sigma)[0]


def same(found: Ints, expected: list[int]) -> bool:
    """Whether two labellings are one but for names."""
    pairs = set(zip(found.tolist(), expected, strict=True))
    return len(pairs) == len(set(expected)) == len(set(found.tolist()))


def test_lanes_three_metres_apart_are_two() -> None:
    assert same(groups(noisy([EAST[0]] * 4 + [EAST[1]] * 3)), [0] * 4 + [1] * 3)


def test_lanes_three_metres_apart_are_two_with_a_metre_of_noise() -> None:
    for seed in range(5):
        assert same(groups(noisy([EAST[0]] * 4 + [EAST[1]] * 3, seed, 1.0), 1.0), [0] * 4 + [1] * 3)


def test_a_slip_lane_parts_from_the_lane_it_leaves() -> None:
    tracks = noisy([EAST[0]] * 3 + [corner(0.0, radius=25.0)] * 3)
    assert same(groups(tracks), [0] * 3 + [1] * 3)


def test_opposite_and_crossing_directions_are_never_one_lane() -> None:
    tracks = noisy([EAST[0]] * 2 + [EAST[0][::-1]] * 2 + [straight((0, -60), (0, 60))] * 2)
    assert same(groups(tracks), [0, 0, 1, 1, 2, 2])


def test_six_lanes_are_six() -> None:
    tracks = noisy([straight((-60, 3.2 * k), (60, 3.2 * k)) for k in range(6) for _ in range(2)])
    assert same(groups(tracks), [k for k in range(6) for _ in range(2)])


def test_a_track_seen_on_a_part_of_its_way_joins_its_lane() -> None:
    """Entry parts, exit parts and middles, of the left and of the right lane."""
    parts = [EAST[k][part] for k in (0, 1) for part in (slice(0, 50), slice(70, 120), slice(40, 80))]
    tracks = noisy([EAST[0]] * 2 + [EAST[1]] * 2 + parts)
    assert same(groups(tracks), [0, 0, 1, 1, 0, 0, 0, 1, 1, 1])


def test_parts_that_never_overlap_are_not_joined() -> None:
    tracks = noisy([EAST[0][:45]] * 2 + [EAST[0][70:]] * 2)
    assert same(groups(tracks), [0, 0, 1, 1])


def test_who_changes_lanes_is_on_none_and_leaves_the_others_alone() -> None:
    tracks = noisy([EAST[0]] * 5 + [EAST[1]] * 5 + [shifting(0.0, 3.0), shifting(0.0, 3.0)])
    group, laid = group_tracks(ways(tracks), 0.3)
    assert same(group, [0] * 5 + [1] * 5 + [2, 2])
    assert in_between(group, laid) == [group[-1]]
    routes, _ = find_lanes(tracks, 0.3, 2)
    assert routes.track_route[-2:].tolist() == [-1, -1] and len(routes.connections) == 2


def test_who_straddles_two_lanes_is_on_none() -> None:
    tracks = noisy([EAST[0]] * 5 + [EAST[1]] * 5 + [straight((-60, 1.5), (60, 1.5))] * 2)
    group, laid = group_tracks(ways(tracks), 0.3)
    assert in_between(group, laid) == [group[-1]]


def test_a_connection_into_the_next_lane_that_many_drive_is_a_lane() -> None:
    tracks = noisy([EAST[0]] * 4 + [EAST[1]] * 4 + [shifting(0.0, 3.0)] * 3)
    assert in_between(*group_tracks(ways(tracks), 0.3)) == []


def test_a_pocket_for_turning_is_a_lane_although_it_begins_in_another() -> None:
    pocket = shifting(0.0, 3.0)[:-50]
    tracks = noisy([EAST[0]] * 6 + [pocket] * 2)
    group, laid = group_tracks(ways(tracks), 0.3)
    assert same(group, [0] * 6 + [1, 1]) and in_between(group, laid) == []


def test_a_lane_needs_two_tracks() -> None:
    tracks = noisy([EAST[0]] * 3 + [EAST[1]])
    routes, _ = find_lanes(tracks, 0.3, 2)
    assert len(routes.connections) == 1 and routes.track_route.tolist() == [0, 0, 0, -1]
    assert len(find_lanes(tracks, 0.3, 1)[0].connections) == 2


def test_where_no_two_tracks_share_a_lane_one_sentence_says_so() -> None:
    tracks = noisy([EAST[0], EAST[1], straight((0, -60), (0, 60))])
    with pytest.raises(InputError, match=r"none of 3 tracks shares its lane.*at most 1 run together.*model.min_tracks"):
        find_lanes(tracks, 0.3, 2)


def test_the_order_of_tracks_changes_nothing() -> None:
    parts = [EAST[0][:50], EAST[1][60:], corner(0.0)]
    tracks = noisy([EAST[0]] * 3 + [EAST[1]] * 3 + [corner(0.0)] * 3 + parts, std=0.5)
    order = np.random.default_rng(1).permutation(12)
    before, after = (find_lanes(each, 0.5, 2)[0] for each in (tracks, shuffled(tracks, order)))
    np.testing.assert_array_equal(before.connections, after.connections)
    np.testing.assert_array_equal(before.track_route[order], after.track_route)


# The distance


def test_distance_is_that_of_the_farthest_window_beyond_noise() -> None:
    """Loops over windows, as the equation says."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        n, m = rng.integers(0, 7, (2, 9)).astype(float)
        a, b = 0.8 * rng.standard_normal((2, 9))
        sigma, worst, shared = 0.5, -np.inf, 0
        weight = [n[i] * m[i] / (n[i] + m[i]) if min(n[i], m[i]) >= 2 else 0.0 for i in range(9)]
        for first in range(9 - WINDOW + 1):
            total = sum(weight[first : first + WINDOW])
            if total > 0:
                gap = sum(weight[i] * (a[i] - b[i]) for i in range(first, first + WINDOW))
                worst = max(worst, abs(gap) / total - 2 * sigma / np.sqrt(total))
        shared = sum(w > 0 for w in weight)
        found = distances(n[None], (n * a)[None], m[None], (m * b)[None], sigma)[0][0]
        assert found == (pytest.approx(max(worst, 0.0)) if shared >= 2 else np.inf)


def test_profiles_that_part_in_one_bin_are_infinitely_far() -> None:
    full, total = np.full((1, 6), 6.0), np.zeros((1, 6))
    away = total.copy()
    away[0, 2] = 6.0 * 5.0
    assert distances(full, total, full, away, 0.3)[0][0] == np.inf


def test_a_track_is_compared_with_the_others_of_its_group() -> None:
    """Two tracks 1 m apart: either is 1 m from the other, not half of it from their mean."""
    every = ways(noisy([EAST[0], EAST[0] + np.array([0, 1.0])], std=0.0))
    laid = lay(every, EAST[0])
    assert from_group(laid, np.array([0, 0]), 0, 0.0)[0] == pytest.approx([1.0, 1.0])
    assert from_group(laid, np.array([0, 1]), 0, 0.0)[0].tolist() == [np.inf, pytest.approx(1.0)]


def test_a_track_lies_where_it_is_beside_a_curve() -> None:
    """4 m to the left over half of the curve, on it over the other half; a crossing one is far on one side."""
    beside = np.vstack([straight((0, 4), (30, 4)), straight((30, 0), (61, 0))])
    crossing = straight((20.5, -20), (20.5, 20))
    tracks = noisy([beside, crossing], std=0.0)
    laid = lay(ways(tracks), straight((0, 0), (60, 0)))
    mean = laid.total / np.maximum(laid.num, 1.0)
    middle = (30 // BIN) + 1  # directions are of the smoothed path: the step itself turns it
    assert mean[0, : middle - 2] == pytest.approx(4.0) and mean[0, middle + 1 :] == pytest.approx(0.0)
    assert mean[1, 20 // BIN] == 6.0 and laid.num[1, 20 // BIN] > 30
