"""Intersections by variational inference: the continuous part with its structure fixed, and the courses of lanes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from inference import bbvi, least_squares
from inference.factors import factored
from models.intersection.courses import LaneCourses
from models.program import Fixed, InputError, fix, simulate
from tests.small_junction import FULL, NOTHING, blank_evidence, one, with_points
from tests.small_lanes import small_scene, true_routes

ARMS = torch.tensor(3)


@pytest.fixture(scope="module")
def scene() -> tuple[Fixed, Any, dict[str, torch.Tensor]]:
    """A junction of three arms with its lanes known, its evidence, its truth."""
    truth = one(simulate(fix(FULL, num_arms=ARMS), NOTHING, num=1, seed=5), 0) | {"num_arms": ARMS}
    evidence = with_points(FULL, truth, blank_evidence(8, 8, 10), 1)
    return fix(FULL, **{n: truth[n] for n in ("num_arms", "entries", "exits")}), evidence, truth


def test_a_compiled_density_has_gradients_by_differences(scene: tuple[Fixed, Any, dict[str, torch.Tensor]]) -> None:
    """Against steps of another size, where all half tracks are seen."""
    model, evidence, truth = scene
    factors = factored(model, evidence)
    x = factors.whiten(truth)[None]
    height, slope = factors.gradient(x)
    assert height == pytest.approx(factors.evaluate(x).sum(-1), rel=1e-12)
    for d in range(x.shape[1]):
        step = 1e-3 * np.eye(x.shape[1])[d]
        apart = (factors.evaluate(x + step) - factors.evaluate(x - step)).sum()
        assert slope[0, d] == pytest.approx(apart / 2e-3, rel=1e-2, abs=0.05)
    assert np.abs(slope).max() > 1.0


def test_bbvi_finds_the_centre_and_the_arms_of_a_fixed_structure(
    scene: tuple[Fixed, Any, dict[str, torch.Tensor]],
) -> None:
    model, evidence, truth = scene
    knobs: dict[str, Any] = {"num_steps": 40, "num_samples": 32, "num_draws": 200, "num_snapshots": 0}
    posterior = bbvi.run(model, evidence, seed=0, init=truth, **knobs)
    gap = np.abs(posterior.mean("centre") - truth["centre"].numpy()) / posterior.sd("centre")
    assert gap.max() < 3.5
    turned = posterior.mean("angle")[:3] - truth["angle"].numpy()[:3]
    assert np.abs(turned / posterior.sd("angle")[:3]).max() < 3.5
    assert posterior.sd("angle")[:3].max() < 0.1, "the data say something"


def test_an_open_structure_is_refused_by_name(scene: tuple[Fixed, Any, dict[str, torch.Tensor]]) -> None:
    with pytest.raises(InputError, match="'num_arms' is Categorical; fix\\(\\) it first"):
        bbvi.run(FULL, scene[1], seed=0)


def test_lane_courses_are_those_of_least_squares() -> None:
    """Whose Laplace posterior is nearly exact there: means within a standard deviation, widths within a fifth."""
    model = LaneCourses()
    evidence = model.prepare(true_routes(small_scene()))
    near = least_squares.run(model, evidence, seed=0)
    knobs: dict[str, Any] = {"estimator": "reparameterised", "num_steps": 60, "num_samples": 16, "num_snapshots": 0}
    posterior = bbvi.run(model, evidence, seed=0, **knobs)
    for site, draws in near.draws.items():
        if draws.size:
            assert np.abs((posterior.mean(site) - near.mean(site)) / near.sd(site)).max() < 1.0
            assert np.median(posterior.sd(site) / near.sd(site)) == pytest.approx(1.0, abs=0.2)
