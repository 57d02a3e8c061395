"""Factors of a program: what engines that evaluate batches see."""

from __future__ import annotations

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

from inference.factors import factored
from models.program import InputError, fix, simulate
from models.toys.gaussian import ConjugateGaussian, Readings
from models.toys.slot_road import Markings, SlotRoad
from models.whitening import bind

MODEL = ConjugateGaussian()
BLANK = Readings(torch.linspace(-1.0, 1.0, 20, dtype=torch.float64), None)
EVIDENCE = BLANK._replace(y=simulate(MODEL, BLANK, num=1, seed=3)["y"][0])
X = np.random.default_rng(0).standard_normal((5, 2))


def test_factors_and_prior_are_the_bound_density() -> None:
    height = factored(MODEL, EVIDENCE).evaluate(X).sum(-1) - 0.5 * (X**2 + np.log(2 * np.pi)).sum(-1)
    assert height == pytest.approx(bind(MODEL, EVIDENCE).log_density(torch.from_numpy(X)).numpy(), rel=1e-12)


def test_gradient_is_that_of_the_factors_at_every_point() -> None:
    factors, eps = factored(MODEL, EVIDENCE), 1e-6
    for moved in (0.0, 1.0):
        x = X + moved
        value, slope = factors.gradient(x)
        assert value == pytest.approx(factors.evaluate(x).sum(-1), rel=1e-12)
        for d in range(2):
            step = eps * np.eye(2)[d]
            apart = factors.evaluate(x + step).sum(-1) - factors.evaluate(x - step).sum(-1)
            assert slope[:, d] == pytest.approx(apart / (2 * eps), rel=1e-6)


def test_a_program_that_observes_nothing_is_its_prior() -> None:
    factors = factored(lambda _: pyro.sample("a", dist.Normal(torch.zeros(2), 3.0).to_event(1)), None)
    assert factors.evaluate(X).shape == (5, 0)
    height, slope = factors.gradient(X)
    assert np.array_equal(height, np.zeros(5)) and np.array_equal(slope, np.zeros((5, 2)))
    assert factors.latents(X)["a"] == pytest.approx(3.0 * X)


class Threshold(dist.TorchDistribution):
    """log p = -max(a - 0.4, 0)^2, by numpy: flat below, and closed to torch."""

    support, arg_constraints, has_rsample = dist.constraints.real, {}, False

    def __init__(self, a: torch.Tensor) -> None:
        self.a = a
        super().__init__(a.shape)

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(-np.square(np.maximum(self.a.detach().numpy() - 0.4, 0.0)))


def test_a_density_closed_to_torch_has_its_gradient_past_where_it_is_flat() -> None:
    def program(_: None) -> None:
        a = pyro.sample("a", dist.Normal(0.0, 1.0))
        pyro.sample("y", Threshold(a), obs=torch.tensor(0.0))

    x = np.array([[1.5], [0.2]])
    _, slope = factored(program, None).gradient(x)
    assert slope == pytest.approx(np.array([[-2.2], [0.0]]), abs=1e-6)


def test_latents_and_whiten_are_inverse() -> None:
    factors = factored(MODEL, EVIDENCE)
    beta = factors.latents(X)["beta"]
    assert beta == pytest.approx(X * np.array(MODEL.prior_std), rel=1e-12)
    assert factors.whiten({"beta": beta[3]}) == pytest.approx(X[3], rel=1e-12)


def test_a_lone_scalar_has_the_shape_of_its_site() -> None:
    readings = fix(SlotRoad(max_knots=1), num_knots=0, psi0=0.0, kappa0=0.0, knot=torch.ones(1), rate=torch.ones(1))
    s = torch.linspace(0.0, 50.0, 4, dtype=torch.float64)
    assert factored(readings, Markings(s, torch.zeros(4, dtype=torch.float64))).latents(np.zeros(1))["d0"].shape == ()


def test_discrete_latents_are_refused_by_name() -> None:
    s = torch.linspace(0.0, 50.0, 4, dtype=torch.float64)
    with pytest.raises(InputError, match="num_knots"):
        factored(SlotRoad(), Markings(s, torch.zeros(4, dtype=torch.float64)))
