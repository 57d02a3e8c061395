"""Scores of estimated junctions, and that their pictures can be drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from experiments.junction_figures import figures
from experiments.junction_lanes import count_probabilities
from experiments.junction_lanes import figures as lane_figures
from experiments.junction_metrics import arms, label_free, match, metrics, structure
from experiments.scenarios import paths
from experiments.scenarios.protocol import protocol
from experiments.scenarios.scene import JunctionTruth, Scene
from inference.posterior import Posterior, Snapshots

SLOTS = 7


@pytest.fixture(scope="module")
def scene() -> Scene:
    return protocol(0)


def perfect(truth: JunctionTruth) -> dict[str, NDArray[Any]]:
    """The true junction as an engine would report it: its arms first, filler in the other slots."""
    arms = len(truth.angle)
    estimate = {"num_arms": np.array(arms), "centre": truth.centre}
    for name, filler in (("angle", truth.angle[0]), ("gap", 1.0), ("entries", 1), ("exits", 1), ("width", 2.7)):
        values = np.full(SLOTS, filler)
        values[:arms] = getattr(truth, name)
        estimate[name] = values
    return estimate


def changed(estimate: dict[str, NDArray[Any]], name: str, slot: int, by: float) -> dict[str, NDArray[Any]]:
    values = estimate[name].copy()
    values[slot] += by
    return estimate | {name: values}


def test_the_truth_itself_scores_without_error(scene: Scene) -> None:
    score = structure(perfect(scene.truth), scene.truth)
    assert score["arms_right"] == score["structure_right"] == score["lanes_right"] == 1.0
    assert score["angle_error_deg"] == score["centre_error_m"] == score["gap_error_m"] == 0.0


def test_arms_are_listed_in_degrees_without_inactive_slots(scene: Scene) -> None:
    rows = arms(perfect(scene.truth))
    order = np.argsort(paths.wrap(scene.truth.angle))
    assert len(rows) == len(scene.truth.angle) < SLOTS
    directions = np.degrees(paths.wrap(scene.truth.angle))[order]
    np.testing.assert_allclose([row["direction_deg"] for row in rows], directions, atol=1e-3)
    assert [row["entries"] for row in rows] == scene.truth.entries[order].tolist()
    assert [row["exits"] for row in rows] == scene.truth.exits[order].tolist()
    assert {"width_m", "gap_m"} <= rows[0].keys()


def test_an_estimate_of_something_else_has_no_arms() -> None:
    assert arms({"beta": np.zeros(2)}) == []


def test_the_order_of_slots_and_whole_turns_change_no_score(scene: Scene) -> None:
    estimate = changed(changed(perfect(scene.truth), "angle", 0, np.radians(3.0)), "entries", 1, 1)
    arms = len(scene.truth.angle)
    order = np.random.default_rng(0).permutation(arms)
    shuffled = {name: v if v.shape != (SLOTS,) else np.r_[v[:arms][order], v[arms:]] for name, v in estimate.items()}
    turned = changed(shuffled, "angle", 0, 2 * np.pi)
    assert structure(turned, scene.truth) == pytest.approx(structure(estimate, scene.truth), abs=1e-12)


def test_what_inactive_slots_hold_changes_no_score(scene: Scene) -> None:
    estimate = perfect(scene.truth)
    filled = changed(changed(estimate, "entries", SLOTS - 1, 3), "angle", SLOTS - 1, 1.0)
    assert structure(filled, scene.truth) == structure(estimate, scene.truth)


@pytest.mark.parametrize("side", ["entries", "exits"])
def test_one_wrong_lane_count_is_one_wrong_lane_count(scene: Scene, side: str) -> None:
    score = structure(changed(perfect(scene.truth), side, 1, 1), scene.truth)
    assert score["arms_right"] == 1.0 and score["structure_right"] == 0.0
    assert score["lanes_right"] == pytest.approx(1 - 1 / (2 * len(scene.truth.angle)))


def test_an_arm_outside_the_tolerance_is_missed_with_both_of_its_counts(scene: Scene) -> None:
    inside = structure(changed(perfect(scene.truth), "angle", 0, np.radians(9.9)), scene.truth)
    outside = structure(changed(perfect(scene.truth), "angle", 0, np.radians(-10.1)), scene.truth)
    assert inside["structure_right"] == 1.0
    assert outside["arms_right"] == 0.0
    assert outside["lanes_right"] == pytest.approx(1 - 1 / len(scene.truth.angle))


def test_a_further_arm_is_an_error(scene: Scene) -> None:
    estimate = perfect(scene.truth)
    more = estimate | {"num_arms": estimate["num_arms"] + 1}
    assert structure(more, scene.truth)["arms_right"] == 0.0


def test_two_estimated_arms_never_share_a_true_one() -> None:
    """Arms at 0 and 9 degrees against truths at 5 and 14: the closest truth of both is the one at 5."""
    scene = protocol(0)
    truth = scene.truth._replace(
        angle=np.radians([5.0, 14.0]), entries=np.array([1, 1]), exits=np.array([1, 1]), gap=np.zeros(2)
    )
    estimate = {"num_arms": np.array(2), "angle": np.radians([9.0, 0.0])}
    slots, arms, difference = match(estimate, truth)
    assert dict(zip(slots.tolist(), arms.tolist(), strict=True)) == {0: 1, 1: 0}
    assert np.degrees(difference) == pytest.approx([5.0, 5.0])


def posterior_of(scene: Scene) -> Posterior:
    """Four draws with weights .4 .3 .2 .1: right, right, one lane wrong, one arm too few."""
    right = perfect(scene.truth)
    states = [right, right, changed(right, "exits", 0, 1), right | {"num_arms": right["num_arms"] - 1}]
    stacked = {name: np.stack([state[name] for state in states]) for name in right}
    return Posterior(
        draws={name: values[None] for name, values in stacked.items()},
        log_weights=np.log([[0.4, 0.3, 0.2, 0.1]]),
        estimate=right,
        snapshots=Snapshots(np.arange(4), np.arange(4) * 1e-3, np.array([-9.0, -5.0, -2.0, -1.0]), stacked),
    )


def test_an_arm_that_nobody_drove_is_not_scored(scene: Scene) -> None:
    truth = scene.truth._replace(driven=np.arange(len(scene.truth.angle)) > 0)
    estimate = perfect(scene.truth)
    found_too = structure(changed(estimate, "entries", 0, 1), truth)  # its counts are nobody's business
    without = {n: v if v.shape != (SLOTS,) else np.roll(v, -1) for n, v in estimate.items()}
    missed = structure(without | {"num_arms": estimate["num_arms"] - 1}, truth)
    for score in (found_too, missed):
        assert score["structure_right"] == score["lanes_right"] == 1.0
    assert structure(changed(estimate, "entries", 1, 1), truth)["structure_right"] == 0.0


def test_label_free_scalars_ignore_order_and_inactive_slots(scene: Scene) -> None:
    posterior = posterior_of(scene)
    scalars = label_free(posterior)
    lanes = scene.truth.exits.sum()
    missing = scene.truth.exits[-1]  # of the arm the last draw leaves out
    assert scalars["num_exits"].tolist() == [[lanes, lanes, lanes + 1, lanes - missing]]
    assert scalars["centre_x"].shape == (1, 4)


def test_lane_count_probabilities_follow_the_weights(scene: Scene) -> None:
    """Exits of arm 0 are one more in a draw of weight .2; the last arm is missing in one of weight .1."""
    posterior = posterior_of(scene)
    shares = count_probabilities(posterior, "exits")
    right = int(scene.truth.exits[0])
    assert shares[0, right] == pytest.approx(0.8) and shares[0, right + 1] == pytest.approx(0.2)
    assert shares[-1].sum() == pytest.approx(0.9)


def test_probabilities_of_the_truth_follow_the_weights(scene: Scene) -> None:
    score = metrics(posterior_of(scene), scene)
    assert score["arm_count_probability"] == pytest.approx(0.9)
    assert score["lane_counts_probability"] == pytest.approx(0.7)
    assert score["structure_right"] == 1.0


def test_without_a_truth_there_is_no_score(scene: Scene) -> None:
    assert metrics(posterior_of(scene), scene._replace(truth=None)) == {}


@pytest.mark.parametrize("known", [True, False])
def test_every_picture_draws_with_and_without_truth(scene: Scene, known: bool) -> None:
    shown = scene if known else scene._replace(truth=None)
    drawn = figures(posterior_of(scene), shown) | lane_figures(posterior_of(scene), shown)
    assert set(drawn) == {"junction", "arm_count", "anytime", "lane_counts"}
    for figure in drawn.values():
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        assert np.asarray(canvas.buffer_rgba())[..., :3].std() > 1.0  # something other than paper


def test_one_way_arms_and_states_without_widths_draw(scene: Scene) -> None:
    posterior = posterior_of(scene)
    estimate = {name: values for name, values in posterior.estimate.items() if name != "width"}
    estimate["entries"] = np.where(np.arange(SLOTS) == 0, 0, estimate["entries"])
    figure = figures(Posterior(posterior.draws, estimate=estimate), scene)["junction"]
    labels = {text.get_text() for text in figure.axes[0].texts}
    assert f"0 in\n{int(estimate['exits'][0])} out" in labels
