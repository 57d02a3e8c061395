"""Lanelets: shared where lanes coincide, split where they part, on drawn cases and on the protocol's junctions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from experiments.lanelets import SHORTEST, STEP, Floats, LaneletMap, lanelet_map
from experiments.scenarios.paths import arc_length
from experiments.scenarios.protocol import protocol
from models.program import InputError

R = 20.0  # of drawn turns [m]
FORK = np.array([[0, 0, 1, 0], [0, 0, 2, 0]])  # one entry, two exits
MERGE = FORK[:, [2, 3, 0, 1]]


def drawn(*pieces: tuple[float, float], start: tuple[float, float] = (0.0, 0.0), heading: float = 0.0) -> Floats:
    """A line (n, 2) with a point every 0.1 m, of pieces (length [m], curvature [1/m])."""
    kappa = np.concatenate([np.full(round(10 * length), curvature) for length, curvature in pieces])
    phi = heading + np.concatenate([[0.0], np.cumsum(0.1 * kappa)])
    middle = (phi[1:] + phi[:-1]) / 2
    steps = 0.1 * np.stack([np.cos(middle), np.sin(middle)], 1)
    return np.asarray(start) + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def length(lanelets: LaneletMap, number: int) -> float:
    return float(arc_length(lanelets.lanelets[number].centre)[-1])


def whole(lanelets: LaneletMap, route: int) -> Floats:
    """The centre (n, 2) of all lanelets of a route."""
    first, *others = (lanelets.lanelets[number].centre for number in lanelets.routes[route])
    return np.concatenate([first, *(centre[1:] for centre in others)])


def distances(points: Floats, line: Floats) -> Floats:
    return np.asarray(np.linalg.norm(points[:, None] - line[None], axis=2).min(1))


LEFT, RIGHT = drawn((40, 0), (25, 1 / R), (30, 0)), drawn((40, 0), (25, -1 / R), (30, 0))


def test_a_single_lane_is_one_lanelet_with_borders_half_a_width_away() -> None:
    lanelets = lanelet_map([drawn((30, 0))], FORK[:1], width=3.0)
    assert lanelets.routes == [[0]] and lanelets.followers == []
    left, right, centre = lanelets.lanelets[0]
    np.testing.assert_allclose(left - centre, [[0.0, 1.5]] * len(centre), atol=1e-9)
    np.testing.assert_allclose(right - centre, [[0.0, -1.5]] * len(centre), atol=1e-9)
    np.testing.assert_allclose(centre[[0, -1]], [[0, 0], [30, 0]], atol=1e-9)


def test_lanes_of_one_entry_share_a_lanelet_until_they_are_apart() -> None:
    lanelets = lanelet_map([LEFT, RIGHT], FORK, apart=0.5)
    assert lanelets.routes == [[0, 1], [0, 2]] and lanelets.followers == [(0, 1), (0, 2)]
    parted = 40 + R * np.arccos(1 - 0.5 / (2 * R))  # 2 R (1 - cos(s / R)) = apart
    assert parted - 2 * STEP <= length(lanelets, 0) <= parted
    np.testing.assert_allclose(lanelets.lanelets[0].centre[:, 1], 0.0, atol=1e-9)  # the mean of both


def test_merging_is_parting_driven_backwards() -> None:
    fork, merge = lanelet_map([LEFT, RIGHT], FORK), lanelet_map([LEFT[::-1], RIGHT[::-1]], MERGE)
    assert merge.routes == [[0, 2], [1, 2]] and merge.followers == [(0, 2), (1, 2)]
    for one, other in ((0, 2), (1, 0), (2, 1)):
        left, right, centre = fork.lanelets[one]
        for forwards, backwards in zip((right, left, centre), merge.lanelets[other], strict=True):
            np.testing.assert_allclose(forwards, backwards[::-1], atol=1e-9)


def test_lanes_that_coincide_at_both_ends_share_both_and_have_their_own_middle() -> None:
    around = [drawn((40, 0), (10, k), (20, -k), (10, k), (40, 0)) for k in (0.05, -0.05)]
    lanelets = lanelet_map(around, FORK[[0, 0]])
    assert lanelets.routes == [[0, 1, 3], [0, 2, 3]]
    assert length(lanelets, 0) == pytest.approx(length(lanelets, 3)) and length(lanelets, 0) > 40
    apart = lanelets.lanelets[1].centre - lanelets.lanelets[2].centre
    assert np.abs(apart[:, 1]).max() == pytest.approx(2 * (around[0][:, 1].max()), abs=0.05)


def test_lanes_that_coincide_throughout_are_one_lanelet() -> None:
    lanelets = lanelet_map([LEFT, LEFT + 0.1, RIGHT], FORK[[0, 0, 1]])
    assert lanelets.routes == [[0, 1], [0, 1], [0, 2]] and len(lanelets.lanelets) == 3


@pytest.mark.parametrize("connections", [[[0, 0, 1, 0], [0, 1, 1, 1]], [[0, 0, 1, 0], [0, 0, 1, 0]]])
def test_parallel_lanes_share_nothing_whatever_they_are_called(connections: list[list[int]]) -> None:
    lanelets = lanelet_map([LEFT, LEFT + np.array([0.0, 2.7])], np.array(connections))
    assert lanelets.routes == [[0], [1]] and lanelets.followers == []


def test_lanes_of_two_entries_share_nothing_even_where_they_coincide() -> None:
    assert lanelet_map([LEFT, RIGHT], np.array([[0, 0, 1, 0], [0, 1, 2, 0]])).routes == [[0], [1]]


def test_lanes_that_cross_share_nothing() -> None:
    crossing = [drawn((60, 0)), drawn((60, 0), start=(30, -30), heading=np.pi / 2)]
    assert lanelet_map(crossing, np.array([[0, 0, 2, 0], [1, 0, 3, 0]])).routes == [[0], [1]]


def test_lanes_that_part_one_after_another_make_a_tree() -> None:
    lines = [drawn((20, 0), (20, 1 / R), (30, 0)), drawn((40, 0), (20, -1 / R), (10, 0)), drawn((70, 0))]
    lanelets = lanelet_map(lines, np.array([[0, 0, n, 0] for n in (1, 2, 3)]))
    assert lanelets.routes == [[0, 2], [0, 1, 3], [0, 1, 4]]
    assert lanelets.followers == [(0, 1), (0, 2), (1, 3), (1, 4)]


def test_no_lanelet_is_shorter_than_the_shortest() -> None:
    lines = [drawn((20 + late, 0), (20, 1 / R), (30 - late, 0)) for late in (0.0, 2.0, 4.0)]
    lanelets = lanelet_map(lines, np.array([[0, 0, n, 0] for n in (1, 2, 3)]))
    assert min(length(lanelets, number) for number in range(len(lanelets.lanelets))) >= SHORTEST


def test_a_lane_with_shared_ends_that_overlap_keeps_a_middle_that_parts_the_routes() -> None:
    straight = drawn((60, 0))
    leaves = drawn((40, 0), (20, 1 / R))  # from the entry of `straight`, past its middle
    joins = drawn((40, 0), (20, 1 / R), start=(60, 0), heading=np.pi)[::-1]  # to its exit, from before its middle
    lanelets = lanelet_map([straight, leaves, joins], np.array([[0, 0, 1, 0], [0, 0, 2, 0], [3, 0, 1, 0]]))
    assert [len(route) for route in lanelets.routes] == [3, 2, 2]
    assert reachable(lanelets) == {(route[0], route[-1]) for route in lanelets.routes}
    assert length(lanelets, lanelets.routes[0][1]) >= SHORTEST - 1e-6
    assert np.diff(whole(lanelets, 0)[:, 0]).min() > 0


def test_a_lane_seen_late_begins_with_the_lanelet_of_its_stub() -> None:
    late = RIGHT[205:] + np.array([0.0, 0.2])  # 20.5 m on, and beside
    lanelets = lanelet_map([LEFT, late], FORK)
    assert lanelets.routes == [[0, 1], [0, 2]]
    centre = lanelets.lanelets[0].centre
    np.testing.assert_allclose(centre[0], 0.0, atol=1e-6)
    assert np.abs(centre[:, 1]).max() < 0.2
    np.testing.assert_allclose(whole(lanelets, 1)[-1], late[-1], atol=1e-6)


def test_centres_leave_the_shared_lanelet_without_a_kink_and_come_back_on_their_line() -> None:
    lanelets = lanelet_map([LEFT, RIGHT], FORK)
    for number, line in enumerate((LEFT, RIGHT)):
        steps = np.diff(whole(lanelets, number), axis=0)
        turns = np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))))
        assert turns.max() < 4.5 * STEP / R  # the kink would be 7 times STEP / R
        own = lanelets.lanelets[number + 1].centre
        settled = arc_length(own) > SHORTEST
        assert distances(own[settled], line).max() < 0.06  # half of the drawn step, chords


def test_widths_of_lanes_hold_on_their_own_and_are_averaged_where_shared() -> None:
    lanelets = lanelet_map([LEFT, RIGHT], FORK, width=[3.0, 4.0])
    shared, one, other = (np.linalg.norm(each.left[-1] - each.right[-1]) for each in lanelets.lanelets)
    np.testing.assert_allclose([shared, one, other], [3.5, 3.0, 4.0], atol=1e-9)


def test_borders_of_a_turn_tighter_than_half_a_width_do_not_fold() -> None:
    turn = drawn((20, 0), (0.75 * np.pi, 1.0), (20, 0))  # of radius 1 m
    left, right, centre = lanelet_map([turn], FORK[:1]).lanelets[0]
    assert len(left) < len(right) == len(centre)
    assert distances(left, centre).min() > 1.3
    out, away = np.array([1.0, 0.0]), np.array([-1.0, 1.0]) / np.sqrt(2)
    steps = np.diff(left, axis=0)
    assert np.maximum(steps @ out, steps @ away).min() > 0


def test_borders_of_a_turn_back_follow_both_legs_though_these_are_closer_than_a_width() -> None:
    left = lanelet_map([drawn((20, 0), (np.pi * 1.3, 1 / 1.3), (20, 0))], FORK[:1]).lanelets[0].left
    for place in ([10.0, 1.35], [10.0, 2.6 - 1.35]):
        assert distances(np.array([place]), left).max() < STEP


def reachable(lanelets: LaneletMap) -> set[tuple[int, int]]:
    """Every first lanelet with the last ones that a vehicle can reach from it."""
    after: dict[int, list[int]] = {number: [] for number in range(len(lanelets.lanelets))}
    for one, other in lanelets.followers:
        after[one].append(other)

    def ends(number: int) -> list[int]:
        return [end for other in after[number] for end in ends(other)] if after[number] else [number]

    firsts = set(after) - {other for _, other in lanelets.followers}
    return {(first, end) for first in firsts for end in ends(first)}


@pytest.mark.parametrize("seed", range(4))
def test_a_junction_has_its_routes_and_no_others(seed: int) -> None:
    truth = protocol(seed).truth
    lanelets = lanelet_map(truth.lines, truth.connections)
    assert reachable(lanelets) == {(route[0], route[-1]) for route in lanelets.routes}
    assert {pair for route in lanelets.routes for pair in pairwise(route)} == set(lanelets.followers)
    for before, after in lanelets.followers:
        for one, other in zip(lanelets.lanelets[before], lanelets.lanelets[after], strict=True):
            np.testing.assert_array_equal(one[-1], other[0])
    for number, line in enumerate(truth.lines):
        np.testing.assert_allclose(whole(lanelets, number)[[0, -1]], line[[0, -1]], atol=0.5)
        assert distances(whole(lanelets, number), line).max() < 0.5


def test_lanes_of_an_entry_or_an_exit_of_a_junction_begin_or_end_with_one_lanelet() -> None:
    truth = protocol(0).truth
    lanelets = lanelet_map(truth.lines, truth.connections)
    for end, stub in ((0, truth.connections[:, :2]), (-1, truth.connections[:, 2:])):
        assert len({route[end] for route in lanelets.routes}) == len(np.unique(stub, axis=0))


BAD = {
    "lines and connections": ([LEFT], FORK, 2.7, r"has 1 lines and connections \(2, 4\)"),
    "nothing": ([], FORK[:0], 2.7, r"has 0 lines"),
    "nan": ([LEFT, RIGHT * np.nan], FORK, 2.7, r"line 1 must be \(n, 2\) finite points"),
    "a point": ([LEFT[:1], RIGHT], FORK, 2.7, r"line 0 must be"),
    "no width": ([LEFT, RIGHT], FORK, [2.7, 0.0], r"the width must be a positive number, .* but is \[2\.7 0\. \]"),
    "three widths": ([LEFT, RIGHT], FORK, [2.7] * 3, r"one for each of 2 lines"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_named(case: str) -> None:
    lines, connections, width, message = BAD[case]
    with pytest.raises(InputError, match=message):
        lanelet_map(lines, connections, width)
