"""No-U-Turn sampling of factors: its potential, exact answers, honest flags."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from inference import diagnostics, nuts
from inference.factors import factored
from inference.transform import Affine, target_of
from models.program import InputError
from tests.hierarchy import Hierarchy, readings
from tests.test_rjmcmc_toys import enumerable

MODEL = Hierarchy(num_groups=2)
EVIDENCE = readings(MODEL)


def test_the_potential_has_the_gradient_of_the_density_wherever_it_is_asked() -> None:
    affine = Affine(np.array([0.3, -0.2, 0.1, 0.5]), np.tril(0.2 * np.ones((4, 4))) + np.eye(4))
    potential, eps = nuts.Potential(target_of(factored(MODEL, EVIDENCE), affine)), 1e-6
    for seed in (0, 1):
        u = torch.from_numpy(np.random.default_rng(seed).standard_normal(4)).requires_grad_()
        height = potential({"u": u})
        (slope,) = torch.autograd.grad(height, u)
        for d in range(4):
            step = eps * torch.eye(4, dtype=torch.float64)[d]
            apart = potential({"u": u + step}) - potential({"u": u - step})
            assert slope[d].item() == pytest.approx(apart.item() / (2.0 * eps), rel=1e-6)
    assert potential.evaluations == 18


@pytest.mark.parametrize("transform", ["prior", "laplace"])
def test_means_and_deviations_of_a_hierarchy_are_exact(transform: Any) -> None:
    """Four standard errors of ArviZ, autocorrelation included; of the squares too."""
    posterior = nuts.run(MODEL, EVIDENCE, seed=1, transform=transform, num_chains=2, num_draws=60, warmup=40)
    mean, covariance, _ = MODEL.exact(EVIDENCE)
    scale = np.array([1.0, 1.0, MODEL.offset_std, MODEL.offset_std])
    draws = np.concatenate([posterior.draws["line"], posterior.draws["offset"]], -1) / scale
    for d in range(4):
        gap = draws[..., d] - mean[d]
        assert abs(gap.mean()) < 4.0 * diagnostics.standard_error(gap)
        squares = np.square(gap)
        assert abs(squares.mean() - covariance[d, d]) < 4.0 * diagnostics.standard_error(squares)
    assert max(row["r_hat"] for row in diagnostics.summary(posterior).values()) < 1.1
    assert posterior.info["divergences"] == 0
    assert posterior.info["flags"] == []


class Reading(NamedTuple):
    y: Tensor | None


def funnel(evidence: Reading) -> None:
    """Neal's funnel: where v is small, w has a neck that no step of the mouth fits into. w is written out of v's scale,
    so that whitening does not undo it."""
    v = pyro.sample("v", dist.Normal(0.0, 1.0))
    w = pyro.sample("w", dist.Normal(0.0, 1.0))
    pyro.sample("y", dist.Normal(w, (4.0 * v).exp()), obs=evidence.y)


def test_divergences_are_flagged() -> None:
    evidence = Reading(torch.tensor(0.0, dtype=torch.float64))
    posterior = nuts.run(funnel, evidence, seed=1, transform="prior", num_chains=1, num_draws=40, warmup=30)
    assert posterior.info["divergences"] > 0
    assert "diverged" in posterior.info["flags"][0]


def test_same_seed_same_bits_and_chains_differ() -> None:
    first, again = (nuts.run(MODEL, EVIDENCE, seed=3, num_chains=2, num_draws=8, warmup=8) for _ in range(2))
    np.testing.assert_array_equal(first.draws["line"], again.draws["line"])
    assert not np.array_equal(first.draws["line"][0], first.draws["line"][1])


def test_chains_that_begin_together_part() -> None:
    """Their random numbers are their own, not only where they begin."""
    posterior = nuts.run(MODEL, EVIDENCE, seed=3, num_chains=2, num_draws=8, warmup=8, spread=0.0)
    assert not np.array_equal(posterior.draws["line"][0], posterior.draws["line"][1])


def test_the_global_random_numbers_are_left_alone() -> None:
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    nuts.run(MODEL, EVIDENCE, seed=3, num_chains=1, num_draws=2, warmup=2)
    assert torch.equal(torch.rand(1), expected)


def test_discrete_latents_are_refused_by_name() -> None:
    model, evidence = enumerable()
    with pytest.raises(InputError, match="'num_knots' is Categorical; fix\\(\\) it first"):
        nuts.run(model, evidence, seed=1)


BAD_KNOBS: dict[str, tuple[dict[str, Any], str]] = {
    "chains": ({"num_chains": 0}, "^num_chains is 0; nuts needs 1 or more$"),
    "acceptance": ({"target_acceptance": 1.0}, "^target_acceptance is 1.0; choose a share between 0 and 1$"),
    "spread": ({"spread": -1.0}, "^spread is -1.0; choose 0 or more$"),
    "transform": ({"transform": "posterior"}, "^transform must be prior or laplace, but is 'posterior'$"),
}


@pytest.mark.parametrize("case", BAD_KNOBS)
def test_a_bad_knob_is_named_with_its_value(case: str) -> None:
    bad, sentence = BAD_KNOBS[case]
    with pytest.raises(InputError, match=sentence):
        nuts.run(MODEL, EVIDENCE, seed=1, **bad)
