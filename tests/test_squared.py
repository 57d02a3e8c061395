"""A compiled sum of squares as a factor: lane courses under the engines that evaluate batches."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from inference import least_squares, nuts
from inference.factors import factored
from inference.squared import squared
from models.capability import HasFactors, Squares
from models.intersection.course_evidence import CourseEvidence
from models.intersection.courses import LaneCourses
from models.program import log_joint
from tests.small_lanes import small_scene, true_routes

MODEL = LaneCourses(heading_std=0.1)


@pytest.fixture(scope="module")
def evidence() -> CourseEvidence:
    return MODEL.prepare(true_routes(small_scene()))


def program(evidence: CourseEvidence, x: np.ndarray) -> np.ndarray:
    """log p(latents, y) + log |d latents / dx| by the program, (S,)."""
    latents = {n: torch.from_numpy(v) for n, v in factored(MODEL, evidence).latents(x).items()}
    return log_joint(MODEL, latents, evidence).numpy() + np.log(MODEL.squares(evidence).scale).sum()


def test_values_are_those_of_the_program_and_gradients_nearly(evidence: CourseEvidence) -> None:
    """Lane courses hold curvature and nodes fixed in their gradient: five per cent of the program's at most."""
    factors, eps = factored(MODEL, evidence), 1e-5
    assert not isinstance(MODEL, HasFactors)
    for seed in (0, 1):
        x = 0.3 * np.random.default_rng(seed).standard_normal((1, factors.depends.shape[1]))
        value, slope = factors.gradient(x)
        assert value == pytest.approx(factors.evaluate(x).sum(1), rel=1e-14)
        prior = -0.5 * (np.square(x) + math.log(2.0 * math.pi)).sum(1)
        assert value + prior == pytest.approx(program(evidence, x), rel=1e-10)
        steps = eps * np.eye(x.shape[1])
        apart = (program(evidence, x + steps) - program(evidence, x - steps)) / (2.0 * eps)
        assert np.linalg.norm(slope[0] - x[0] - apart) < 0.05 * np.linalg.norm(apart)


def test_values_and_gradients_of_a_line_are_exact() -> None:
    """y = J z with unit noise, in two blocks that share z_0: cost and slope in closed form."""
    rng = np.random.default_rng(0)
    design, y = rng.standard_normal((6, 3)), rng.standard_normal(6)
    design[:3, 2], design[3:, 1] = 0.0, 0.0
    blocks, loc, scale = np.array([[1, 0], [2, 0]]), np.array([1.0, -1.0, 0.5]), np.array([2.0, 0.5, 3.0])

    def evaluate(z: np.ndarray, hessian: np.ndarray, gradient: np.ndarray) -> float:
        residual = design @ z - y
        for part, slots, rows in zip(hessian, blocks, (design[:3], design[3:]), strict=True):
            part[:] = rows[:, slots].T @ rows[:, slots]
        gradient[:] = design.T @ residual
        return 0.5 * float(residual @ residual)

    factors = squared(Squares(loc, scale, {"z": slice(0, 3)}, {"z": (3,)}, evaluate, -7.0, blocks=blocks))
    x = rng.standard_normal((4, 3))
    gaps = (loc + scale * x) @ design.T - y
    value, slope = factors.gradient(x)
    assert value == pytest.approx(-7.0 - 0.5 * np.square(gaps).sum(1), rel=1e-12)
    assert slope == pytest.approx(-(gaps @ design) * scale, rel=1e-10)
    assert factors.latents(x)["z"] == pytest.approx(loc + scale * x)


def test_latents_and_whiten_are_inverse(evidence: CourseEvidence) -> None:
    factors = factored(MODEL, evidence)
    x = np.random.default_rng(0).standard_normal(factors.depends.shape[1])
    assert factors.whiten(factors.latents(x)) == pytest.approx(x, rel=1e-10)


def test_lane_courses_run_with_nuts(evidence: CourseEvidence) -> None:
    """A few draws about the Laplace fit, which is the best state that is known."""
    posterior = nuts.run(MODEL, evidence, seed=1, num_chains=1, num_draws=10, warmup=10, max_tree_depth=3)
    assert posterior.draws["centre"].shape == (1, 10, 2)
    assert posterior.snapshots is not None
    best = {n: torch.as_tensor(v) for n, v in posterior.estimate.items()}
    assert posterior.snapshots.log_joint[-1] == pytest.approx(float(log_joint(MODEL, best, evidence)), rel=1e-12)
    fit = least_squares.run(MODEL, evidence, seed=1, tolerance=0.02)
    assert fit.snapshots is not None
    assert posterior.snapshots.log_joint[-1] == pytest.approx(fit.snapshots.log_joint[-1], abs=1.0)
    assert not np.array_equal(posterior.draws["centre"][0, 0], posterior.draws["centre"][0, -1])
