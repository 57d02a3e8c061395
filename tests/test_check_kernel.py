"""What the machine code of checks calls good: margin by margin, step by step, against plain formulas."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from planning.candidates import Keep, Lateral, Longitudinal
from planning.check_kernel import (
    BOUNDARY,
    CRAWLING,
    END_OF_LINE,
    GOOD,
    OBSTACLE,
    REASONS,
    STOP_POINT,
    along_line,
    first_limit,
    first_rectangle,
    first_touch,
    first_turn,
    in_plane,
    within,
)
from planning.frenet import FrenetState, to_pose
from planning.kinematics import GUARDED, KINEMATICS, LIMITS, MARGINS, Limits
from planning.planner import Planner, combined, judge
from planning.polynomials import NOTHING, Polynomials, quartics, quintics
from planning.reference import from_curvature
from planning.scene import Scene
from planning.shapes import Obstacles, boundary, no_obstacles

PLANNER = Planner()
S = np.arange(0.0, 301.0, 0.5)
STRAIGHT = from_curvature(S, 0.0 * S)
CERTAIN = (1e-3, np.ones(1), np.full(1, 3.0902), np.zeros(1))  # one rectangle that must not be touched
LIMIT = np.array([getattr(Limits(), name) for name in LIMITS])


def inputs(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """a (9, K) and d (3, K) of the kernel from the seven inputs of the kinematics (K, 7)."""
    a = np.zeros((9, len(rows)))
    a[1:5] = rows[:, :4].T
    return a, np.ascontiguousarray(rows[:, 4:].T)


def test_each_margin_alone_is_seen_and_none_is_nan() -> None:
    rng = np.random.default_rng(0)
    x = np.column_stack([
        rng.uniform(-0.5, 25, 40000), rng.normal(0, 3, 40000), rng.normal(0, 0.1, 40000), rng.normal(0, 0.01, 40000),
        rng.normal(0, 4, 40000), rng.normal(0, 0.5, (40000, 2)),
    ])  # fmt: skip
    broken = MARGINS(x, LIMIT[None])[:, : len(GUARDED)] < 0
    for n in range(len(GUARDED)):
        alone = x[broken[:, n] & (broken.sum(1) == 1)]
        if not len(alone):  # it comes with another one
            assert GUARDED[n] == "leaves the reference line's normals"
            alone = np.array([[0.0, 0.0, 0.2, 0.0, 4.8, 0.0, 0.0]])
        a, d = inputs(np.vstack([x[~broken.any(1)][:2], alone[:1]]))
        assert not within(a, d, LIMIT, np.empty(3), np.empty(3))
        assert first_limit(a, d, LIMIT) == (n + 1, 2)
    good = x[~broken.any(1)][:50]
    speed, curvature = np.empty(50), np.empty(50)
    assert within(*inputs(good), LIMIT, speed, curvature) and first_limit(*inputs(good), LIMIT) == (GOOD, 50)
    np.testing.assert_allclose(np.stack([speed, curvature], -1), KINEMATICS(good, NOTHING)[:, [0, 2]], rtol=1e-9)
    good[7, 6] = math.nan
    assert not within(*inputs(good), LIMIT, speed, curvature) and first_limit(*inputs(good), LIMIT)[1] == 7


def test_turns_too_quick_are_found_but_at_a_crawl() -> None:
    slow, fast = CRAWLING - 0.01, CRAWLING + 0.01

    def turn(speed: list[float], curvature: list[float], start: float = 0.0) -> int:
        return int(first_turn(np.array(speed), np.array(curvature), start, 0.01))

    assert turn([fast] * 3, [0.009, 0.0, 0.009]) == 3
    assert [turn([fast] * 3, [0.0, 0.0, k]) for k in (0.011, -0.011)] == [2, 2]
    assert [turn([fast] * 3, [k, k, k]) for k in (0.011, -0.011)] == [0, 0]
    assert turn([fast] * 3, [0.02, 0.02, 0.02], 0.011) == 3
    assert turn([slow, fast, fast], [0.5, 0.2, 0.2]) == 3
    assert turn([fast, slow, fast, fast], [0.0, 0.5, 0.2, 0.3]) == 3


def test_places_and_headings_in_the_plane() -> None:
    line = from_curvature(S, 0.05 * np.sin(S / 9))
    motion = quintics((20.0, 6.0, 0.5), [(34.0, 3.0, 0.0)], [3.0])
    lateral = quintics((-1.5, 1.0, 0.3), [(2.0, 0.0, 0.0)], [2.0])
    a, pose, t = np.empty((1, 9, 60)), np.empty((4, 60)), 0.05 * np.arange(1, 61)
    along_line(*motion, line.table, line.step, 0.05, a)
    d = np.ascontiguousarray(lateral.at(t)[0].T)
    in_plane(a[0], d, pose)
    for k, (ds, (offset, dd, _)) in enumerate(zip(a[0, 1], d.T, strict=True)):
        x, y, heading = to_pose(line, FrenetState(a[0, 0, k], ds, 0.0, offset, dd / ds))[:3]
        np.testing.assert_allclose(pose[:, k], (x, y, math.cos(heading), math.sin(heading)), atol=1e-9)
    a[0, 1, 0] = d[1, 0] = 0.0
    in_plane(a[0], d, pose)
    np.testing.assert_allclose(pose[2:, 0], (a[0, 7, 0], a[0, 8, 0]), atol=1e-12)


def test_the_first_thing_met_is_the_reason() -> None:
    a, pose = np.zeros((9, 6)), np.zeros((4, 6))
    a[0] = pose[0] = np.arange(6.0)
    pose[2] = 1.0
    wall = boundary([np.array([(4.4, -1.0), (4.4, 1.0)])], 1.0)  # touched by a circle of .5 from x = 3.9 on
    nowhere = boundary([], 1.0)
    box = np.zeros((1, 11, 6))
    box[0, 0], box[0, 2], box[0, 4:6], box[0, 10] = 5.0, 1.0, 0.6, 100.0  # from x = 3.9 on

    def met(end: float, stop: float, lines: bool, boxes: bool) -> tuple[int, int]:
        given = tuple((wall if lines else nowhere)[:6])
        told = (box[: int(boxes)], CERTAIN, 0.0, np.zeros(1), 0.5, np.arange(int(boxes)))
        found, at = first_touch(a, pose, end, stop, given, *told, False)
        hurried, _ = first_touch(a, pose, end, stop, given, *told, True)
        assert hurried == found or (hurried == OBSTACLE and boxes)
        return int(found), int(at)

    far = math.inf
    assert met(9.0, far, False, False) == (GOOD, 6)
    assert met(5.0, far, False, False) == met(9.0, 5.0, False, False) == (GOOD, 6), "to the end is not beyond it"
    assert met(3.5, far, False, False) == (END_OF_LINE, 4)
    assert met(3.5, 3.6, False, False) == (STOP_POINT, 4) and met(3.5, 1.2, False, False) == (STOP_POINT, 2)
    assert met(4.5, 1.2, False, False) == (STOP_POINT, 2)
    assert met(3.6, 4.5, False, False) == (END_OF_LINE, 4)
    assert met(9.0, far, True, False) == (BOUNDARY, 4) and met(9.0, far, False, True) == (OBSTACLE, 4)
    assert met(9.0, far, True, True) == (BOUNDARY, 4) and met(9.0, 3.5, True, True) == (STOP_POINT, 4)
    assert met(9.0, 4.5, False, True) == (OBSTACLE, 4) and met(9.0, 2.5, True, True) == (STOP_POINT, 3)


def test_far_rectangles_are_told_by_the_middle_of_the_vehicle() -> None:
    row = np.zeros((1, 11, 1))
    row[0, [2, 4, 5]] = [[1.0], [1.0], [1.0]]
    row[0, 0], row[0, 10] = 7.0, 2.0**2  # a rectangle at x = 7 counts as near from x = 5 on
    pose = np.array([[1.0], [0.0], [1.0], [0.0]])
    assert first_rectangle(pose, row, CERTAIN, 3.9, np.array([8.0]), 1.0, np.arange(1), False) == 1
    assert first_rectangle(pose, row, CERTAIN, 4.1, np.array([8.0]), 1.0, np.arange(1), False) == 0
    assert (
        first_rectangle(
            np.array([[0.0], [1.0], [0.0], [1.0]]), row * 1.0, CERTAIN, 3.9, np.array([8.0]), 1.0, np.arange(1), False
        )
        == 1
    )


def uniform(**given: float) -> str:
    """Why 10 m/s for 3 s from s = 20 on are bad: the front comes to 50 m and its own length ahead."""
    ahead = Longitudinal(Polynomials(np.array([[20.0, 10.0, 0, 0, 0, 0]]), np.array([3.0])), np.zeros(1))
    aside = Lateral(Polynomials(np.zeros((1, 6)), np.array([3.0])), np.array([False]), np.zeros(1), np.zeros(1))
    start = FrenetState(20.0, 10.0, 0.0, 0.0)
    empty, lines = no_obstacles(60), boundary([], PLANNER.radius)
    scene = Scene(STRAIGHT, start, Keep(10.0), np.zeros(1), 0.0, lines, empty, **given)
    found = judge(PLANNER, scene, combined(PLANNER, ahead, aside), PLANNER.comfort)
    return REASONS[found.reason[0]]


def test_stop_points_are_for_the_front_and_standing_for_what_comes_after() -> None:
    front, way = PLANNER.vehicle.front, 10.0**2 / (2 * PLANNER.comfort.braking)
    assert uniform(stop=50.0 + front + 1e-6) == "none" and uniform(stop=50.0 + front - 1e-6) == "stop point"
    beyond = 50.0 + way + front
    assert uniform(stand=beyond + 1e-6) == "none" and uniform(stand=beyond - 1e-6) == REASONS[-1]


def beside(gaps: Sequence[float], probability: float = 1.0, std: float = 0.1) -> str:
    """Why passing cars of uncertain place, one after the other, so far from the vehicle's circles is bad [m]."""
    num = len(gaps)
    pose = np.tile([35.0, 0.0, 0.0], (num, 60, 1))
    pose[:, :, 0] += np.arange(num)[:, None]
    pose[:, :, 1] = 0.95 + PLANNER.radius + np.array(gaps)[:, None]
    covariance = np.tile(std**2 * np.eye(2), (num, 60, 1, 1))
    others = Obstacles(pose, np.tile([4.0, 1.9], (num, 1)), covariance, np.full(num, probability))
    aside = Lateral(Polynomials(np.zeros((1, 6)), np.array([3.0])), np.array([False]), np.zeros(1), np.zeros(1))
    ahead = Longitudinal(quartics((20.0, 10.0, 0.0), [10.0], [3.0]), np.zeros(1))
    start, lines = FrenetState(20.0, 10.0, 0.0, 0.0), boundary([], PLANNER.radius)
    scene = Scene(STRAIGHT, start, Keep(10.0), np.zeros(1), 0.0, lines, others)
    found = judge(PLANNER, scene, combined(PLANNER, ahead, aside), PLANNER.comfort)
    return REASONS[found.reason[0]]


def test_the_risk_is_for_the_sum_of_the_chances() -> None:
    """Of touching a car at z standard deviations it is p Phi(-z): 1e-3 at 3.09, 5e-4 at 3.29, 3.2e-4 at 3.41; those far
    away leave nearly all of it to the near ones, whatever number."""
    far, bad = [900.0] * 19, "other road user"
    assert beside([0.311]) == "none" and beside([0.307]) == bad
    assert beside([0.33, 0.33]) == "none" and beside([0.328, 0.328]) == bad
    assert beside([0.311, 0.342]) == bad and beside([0.32, 0.345]) == "none", "6.9e-4 + 2.8e-4"
    assert beside([0.315, *far]) == "none" and beside([0.309, *far]) == bad, "1.05e-3 with what is left for the far"
    assert beside([0.33] * 4, 0.5) == "none" and beside([0.328] * 4, 0.5) == bad
    assert beside([-1.0], 0.99e-3) == "none" and beside([-1.0], 1.01e-3) == bad


@pytest.mark.parametrize("num", [1, 3, 20])
def test_equal_shares_of_the_risk_are_no_more_than_all_of_it(num: int) -> None:
    """Z such that each has its share: clear, as planning.shapes has it."""
    from scipy.special import ndtri

    share = float(-ndtri(1e-3 / num)) * 0.1
    assert beside([share + 1e-6] * num) == "none" and beside([share - 1e-3] * num) == "other road user"
