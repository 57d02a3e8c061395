"""Lanes over readings: exact quantiles of mixtures, shares as probabilities, and no order of anything matters."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from experiments.lane_mixture import ReadLanes, is_same, mix
from experiments.lane_posterior import LanePosterior
from experiments.lanes import with_lanes
from experiments.readings import read
from experiments.scenarios.paths import beside
from experiments.scenarios.protocol import protocol
from inference import least_squares
from inference.posterior import Posterior
from models.intersection.course_lines import edges
from models.intersection.courses import LaneCourses
from models.intersection.packing import FIELDS
from models.intersection.routes import Routes
from models.intersection.state import Junction

X = np.arange(0.0, 50.0)


def straight(y: float) -> np.ndarray:
    return np.column_stack([X, np.full(len(X), y)])


def spread(std: float, num: int) -> np.ndarray:
    """Draws at the quantiles (i + 1/2) / num of a normal, the same at every node."""
    return np.tile(norm.ppf((np.arange(num) + 0.5) / num) * std, (len(X), 1))


def lanes(share: float, places: list[float], std: float, track_route: list[int]) -> ReadLanes:
    num = round(share * 1000)
    lines = [straight(y) for y in places]
    routes = Routes(np.zeros((len(lines), 4), dtype=np.int64), np.array(track_route))
    return ReadLanes(share, lines, [spread(std, num) for _ in lines], routes)


BEST = lanes(0.7, [0.0, 3.0, 6.0], 0.1, [0, 0, 0, 1, 1, 1, 2, -1])
OTHER = lanes(0.3, [3.0, 0.5, 9.0], 0.2, [1, 1, 1, 0, 0, 0, -1, 2])  # the same two lanes, and another one


def test_probabilities_are_the_shares_of_the_readings_that_have_the_lane() -> None:
    found = mix([BEST, OTHER], 0.9)
    assert found.probability == pytest.approx([1.0, 1.0, 0.7])
    assert [(a.probability, a.reading, a.lane) for a in found.alternatives] == [(0.3, 1, 2)]


def test_a_band_is_the_quantile_of_the_mixture() -> None:
    """To the spacing of the draws: half of a thousandth of the probability."""
    found = mix([BEST, OTHER], 0.9)
    for lane, offset in ((0, 0.5), (1, 0.0)):
        below = partial(lambda x, at: 0.7 * norm.cdf(x / 0.1) + 0.3 * norm.cdf((x - at) / 0.2), at=offset)
        for p, edge in ((0.95, found.left[lane]), (0.05, -found.right[lane])):
            assert below(edge.mean()) == pytest.approx(p, abs=1e-3)
            assert edge == pytest.approx(brentq(lambda x, p=p, below=below: below(x) - p, -2.0, 2.0), abs=0.01)
    assert found.left[2] == pytest.approx(norm.ppf(0.95) * 0.1, abs=1e-3)  # of the only reading that has it


def test_one_reading_keeps_its_bands() -> None:
    alone = BEST._replace(share=1.0)
    found = mix([alone], 0.9)
    left, right = edges(alone.across, 0.9)
    np.testing.assert_array_equal(found.left, left)
    np.testing.assert_array_equal(found.right, right)
    assert (found.probability == 1.0).all() and found.alternatives == []


def test_the_order_of_readings_and_of_their_lanes_changes_nothing() -> None:
    third = lanes(0.2, [9.2, 0.1], 0.2, [1, 1, 1, -1, -1, -1, -1, 0])
    readings = [BEST._replace(share=0.5), OTHER, third]
    order = [2, 0, 1]
    shuffled = OTHER._replace(
        lines=[OTHER.lines[i] for i in order],
        across=[OTHER.across[i] for i in order],
        routes=OTHER.routes._replace(
            track_route=np.array([order.index(lane) if lane >= 0 else -1 for lane in OTHER.routes.track_route])
        ),
    )
    one, other = mix(readings, 0.9), mix([readings[0], third, shuffled], 0.9)
    assert one.probability == pytest.approx([1.0, 0.8, 0.5])
    np.testing.assert_allclose(one.probability, other.probability)
    np.testing.assert_allclose(one.left, other.left)
    np.testing.assert_allclose(one.right, other.right)
    assert [a.probability for a in one.alternatives] == pytest.approx([0.5])
    assert [a.probability for a in other.alternatives] == pytest.approx([0.5])


def test_a_lane_is_at_most_one_lane_of_another_reading() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        one, other = rng.integers(-1, 3, (2, 12))
        same = [[is_same(one == i, other == j) for j in range(3)] for i in range(3)]
        assert max(np.sum(same, 0).max(), np.sum(same, 1).max()) <= 1
    halves = np.arange(4) < 2
    assert is_same(halves, halves) and not is_same(halves, np.ones(4, dtype=bool))


def test_a_concentric_arc_runs_beside_at_the_difference_of_the_radii() -> None:
    angle = np.linspace(0.0, 2.0, 60)
    arc = lambda radius: radius * np.column_stack([np.cos(angle), np.sin(angle)])  # noqa: E731
    offset, place = beside(arc(20.0), arc(19.0))
    sagitta = 19.0 * (1 - math.cos(2.0 / 59 / 2))  # of the chords
    np.testing.assert_allclose(offset[1:-1], 1.0, atol=sagitta + 1e-4)
    np.testing.assert_allclose(place, np.arange(60), atol=0.02)


SCENE = protocol(5, max_lanes=2)
MODEL = Junction()
EVIDENCE = MODEL.prepare(SCENE.data)
REFINE = partial(least_squares.run, tolerance=0.02, learn=("advance", "handle"))


def true_state() -> dict[str, Any]:
    truth, state = SCENE.truth, MODEL.start(EVIDENCE)
    num = len(truth.angle)
    state |= {"num_arms": np.asarray(num), "centre": truth.centre}
    for name in ("angle", "gap", "entries", "exits", "width"):
        state[name] = np.concatenate([getattr(truth, name), np.asarray(state[name])[num:]])
    return {name: np.asarray(value) for name, value in state.items()} | {"bend": np.zeros(7)}


def without_last_arm(state: dict[str, Any]) -> dict[str, Any]:
    return state | {"num_arms": state["num_arms"] - 1}


def posterior_of(states: list[dict[str, Any]], chains: int = 1) -> Posterior:
    draws = {name: np.stack([state[name] for state in states]) for name in states[0]}
    return Posterior(
        {name: values.reshape((chains, -1, *values.shape[1:])) for name, values in draws.items()}, estimate=true_state()
    )


def ten_draws() -> list[dict[str, Any]]:
    """Seven draws about the true structure, three that lack its last arm."""
    rng, states = np.random.default_rng(0), []
    for number in range(10):
        state = true_state()
        state["centre"] = state["centre"] + rng.normal(0.0, 0.05, 2)
        states.append(without_last_arm(state) if number >= 7 else state)
    return states


def lanes_of(states: list[dict[str, Any]]) -> LanePosterior:
    return with_lanes(MODEL, EVIDENCE, posterior_of(states), REFINE, LaneCourses(inner_wave_std=0.0), 0)


@pytest.fixture(scope="module")
def found() -> LanePosterior:
    return lanes_of(ten_draws())


def test_lanes_of_an_arm_that_three_draws_of_ten_lack_have_probability_seven_tenths(found: LanePosterior) -> None:
    assert found.lanes is not None and found.probability is not None
    on_it = (found.lanes.routes.connections[:, ::2] == found.estimate["num_arms"] - 1).any(1)
    assert found.info["readings"] == 2 and 0 < on_it.sum() < len(on_it)
    np.testing.assert_allclose(found.probability, np.where(on_it, 0.7, 1.0))
    rows = found.table()
    assert [row["probability"] for row in rows[: len(on_it)]] == pytest.approx(found.probability.tolist())
    assert any("shares of 10 draws" in flag for flag in found.info["flags"])


def test_the_order_of_draws_and_of_slots_changes_nothing(found: LanePosterior) -> None:
    rng, shuffled = np.random.default_rng(1), []
    for state in (ten_draws()[i] for i in rng.permutation(10)):
        num = int(state["num_arms"])
        slots = np.concatenate([rng.permutation(num), num + rng.permutation(7 - num)])
        shuffled.append({n: v[slots] if n in FIELDS else v for n, v in state.items()})
    again = lanes_of(shuffled)
    assert found.lanes is not None and again.lanes is not None
    np.testing.assert_allclose(again.probability, found.probability)
    for one, other in zip(again.lanes.left + again.lanes.right, found.lanes.left + found.lanes.right, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize(("factor", "kept"), [(1.05, 2), (2.0, 1)])
def test_readings_whose_courses_got_lost_are_left_out_and_flagged(factor: float, kept: int) -> None:
    """A search that stalled near its minimum is no loss: its courses cost little more than the best reading's."""

    def stalled(*arguments: Any, **knobs: Any) -> Posterior:
        fitted = REFINE(*arguments, **knobs)
        if len(fitted.estimate["angle"]) == len(SCENE.truth.angle):
            return fitted
        return replace(fitted, info=fitted.info | {"converged": False, "cost": factor * fitted.info["cost"]})

    found = with_lanes(MODEL, EVIDENCE, posterior_of(ten_draws()), stalled, LaneCourses(inner_wave_std=0.0), 0)
    assert found.info["readings"] == kept
    assert found.info["readings_share"] == pytest.approx(1.0 if kept == 2 else 0.7)
    assert any("30% of their draws, got lost" in flag for flag in found.info["flags"]) is (kept == 1)


def test_a_best_state_that_no_draw_is_like_counts_as_one_more() -> None:
    readings = read(MODEL, EVIDENCE, posterior_of([without_last_arm(true_state())] * 9))
    assert [reading.share for reading in readings.kept] == pytest.approx([0.1, 0.9])


def test_chains_that_disagree_are_flagged() -> None:
    states = [true_state()] * 30 + [without_last_arm(true_state())] * 30
    flags = read(MODEL, EVIDENCE, posterior_of(states, chains=2)).flags
    assert any("best_structure" in flag for flag in flags)


def test_a_table_has_no_direction_where_a_lane_has_no_arm(found: LanePosterior) -> None:
    assert found.lanes is not None
    half = found.lanes.routes._replace(connections=found.lanes.routes.connections * [1, 1, 0, 0] - [0, 0, 1, 1])
    rows = replace(found, lanes=found.lanes._replace(routes=half), probability=None).table()
    assert all(math.isnan(row["exit_arm_deg"]) and math.isnan(row["probability"]) for row in rows[: len(half[0])])
    assert all(-180.0 <= row["entry_arm_deg"] <= 180.0 for row in rows)
