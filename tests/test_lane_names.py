"""Arms and lane numbers of lanes that were found as curves."""

from __future__ import annotations

import numpy as np

from models.intersection.lane_names import name_lanes
from tests.drawn_traffic import corner, straight

CENTRE = np.zeros(2)
CROSS = [
    straight((-60, -2), (60, -2)),  # east, inner
    straight((-60, -5), (60, -5)),  # east, outer
    straight((60, 2), (-60, 2)),  # west
    straight((2, -60), (2, 60)),  # north
    corner(-5.0),  # from the outer east lane to the south
]


def test_lanes_get_the_arms_they_begin_and_end_on_and_count_from_the_middle() -> None:
    names, angle = name_lanes(CROSS, np.full(5, 2), CENTRE)
    east, north, west, south = (
        int(np.abs(np.angle(np.exp(1j * (angle - a)))).argmin()) for a in np.arange(4) * np.pi / 2
    )
    assert len(angle) == 4
    assert names.tolist() == [
        [west, 0, east, 0],
        [west, 1, east, 1],
        [east, 0, west, 0],
        [south, 0, north, 0],
        [west, 1, south, 0],  # shares its entry with the outer lane
    ]


def test_an_end_inside_the_junction_is_on_no_arm_and_shares_its_name_with_no_other() -> None:
    halves = [CROSS[0][:57], CROSS[1][:57], CROSS[0][63:]]
    names, _ = name_lanes(halves, np.full(3, 2), CENTRE)
    assert names[:, 0].tolist() == [names[0, 0], names[0, 0], -1]
    assert names[:, 2].tolist() == [-1, -1, names[2, 2]]
    assert names[0, 3] != names[1, 3]


def test_one_stub_is_recognised_though_its_lanes_were_seen_from_different_distances() -> None:
    names, _ = name_lanes([CROSS[1], CROSS[4][20:], CROSS[0]], np.full(3, 2), CENTRE)
    assert names[0, :2].tolist() == names[1, :2].tolist() != names[2, :2].tolist()


def test_where_every_lane_ends_inside_there_is_no_arm() -> None:
    names, angle = name_lanes([straight((-10, 0), (10, 0))], np.array([2]), CENTRE)
    assert len(angle) == 0 and names.tolist() == [[-1, 0, -1, 0]]


def test_a_lane_of_a_few_metres_has_names_too() -> None:
    names, angle = name_lanes([straight((30, 2), (23, 2)), straight((-60, -2), (60, -2))], np.full(2, 2), CENTRE)
    east = int(np.abs(np.angle(np.exp(1j * angle))).argmin())
    assert names[0].tolist() == [east, 0, -1, 0] and names[1, 2] == east
