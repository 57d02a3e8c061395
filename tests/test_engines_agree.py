"""Every engine on the conjugate Gaussian, whose posterior is known in closed form.

A new engine joins ENGINES. Tolerances come from the draws themselves: the standard error of a mean
from ArviZ, and that of a standard deviation from the mean of squared deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

from inference import bbvi, diagnostics, importance, least_squares, nuts, particle_filter, rjmcmc, smc
from inference.posterior import Posterior
from models.capability import State
from models.program import simulate
from models.toys.gaussian import ConjugateGaussian, Readings

MODEL = ConjugateGaussian(step=0.8)
NUM_PARTICLES = 200_000  # of the bootstrap filter: one in five hundred is where the data are
BLANK = Readings(torch.linspace(-1.0, 1.0, 20, dtype=torch.float64), None)
EVIDENCE = BLANK._replace(y=simulate(MODEL, BLANK, num=1, seed=3)["y"][0])


def even(posterior: Posterior) -> Posterior:
    """As many draws of equal weight as the weighted ones are worth."""
    draws = posterior.resample(int(posterior.info["ess"]), seed=0)
    return replace(posterior, draws={n: v[None] for n, v in draws.items()}, log_weights=None)


class OneFrame:
    """The same program as a sequential model that is seen once."""

    def initial(self, frame: Readings) -> State:
        prior = dist.Normal(torch.zeros(2), torch.tensor(MODEL.prior_std)).to_event(1)
        return {"beta": pyro.sample("beta", prior)}

    def transition(self, state: State, frame: Readings) -> State:
        raise AssertionError("there is one frame")

    def observe(self, state: State, frame: Readings) -> None:
        mean = state["beta"][..., :1] + state["beta"][..., 1:] * frame.t
        pyro.sample("y", dist.Normal(mean, MODEL.noise_std).to_event(1), obs=frame.y)


def filtered() -> Posterior:
    """Its draws are bootstrap particles, so many of them are the same: as many as their weights were worth."""
    found = particle_filter.run(OneFrame(), (EVIDENCE,), seed=1, num_particles=NUM_PARTICLES)
    assert found.snapshots is not None
    draws = {n: v[:, :: round(NUM_PARTICLES / found.info["ess"][0]), 0] for n, v in found.draws.items()}
    return replace(found, draws=draws, estimate={n: v[0] for n, v in found.estimate.items()})


ENGINES: dict[str, Callable[[], Posterior]] = {
    "bbvi": lambda: bbvi.run(MODEL, EVIDENCE, seed=1, estimator="reparameterised", num_draws=4000),
    "importance": lambda: even(importance.run(MODEL, EVIDENCE, seed=1, num_draws=500)),
    "least_squares": lambda: least_squares.run(MODEL, EVIDENCE, seed=1, num_draws=4000),
    "nuts": lambda: nuts.run(MODEL, EVIDENCE, seed=1, num_chains=2, num_draws=200, warmup=60),
    "particle_filter": filtered,
    "rjmcmc": lambda: rjmcmc.run(MODEL, EVIDENCE, seed=1, num_chains=20, num_steps=1500, warmup=300),
    "smc": lambda: smc.run(MODEL, EVIDENCE, seed=1),
}


@pytest.fixture(scope="module", params=ENGINES)
def posterior(request: pytest.FixtureRequest) -> Posterior:
    return ENGINES[request.param]()


@pytest.mark.parametrize("element", [0, 1])
def test_mean_and_sd_are_exact_within_four_standard_errors(posterior: Posterior, element: int) -> None:
    mean, covariance, _ = MODEL.exact(EVIDENCE)
    sd = float(covariance[element, element].sqrt())
    draws = posterior.draws["beta"][..., element]
    error = diagnostics.standard_error(draws)
    assert error < 0.1 * sd, "too few effective draws to test anything"
    assert abs(draws.mean() - float(mean[element])) < 4 * error
    squares = np.square(draws - float(mean[element]))
    assert abs(squares.mean() - sd**2) < 4 * diagnostics.standard_error(squares)


def test_correlation_is_exact_within_four_standard_errors(posterior: Posterior) -> None:
    mean, covariance, _ = MODEL.exact(EVIDENCE)
    gaps = posterior.draws["beta"] - mean.numpy()
    products = gaps[..., 0] * gaps[..., 1]
    assert abs(products.mean() - float(covariance[0, 1])) < 4 * diagnostics.standard_error(products)


def test_best_state_is_near_the_mode(posterior: Posterior) -> None:
    """The best of many draws lies within half a standard deviation of the mode."""
    mean, covariance, _ = MODEL.exact(EVIDENCE)
    gap = np.abs(posterior.estimate["beta"] - mean.numpy()) / covariance.diagonal().sqrt().numpy()
    assert gap.max() < 0.5


def test_posterior_tells_what_it_cost(posterior: Posterior) -> None:
    assert posterior.info["evaluations"] > 0
    assert posterior.info["seconds"] > 0
    assert posterior.snapshots is not None
    assert np.all(np.diff(posterior.snapshots.seconds) >= 0)
    wander = 0.01 if posterior.info.get("engine") == "bbvi" else 1e-9  # [nats]: the mean of q follows noisy gradients
    assert np.all(np.diff(posterior.snapshots.log_joint) > -wander)


def test_estimates_of_the_evidence_are_exact() -> None:
    _, _, log_evidence = MODEL.exact(EVIDENCE)
    assert ENGINES["least_squares"]().log_evidence == pytest.approx(float(log_evidence), abs=1e-8)
    found = ENGINES["bbvi"]()
    assert found.log_evidence == pytest.approx(float(log_evidence), abs=4 * found.info["elbo_error"])
    for name in ("importance", "particle_filter", "smc"):
        found = ENGINES[name]()
        assert found.log_evidence == pytest.approx(float(log_evidence), abs=4 * found.info["log_evidence_error"])
