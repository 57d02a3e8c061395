"""Engines agree on one night road: where it leads, how sure they are, and the evidence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from experiments.road_metrics import RANGES, TOLD, course_points, lateral_offsets
from experiments.scenarios.road import night_road
from inference import bbvi, importance, least_squares, nuts, smc
from inference.posterior import Posterior
from models.road.course import RoadCourse

MODEL = RoadCourse()
SCENE = night_road(3)
EVIDENCE = MODEL.prepare(SCENE.data)
REFERENCE = importance.run(MODEL, EVIDENCE, seed=0, transform="prior", num_draws=1000, num_rounds=24)
POINTS = course_points(REFERENCE.mean("course"))[np.isin(RANGES, TOLD)]


def told(posterior: Posterior) -> tuple[Any, Any]:
    """Mean and standard deviation (3,) of where the road is across the reference's at 40, 80 and 140 m [m]."""
    courses = posterior.draws["course"].reshape(-1, 6)
    apart, weights = lateral_offsets(courses, POINTS), posterior.weights.reshape(-1)
    mean = weights @ apart
    return mean, np.sqrt(weights @ (apart - mean) ** 2)


ENGINES: dict[str, tuple[Any, dict[str, Any], float]] = {  # engine, knobs, draws that it is worth at least
    "importance": (importance, {"num_draws": 1000, "num_rounds": 4}, 1500.0),
    "smc": (smc, {"num_particles": 2000, "num_moves": 20}, 300.0),
    "bbvi, weighted": (bbvi, {"num_draws": 4000, "weighted": True, "num_snapshots": 0}, 1000.0),
    "nuts": (nuts, {"num_chains": 1, "num_draws": 400, "warmup": 200, "transform": "laplace"}, 60.0),
}


@pytest.mark.parametrize("name", ENGINES)
def test_engines_agree_on_a_road(name: str) -> None:
    """Means within 4 standard errors of so many independent draws; standard deviations within 4 / sqrt(2 n)."""
    engine, knobs, worth = ENGINES[name]
    posterior = engine.run(MODEL, EVIDENCE, seed=1, **knobs)
    (mean, std), (expected, spread) = told(posterior), told(REFERENCE)
    num = 1.0 / (1.0 / worth + 1.0 / REFERENCE.info["ess"])
    assert np.all(np.abs(mean - expected) < 4.0 * spread / math.sqrt(num)), (mean - expected) / spread
    assert np.all(np.abs(std / spread - 1.0) < 4.0 / math.sqrt(2.0 * num)), std / spread
    if posterior.log_evidence is not None:
        error = math.hypot(posterior.info.get("log_evidence_error", 0.05), REFERENCE.info["log_evidence_error"])
        assert posterior.log_evidence == pytest.approx(REFERENCE.log_evidence, abs=4.0 * error)


def test_a_laplace_fit_is_near() -> None:
    """It is no sample of the posterior: means within half a standard deviation, widths within a quarter."""
    mean, std = told(least_squares.run(MODEL, EVIDENCE, seed=1, num_draws=4000))
    expected, spread = told(REFERENCE)
    assert np.all(np.abs(mean - expected) < 0.5 * spread)
    assert np.all(np.abs(std / spread - 1.0) < 0.25)


def test_no_start_of_many_ends_in_a_better_mode() -> None:
    """Least squares from the model's start, and from 8 draws of the prior: 12 roads with 10 % clutter."""
    for seed in range(4000, 4012):
        evidence = MODEL.prepare(night_road(seed, clutter=0.1).data)
        own = least_squares.run(MODEL, evidence, seed=0, num_draws=1).info["cost"]
        factors = MODEL.factors(evidence)
        for x in np.random.default_rng(seed).standard_normal((8, factors.depends.shape[1])):
            init = factors.latents(x)
            other = least_squares.run(MODEL, evidence, seed=0, num_draws=1, init=init).info["cost"]
            assert own < other + 0.5
