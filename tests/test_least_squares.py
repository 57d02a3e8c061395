"""Least squares: exact where the model is linear and Gaussian, honest where it is not."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from inference import least_squares
from models.program import InputError, check, fix, observe, quiet_doubles, simulate
from models.toys.gaussian import ConjugateGaussian, Readings
from models.toys.slot_road import Markings, SlotRoad, offset
from models.whitening import bind


class Signal(NamedTuple):
    """y at t, both (N,)."""

    t: Tensor
    y: Tensor | None


T = torch.linspace(0.0, 6.0, 40, dtype=torch.float64)


def wave(evidence: Signal) -> None:
    """A sine of unknown frequency: many local minima, and a prior that knows roughly."""
    omega = pyro.sample("omega", dist.Normal(3.4, 0.5))
    pyro.sample("y", dist.Normal(torch.sin(omega[..., None] * evidence.t), 0.1).to_event(1), obs=evidence.y)


WAVE = Signal(T, torch.sin(3.7 * T))


def line() -> tuple[ConjugateGaussian, Readings]:
    model, blank = ConjugateGaussian(), Readings(torch.linspace(-1.0, 3.0, 20, dtype=torch.float64), None)
    return model, blank._replace(y=simulate(model, blank, num=1, seed=3)["y"][0])


def test_gaussian_posterior_is_exact() -> None:
    model, evidence = line()
    mean, covariance, log_evidence = model.exact(evidence)
    posterior = least_squares.run(model, evidence, seed=0)
    np.testing.assert_allclose(posterior.estimate["beta"], mean, atol=1e-8)
    assert posterior.log_evidence == pytest.approx(float(log_evidence), abs=1e-8)
    assert posterior.info["converged"] is True
    assert posterior.info["flags"] == []
    state = least_squares.linearise(bind(model, evidence), bind(model, evidence).whiten({"beta": mean}))
    std = torch.diag(torch.tensor(model.prior_std, dtype=torch.float64))
    found = std @ torch.cholesky_inverse(state.factor, upper=True) @ std
    np.testing.assert_allclose(found, covariance, atol=1e-8)


def test_draws_have_the_exact_mean_and_covariance() -> None:
    """Within 4 standard errors of 20000 independent draws: sd / sqrt(n), and c sqrt(2 / n) at most."""
    model, evidence = line()
    mean, covariance, _ = model.exact(evidence)
    draws = least_squares.run(model, evidence, seed=1, num_draws=20000).draws["beta"]
    assert draws.shape == (1, 20000, 2)
    assert draws.dtype == np.float64
    sd = covariance.diagonal().sqrt().numpy()
    assert np.all(np.abs(draws[0].mean(0) - mean.numpy()) < 4 * sd / math.sqrt(20000))
    assert np.all(np.abs(np.cov(draws[0].T) - covariance.numpy()) < 4 * np.outer(sd, sd) * math.sqrt(2 / 20000))


def test_road_with_its_knots_fixed_is_exact() -> None:
    """Given knots, offsets are linear in (d0, psi0, kappa0, rates): posterior and evidence in closed form."""
    road, blank = SlotRoad(), Markings(torch.linspace(0.0, 100.0, 30, dtype=torch.float64), None)
    knot = torch.tensor([20.0, 60.0, 5.0, 5.0], dtype=torch.float64)
    frozen = fix(road, num_knots=2, knot=knot)
    evidence = blank._replace(d=simulate(frozen, blank, num=1, seed=2)["d"][0])
    std = torch.tensor([road.offset_std, road.angle_std, road.curvature_std] + [road.rate_std] * 4).double()
    active = torch.tensor([1.0, 1.0, 0.0, 0.0])
    unit = torch.eye(7, dtype=torch.float64)
    with quiet_doubles():
        design = offset(blank.s, unit[:, 0], unit[:, 1], unit[:, 2], knot.expand(7, 4), unit[:, 3:] * active).T
    spread = design @ torch.diag(std**2) @ design.T + road.noise_std**2 * torch.eye(30)
    gain = torch.diag(std**2) @ design.T @ torch.linalg.inv(spread)
    posterior = least_squares.run(frozen, evidence, seed=0)
    found = np.concatenate([np.atleast_1d(posterior.estimate[n]) for n in ("d0", "psi0", "kappa0", "rate")])
    np.testing.assert_allclose(found / std.numpy(), (gain @ evidence.d / std).numpy(), atol=1e-8)
    exact = dist.MultivariateNormal(torch.zeros(30, dtype=torch.float64), spread).log_prob(evidence.d)
    truncated = dist.Poisson(road.knots_mean).log_prob(torch.arange(5.0)).log_softmax(0)
    fixed = float(truncated[2]) - 4 * math.log(road.length)  # the evidence is log p(d, num_knots, knot)
    assert posterior.log_evidence == pytest.approx(float(exact) + fixed, abs=1e-6)
    assert posterior.info["flags"] == []


def test_a_fixed_value_is_data_for_the_latents_above_it() -> None:
    """mu ~ N(0, 1), x ~ N(mu, 0.1) fixed at 3: mean 3 / (1 + 0.01), evidence N(3; 0, 1.01) N(y; 3, 0.5)."""

    def chain(evidence: Signal) -> None:
        mu = pyro.sample("mu", dist.Normal(0.0, 1.0))
        x = pyro.sample("x", dist.Normal(mu, 0.1))
        pyro.sample("y", dist.Normal(x[..., None], 0.5).to_event(1), obs=evidence.y)

    seen = Signal(T[:1], torch.tensor([2.5], dtype=torch.float64))
    posterior = least_squares.run(fix(chain, x=3), seen, seed=0)
    assert float(posterior.estimate["mu"]) == pytest.approx(3.0 / 1.01, abs=1e-8)
    exact = dist.Normal(0.0, math.sqrt(1.01)).log_prob(torch.tensor(3.0)) + dist.Normal(3.0, 0.5).log_prob(seen.y[0])
    assert posterior.log_evidence == pytest.approx(float(exact), abs=1e-6)


def test_continuation_escapes_a_local_minimum() -> None:
    stuck = least_squares.run(wave, WAVE, seed=0, init={"omega": torch.tensor(1.0)})
    found = least_squares.run(wave, WAVE, seed=0, init={"omega": torch.tensor(1.0)}, continuation=(30.0, 5.0, 1.0))
    assert abs(float(stuck.estimate["omega"]) - 3.7) > 0.5
    assert float(found.estimate["omega"]) == pytest.approx(3.7, abs=0.01)
    assert found.info["cost"] < stuck.info["cost"]


def test_accepted_steps_lower_the_cost_and_refused_ones_raise_the_damping() -> None:
    bound = bind(wave, WAVE)
    state, accepted, refused = least_squares.linearise(bound, torch.tensor([0.5], dtype=torch.float64)), 0, 0
    for _ in range(20):
        new, taken = least_squares.step(bound, state)
        if taken:
            assert new.cost < state.cost
        else:
            assert torch.equal(new.x, state.x)
            assert new.damping > state.damping
        state, accepted, refused = new, accepted + taken, refused + (not taken)
    assert accepted > 0
    assert refused > 0


def test_snapshots_climb() -> None:
    posterior = least_squares.run(wave, WAVE, seed=0, init={"omega": torch.tensor(3.4)})
    heights = posterior.snapshots.log_joint
    assert len(heights) == len(posterior.snapshots.step) == len(posterior.snapshots.states["omega"]) > 2
    assert np.all(np.diff(heights) > -1e-9)
    assert posterior.snapshots.states["omega"][0] == pytest.approx(3.4)


def test_too_few_steps_are_flagged_with_a_remedy() -> None:
    posterior = least_squares.run(wave, WAVE, seed=0, init={"omega": torch.tensor(3.4)}, num_steps=1)
    assert posterior.info["converged"] is False
    assert "not converged" in posterior.info["flags"][0]
    assert "raise num_steps" in posterior.info["flags"][0]


def test_residuals_with_a_kink_at_the_minimum_are_flagged() -> None:
    def kink(evidence: Signal) -> None:
        level = pyro.sample("level", dist.Normal(1.0, 1.0))
        pyro.sample("y", dist.Normal(level.abs()[..., None].expand(*level.shape, 1), 1e-3).to_event(1), obs=evidence.y)

    seen = Signal(T[:1], torch.tensor([-1.0], dtype=torch.float64))
    posterior = least_squares.run(kink, seen, seed=0, init={"level": torch.tensor(0.3)}, num_steps=200)
    assert "no step lowers the cost" in posterior.info["flags"][0]


def test_a_hessian_that_rounding_makes_singular_is_flagged() -> None:
    """Only the sum of two latents is seen, 1e13 times better than the prior knows it."""

    def pair(evidence: Signal) -> None:
        z = pyro.sample("z", dist.Normal(torch.zeros(2), 1.0).to_event(1))
        pyro.sample("y", dist.Normal(z.sum(-1, keepdim=True), 1e-13).to_event(1), obs=evidence.y)

    posterior = least_squares.run(pair, Signal(T[:1], torch.tensor([0.5], dtype=torch.float64)), seed=0)
    assert any("singular to rounding" in flag for flag in posterior.info["flags"])


def test_start_of_the_model_is_used_unless_init_is_given() -> None:
    class Started:
        def __call__(self, evidence: Signal) -> None:
            wave(evidence)

        def start(self, evidence: Signal) -> dict[str, Tensor]:
            return {"omega": torch.tensor(3.5)}

    first = lambda **init: least_squares.run(Started(), WAVE, seed=0, **init).snapshots.states["omega"][0]  # noqa: E731
    assert first() == pytest.approx(3.5)
    assert first(init={"omega": torch.tensor(3.0)}) == pytest.approx(3.0)


def test_plates_are_read_and_draws_keep_their_shape() -> None:
    """Three groups with means of their own around a common one; compared with the dense algebra."""

    def groups(evidence: Signal) -> None:
        common = pyro.sample("common", dist.Normal(0.0, 2.0))
        with pyro.plate("groups", 3):
            mean = pyro.sample("mean", dist.Normal(common, 1.0))
            pyro.sample("y", dist.Normal(mean, 0.5), obs=evidence.y)

    seen = Signal(T[:3], torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64))
    posterior = least_squares.run(groups, seen, seed=0, num_draws=7)
    assert posterior.draws["common"].shape == (1, 7)
    assert posterior.draws["mean"].shape == (1, 7, 3)
    spread = 4.0 + 1.25 * torch.eye(3, dtype=torch.float64)
    common = 4.0 * torch.ones(3, dtype=torch.float64) @ torch.linalg.solve(spread, seen.y)
    assert float(posterior.estimate["common"]) == pytest.approx(float(common), abs=1e-8)
    exact = dist.MultivariateNormal(torch.zeros(3, dtype=torch.float64), spread).log_prob(seen.y)
    assert posterior.log_evidence == pytest.approx(float(exact), abs=1e-8)


def test_a_named_computed_value_changes_nothing() -> None:
    def named(evidence: Signal) -> None:
        omega = pyro.sample("omega", dist.Normal(3.4, 0.5))
        pyro.deterministic("twice", 2.0 * omega)
        pyro.sample("y", dist.Normal(torch.sin(omega[..., None] * evidence.t), 0.1).to_event(1), obs=evidence.y)

    check(named, WAVE)
    with_name, without = (least_squares.run(model, WAVE, seed=0, num_draws=5) for model in (named, wave))
    assert set(with_name.draws) == {"omega"}
    np.testing.assert_array_equal(with_name.draws["omega"], without.draws["omega"])
    assert with_name.log_evidence == without.log_evidence


def test_same_seed_same_bits_and_other_seed_other_draws() -> None:
    model, evidence = line()
    a, b, c = (least_squares.run(model, evidence, seed=seed, num_draws=5).draws["beta"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


@pytest.mark.parametrize("continuation", [(), (5.0,), (1.0, 5.0, 1.0), (5.0, 5.0, 1.0)])
def test_continuation_that_does_not_fall_to_one_is_refused(continuation: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="end in 1"):
        least_squares.run(wave, WAVE, seed=0, continuation=continuation)


def test_discrete_latents_and_impossible_starts_are_refused_by_name() -> None:
    road = SlotRoad()
    evidence, latents = observe(
        Markings(T, None), {n: v[0] for n, v in simulate(road, Markings(T, None), num=1, seed=0).items()}
    )
    with pytest.raises(InputError, match="'num_knots' is Categorical; fix"):
        least_squares.run(road, evidence, seed=0)
    frozen = fix(road, num_knots=1)
    outside = latents | {"knot": torch.full((4,), 120.0, dtype=torch.float64)}
    with pytest.raises(InputError, match="init of 'knot'"):
        least_squares.run(frozen, evidence, seed=0, init=outside)
    with pytest.raises(InputError, match=r"no value for \['rate'\]"):
        least_squares.run(frozen, evidence, seed=0, init={n: v for n, v in latents.items() if n != "rate"})


def test_residuals_that_are_not_finite_raise_with_their_site() -> None:
    def root(evidence: Signal) -> None:
        level = pyro.sample("level", dist.Normal(-1.0, 1.0))
        pyro.sample("y", dist.Normal(level.sqrt()[..., None].expand(*level.shape, 1), 1.0).to_event(1), obs=evidence.y)

    with pytest.raises(FloatingPointError, match="'y'"):
        least_squares.run(root, Signal(T[:1], torch.ones(1, dtype=torch.float64)), seed=0)
