"""The lane error counts what it says: distances of matched lanes, 2.7 m for each wrong one, one to one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from experiments.lane_metrics import COST, _mean_distance, distance_to_line, lane_error, metrics, region
from experiments.lane_posterior import LanePosterior, Lanes
from experiments.scenarios import paths
from experiments.scenarios.protocol import protocol
from experiments.scenarios.scene import JunctionTruth, Scene
from inference.posterior import Posterior
from models.intersection.routes import Routes
from models.program import InputError

X = np.arange(-60.0, 60.01, 0.25)


@pytest.fixture(scope="module")
def truth() -> JunctionTruth:
    return protocol(3, tracks=1).truth


def roads(*offsets: float) -> JunctionTruth:
    """Straight lanes along the x-axis at these offsets, driven by a vehicle each; the interior has radius 10 m."""
    num = len(offsets)
    return JunctionTruth(
        centre=np.zeros(2),
        angle=np.array([math.pi, 0.0]),
        gap=np.zeros(2),
        entries=np.array([num, 0]),
        exits=np.array([0, num]),
        width=np.full(2, 2.7),
        radius=np.array([10.0, 8.0]),
        lines=[at(y) for y in offsets],
        connections=np.array([(0, i, 1, i) for i in range(num)]),
        track_lane=np.arange(num),
    )


def at(y: float) -> np.ndarray:
    return np.column_stack([X, np.full(len(X), y)])


def beside(line: np.ndarray, by: float) -> np.ndarray:
    heading = paths.headings(line)
    return line + by * np.column_stack([-np.sin(heading), np.cos(heading)])


def test_distances_are_those_to_segments() -> None:
    """Against the projection onto every segment; (50, 1) is 50 m from the next vertex."""
    rng = np.random.default_rng(0)
    points, line = rng.normal(0.0, 5.0, (200, 2)), np.cumsum(rng.normal(0.0, 2.0, (40, 2)), axis=0)
    a, step = line[:-1], np.diff(line, axis=0)
    t = ((points[:, None] - a) * step).sum(-1) / np.square(step).sum(-1)
    foot = a + np.clip(t, 0, 1)[..., None] * step
    expected = np.linalg.norm(points[:, None] - foot, axis=-1).min(1)
    np.testing.assert_allclose(distance_to_line(points, line), expected, atol=1e-12)
    straight = np.array([[0.0, 0.0], [0.0, 0.0], [100.0, 0.0]])
    asked = np.array([[50.0, 1.0], [-3.0, 4.0], [103.0, -4.0]])
    assert distance_to_line(asked, straight).tolist() == [1.0, 5.0, 5.0]


def test_a_mean_distance_is_cut_and_otherwise_exact(truth: JunctionTruth) -> None:
    means, cut = [], []
    for one in truth.lines:
        for other in truth.lines:
            means.append(distance_to_line(region(one), other).mean())
            cut.append(_mean_distance(region(one), other, COST))
    np.testing.assert_allclose(cut, np.minimum(means, COST), rtol=1e-12)
    assert 0 < (np.array(cut) < COST).sum() < len(cut)


def test_the_truth_itself_has_no_error(truth: JunctionTruth) -> None:
    score = lane_error(truth.lines, truth)
    assert set(score) == {"lane_error_cm", "lanes_missed", "lanes_phantom", "inside_cm", "arms_cm"}
    assert all(value == pytest.approx(0.0, abs=1e-9) for value in score.values())


def test_lanes_shifted_by_ten_centimetres_are_ten_centimetres_off_in_any_order(truth: JunctionTruth) -> None:
    moved = [beside(line, 0.1) for line in truth.lines]
    score = lane_error(moved, truth)
    for name in ("lane_error_cm", "inside_cm", "arms_cm"):
        assert score[name] == pytest.approx(10.0, abs=0.02)
    order = np.random.default_rng(0).permutation(len(moved))
    assert lane_error([moved[i] for i in order], truth) == pytest.approx(score)


def test_a_missed_lane_costs_its_width_among_the_true_ones(truth: JunctionTruth) -> None:
    score, num = lane_error(truth.lines[1:], truth), len(truth.lines)
    assert (score["lanes_missed"], score["lanes_phantom"]) == (1, 0)
    assert score["lane_error_cm"] == pytest.approx(270.0 / num)
    assert lane_error([], truth)["lane_error_cm"] == pytest.approx(270.0)


@pytest.mark.parametrize("by", [0.0, 300.0])
def test_a_phantom_costs_its_width_wherever_it_lies_as_one_more_lane(truth: JunctionTruth, by: float) -> None:
    score = lane_error([*truth.lines, truth.lines[0] + by], truth)
    assert (score["lanes_missed"], score["lanes_phantom"]) == (0, 1)
    assert score["lane_error_cm"] == pytest.approx(270.0 / (len(truth.lines) + 1))


def test_lines_farther_apart_than_a_lane_is_wide_are_no_pair() -> None:
    near, far = lane_error([at(2.69)], roads(0.0)), lane_error([at(2.71)], roads(0.0))
    assert near["lane_error_cm"] == pytest.approx(269.0) and near["lanes_missed"] == 0
    assert (far["lanes_missed"], far["lanes_phantom"]) == (1, 1)
    assert far["lane_error_cm"] == pytest.approx(270.0)
    assert math.isnan(far["inside_cm"]) and math.isnan(far["arms_cm"])


def test_pairs_are_the_closest_of_all_not_one_after_the_other() -> None:
    """The first line is closest to the estimate at 1, the only one of the second: .6 + 1.5 < .4 + 2.5."""
    score = lane_error([at(1.0), at(-0.6)], roads(0.0, 2.5))
    assert score["lane_error_cm"] == pytest.approx((60.0 + 150.0) / 2)


def test_a_lane_that_nobody_drove_is_neither_missed_nor_a_phantom(truth: JunctionTruth) -> None:
    others = truth._replace(track_lane=truth.track_lane[truth.track_lane != 0])
    for lines in (truth.lines, truth.lines[1:]):
        score = lane_error(lines, others)
        assert score["lane_error_cm"] == pytest.approx(0.0, abs=1e-9)
        assert score["lanes_missed"] == score["lanes_phantom"] == 0


def test_where_nobody_knows_who_drove_where_there_is_no_score(truth: JunctionTruth) -> None:
    unknown = truth._replace(track_lane=np.full(5, -1))
    assert all(math.isnan(value) for value in lane_error(truth.lines, unknown).values())


def test_a_longer_estimate_costs_nothing_and_a_shorter_one_what_it_lacks() -> None:
    longer = np.array([[-90.0, 0.0], [90.0, 0.0]])
    assert lane_error([longer], roads(0.0))["lane_error_cm"] == pytest.approx(0.0, abs=1e-9)
    # 20 of the 118 points, x = -59 .. 58, lie 1 .. 20 m beyond x = 38
    shorter = np.array([[-60.0, 0.0], [38.0, 0.0]])
    expected = 100.0 * np.arange(21).sum() / 118
    assert lane_error([shorter], roads(0.0))["lane_error_cm"] == pytest.approx(expected)


def test_inside_and_arms_part_at_the_larger_radius_of_the_two_arms() -> None:
    estimate = np.array([[-60.0, 0.2], [-10.0, 0.2], [-10.0, 0.0], [10.0, 0.0], [10.0, 0.2], [60.0, 0.2]])
    score = lane_error([estimate], roads(0.0))
    assert score["inside_cm"] == pytest.approx(0.0, abs=1e-9)
    # of 118 points 19 lie within 10 m of the centre, and two more on the line, at x = -10 and 10
    assert score["arms_cm"] == pytest.approx(20.0 * 97 / 99)
    assert score["lane_error_cm"] == pytest.approx(20.0 * 97 / 118)


@pytest.mark.parametrize(("bad", "named"), [(np.zeros((1, 2)), "line 1 has 1 points"), (at(np.nan), "line 1 .*finite")])
def test_lines_that_are_none_are_refused_by_number(bad: np.ndarray, named: str) -> None:
    with pytest.raises(InputError, match=named):
        lane_error([at(0.0), bad], roads(0.0))


def test_bands_are_scored_by_what_they_hold_and_by_their_width() -> None:
    """A lane .5 m beside the true one: the band of .6 m holds it, that of .4 m does not; half their mean is .5 m."""
    line, truth = at(0.5), roads(0.0)
    half = len(line) // 2
    wide = np.where(np.arange(len(line)) < half, 0.6, 0.4)
    lanes = Lanes(
        [line], [wide], [wide], Routes(truth.connections[:1], np.zeros(len(truth.track_lane), dtype=np.int64))
    )
    posterior = LanePosterior({"z": np.zeros((1, 2))}, lanes=lanes)
    scores = metrics(posterior, Scene(None, truth, "here", {}))
    assert scores["half_band_cm"] == pytest.approx(100.0 * wide.mean())
    assert scores["band_coverage"] == pytest.approx(half / len(line), abs=0.5 / len(line) + 0.02)
    assert metrics(Posterior({"z": np.zeros((1, 2))}), Scene(None, truth, "here", {})) == {}
