"""The program reader: densities, whitening, freezing, simulation, and refusals by name."""

from __future__ import annotations

import math
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from torch import Tensor

from models.program import (
    InputError,
    check,
    fix,
    log_joint,
    observe,
    quiet_doubles,
    simulate,
    terms,
    total,
)
from models.toys.gaussian import ConjugateGaussian, Readings
from models.toys.slot_road import Markings, SlotRoad
from models.whitening import bind, residuals

COVARIANCE = torch.tensor([[2.0, 0.6], [0.6, 0.5]], dtype=torch.float64)


class Observed(NamedTuple):
    """y  (3,) readings in a plate; None simulates."""

    y: Tensor | None


SEEN = Observed(torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64))


def zoo(evidence: Observed) -> None:
    """Every prior that can be whitened, a scale that depends on another latent, and a plate."""
    scale = pyro.sample("scale", dist.LogNormal(0.2, 0.5))
    low = pyro.sample("low", dist.Uniform(-1.0, 4.0))
    pair = pyro.sample("pair", dist.MultivariateNormal(torch.tensor([1.0, -1.0]), COVARIANCE))
    level = pyro.sample("level", dist.Normal(low, scale))
    with pyro.plate("readings", 3):
        local = pyro.sample("local", dist.Normal(level, 2.0))
        pyro.sample("y", dist.Normal(local + pair[..., 0], 0.5), obs=evidence.y)


def test_whitening_returns_the_latents_it_came_from() -> None:
    bound = bind(zoo, SEEN)
    x = torch.randn(20, bound.size, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(bound.whiten(bound.latents(x)), x, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(bound.whiten(bound.latents(x[0])), x[0], atol=1e-9, rtol=1e-9)


def test_whitened_density_is_the_log_joint_plus_the_log_jacobian() -> None:
    bound = bind(zoo, SEEN)
    x = torch.randn(bound.size, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def flat(at: Tensor) -> Tensor:
        return torch.cat([value.reshape(-1) for value in bound.latents(at).values()])

    jacobian = torch.linalg.slogdet(torch.func.jacfwd(flat)(x)).logabsdet
    torch.testing.assert_close(bound.log_density(x), log_joint(zoo, bound.latents(x), SEEN) + jacobian)


def test_batched_density_equals_one_at_a_time() -> None:
    bound = bind(zoo, SEEN)
    x = torch.randn(5, bound.size, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    batched = bound.log_density(x)
    assert batched.shape == (5,)
    torch.testing.assert_close(batched, torch.stack([bound.log_density(row) for row in x]))


def test_half_the_squared_residuals_is_the_log_density_up_to_a_constant() -> None:
    bound = bind(zoo, SEEN)
    x = torch.randn(6, bound.size, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    cost = torch.stack([0.5 * sum(part.square().sum() for part in bound.residuals(row)) for row in x])
    height = cost + bound.log_density(x)
    torch.testing.assert_close(height, height[:1].expand(6))


@pytest.mark.parametrize("model", [zoo, ConjugateGaussian(), SlotRoad()])
def test_log_joint_equals_pyro(model) -> None:
    blank = {
        ConjugateGaussian: Readings(torch.arange(4.0, dtype=torch.float64), None),
        SlotRoad: Markings(torch.arange(4.0, dtype=torch.float64), None),
    }.get(type(model), Observed(None))
    evidence, latents = observe(blank, {n: v[0] for n, v in simulate(model, blank, num=1, seed=5).items()})
    if model is zoo:  # the batch dimension left of the plate
        latents |= {"local": latents["local"].reshape(3)}
        latents |= {name: latents[name].reshape(()) for name in ("scale", "low", "level")}
        latents |= {"pair": latents["pair"].reshape(2)}
        evidence = Observed(evidence.y.reshape(3))
    with quiet_doubles():
        pyro_sum = poutine.trace(poutine.condition(model, data=latents)).get_trace(evidence).log_prob_sum()
    torch.testing.assert_close(log_joint(model, latents, evidence), pyro_sum)


def test_terms_split_prior_from_likelihood() -> None:
    latents = bind(zoo, SEEN).latents(torch.zeros(8, dtype=torch.float64))
    split = terms(zoo, latents, SEEN)
    assert set(split.prior) == {"scale", "low", "pair", "level", "local"}
    assert set(split.likelihood) == {"y"}
    torch.testing.assert_close(total(split.prior) + total(split.likelihood), log_joint(zoo, latents, SEEN))


def test_masked_readings_leave_the_density_and_the_residuals() -> None:
    mask = torch.tensor([True, False, True])

    def masked(evidence: Observed) -> None:
        level = pyro.sample("level", dist.Normal(0.0, 1.0))
        pyro.sample(
            "y", dist.Normal(level[..., None].expand(*level.shape, 3), 0.5).mask(mask).to_event(1), obs=evidence.y
        )

    def kept(evidence: Observed) -> None:
        level = pyro.sample("level", dist.Normal(0.0, 1.0))
        pyro.sample("y", dist.Normal(level[..., None].expand(*level.shape, 2), 0.5).to_event(1), obs=evidence.y)

    x = torch.tensor([0.7], dtype=torch.float64)
    part = Observed(SEEN.y[mask])
    torch.testing.assert_close(bind(masked, SEEN).log_density(x), bind(kept, part).log_density(x))
    residual = bind(masked, SEEN).residuals(x)[1]
    assert residual[1] == 0.0
    torch.testing.assert_close(residual[mask], bind(kept, part).residuals(x)[1])


def test_a_masked_plate_and_a_scaled_one_carry_over_to_the_residuals() -> None:
    """A scale of 4 counts every reading four times: residuals double."""
    mask = torch.tensor([True, False, True])

    def scaled(evidence: Observed) -> None:
        level = pyro.sample("level", dist.Normal(0.0, 1.0))
        with poutine.scale(scale=4.0), pyro.plate("readings", 3), poutine.mask(mask=mask):
            pyro.sample("y", dist.Normal(level, 0.5), obs=evidence.y)

    bound = bind(scaled, SEEN)
    x = torch.tensor([[0.7], [-0.4]], dtype=torch.float64)
    residual = bound.residuals(x[0])[1]
    torch.testing.assert_close(residual, 2.0 * torch.where(mask, (SEEN.y - 0.7) / 0.5, 0.0))
    costs = torch.stack([0.5 * sum(part.square().sum() for part in bound.residuals(row)) for row in x])
    gap = bound.log_density(x[0]) - bound.log_density(x[1])
    torch.testing.assert_close(gap, costs[1] - costs[0])


def test_fixing_a_site_freezes_it_and_keeps_its_prior_density() -> None:
    road, evidence = SlotRoad(), Markings(torch.arange(5.0, dtype=torch.float64), torch.zeros(5, dtype=torch.float64))
    latents = observe(evidence, simulate(road, evidence, num=3, seed=0))[1]
    latents["num_knots"] = torch.full((3,), 2)
    rest = {name: value for name, value in latents.items() if name != "num_knots"}
    frozen = fix(road, num_knots=2)
    torch.testing.assert_close(log_joint(frozen, rest, evidence), log_joint(road, latents, evidence))
    assert set(bind(frozen, evidence).shapes) == {"d0", "psi0", "kappa0", "knot", "rate"}
    assert "num_knots" not in simulate(frozen, evidence, num=2, seed=0)


def chain(evidence: Observed) -> None:
    """`x` depends on `mu`, `kind` on nothing."""
    mu = pyro.sample("mu", dist.Normal(0.0, 1.0))
    x = pyro.sample("x", dist.Normal(mu, 0.1))
    kind = pyro.sample("kind", dist.Categorical(torch.tensor([0.2, 0.8])))
    pyro.sample("y", dist.Normal((x + kind)[..., None].expand(*x.shape, 3), 0.5).to_event(1), obs=evidence.y)


def test_a_frozen_site_counts_given_the_latents() -> None:
    """Linear and Gaussian, so that the Jacobian of the whitening is a constant: here one."""
    frozen = fix(chain, x=3.0, kind=1)
    bound = bind(frozen, SEEN)
    x = torch.tensor([[-1.0], [0.5], [2.9]], dtype=torch.float64)
    torch.testing.assert_close(bound.log_density(x), log_joint(frozen, bound.latents(x), SEEN))
    bound.check_residuals()
    for costs in (
        torch.stack([0.5 * sum(part.square().sum() for part in bound.residuals(row)) for row in x]),
        torch.stack(
            [0.5 * sum(p.square().sum() for p in residuals(frozen, {"mu": row[0]}, SEEN).values()) for row in x]
        ),
    ):
        height = costs + bound.log_density(x)
        torch.testing.assert_close(height, height[:1].expand(3))


def test_frozen_sites_that_are_not_gaussian_are_skipped_unless_they_depend_on_latents() -> None:
    frozen = fix(chain, x=3.0, kind=1)
    assert bind(frozen, SEEN).settled == {"kind"}
    assert set(residuals(frozen, {"mu": torch.tensor(0.1)}, SEEN)) == {"mu", "x", "y"}

    def labelled(evidence: Observed) -> None:
        mu = pyro.sample("mu", dist.Normal(0.0, 1.0))
        pyro.sample("label", dist.Bernoulli(logits=mu))
        pyro.sample("y", dist.Normal(mu[..., None].expand(*mu.shape, 3), 0.5).to_event(1), obs=evidence.y)

    with pytest.raises(InputError, match="fixed 'label' is Bernoulli and depends on latents"):
        bind(fix(labelled, label=1.0), SEEN).check_residuals()
    with pytest.raises(InputError, match="fixed 'label' is Bernoulli and depends on latents"):
        residuals(fix(labelled, label=1.0), {"mu": torch.tensor(0.1)}, SEEN)


def test_a_fixed_value_keeps_its_digits_and_an_integer_stands_for_a_real() -> None:
    latents = {"mu": torch.tensor(0.1, dtype=torch.float64)}
    as_integer, as_real = (log_joint(fix(chain, x=x, kind=1), latents, SEEN) for x in (3, 3.0))
    torch.testing.assert_close(as_integer, as_real, atol=0, rtol=0)
    assert float(fix(chain, x=0.1).values["x"]) == 0.1


def test_fixing_what_is_no_latent_is_refused_by_name() -> None:
    road, evidence = SlotRoad(), Markings(torch.arange(5.0), torch.zeros(5))
    with pytest.raises(InputError, match=r"\['num_knot'\], but the program has no site of that name"):
        bind(fix(road, num_knot=2, knot=torch.full((4,), 10.0)), evidence)
    with pytest.raises(InputError, match="'d' is observed"):
        simulate(fix(road, d=torch.ones(5)), evidence, num=1, seed=0)
    unseen = evidence._replace(d=None)
    assert "d" not in simulate(fix(road, d=torch.ones(5)), unseen, num=1, seed=0)


@pytest.mark.parametrize(
    ("weigh", "word"),
    [
        (lambda: poutine.scale(scale=2.0), "scale"),
        (lambda: poutine.scale(scale=torch.tensor(0.5)), "scale"),
        (lambda: poutine.mask(mask=torch.tensor(False)), "mask"),
    ],
)
def test_a_scale_or_a_mask_on_a_latent_is_refused_by_name(weigh, word: str) -> None:
    def weighted(evidence: Observed) -> None:
        with weigh():
            level = pyro.sample("level", dist.Normal(0.0, 1.0))
        pyro.sample("y", dist.Normal(level[..., None].expand(*level.shape, 3), 0.5).to_event(1), obs=evidence.y)

    with pytest.raises(InputError, match=f"'level' is under a {word}"):
        bind(weighted, SEEN)


def test_a_masked_distribution_of_a_latent_is_refused_by_name() -> None:
    def masked(evidence: Observed) -> None:
        pyro.sample("pair", dist.Normal(torch.zeros(2), 1.0).mask(torch.tensor([True, False])).to_event(1))

    with pytest.raises(InputError, match="'pair' is under a mask"):
        bind(masked, SEEN)


def test_missing_and_unused_values_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="'low' has no value"):
        log_joint(zoo, {"scale": torch.tensor(1.0)}, SEEN)
    latents = bind(zoo, SEEN).latents(torch.zeros(8, dtype=torch.float64))
    with pytest.raises(InputError, match="stray"):
        log_joint(zoo, latents | {"stray": torch.tensor(0.0)}, SEEN)


def test_a_latent_that_cannot_be_whitened_is_refused_by_name() -> None:
    evidence = Markings(torch.arange(5.0, dtype=torch.float64), torch.zeros(5, dtype=torch.float64))
    with pytest.raises(InputError, match="'num_knots' is Categorical; fix"):
        bind(SlotRoad(), evidence)


def test_residuals_refuse_observations_that_are_not_gaussian() -> None:
    def heavy(evidence: Observed) -> None:
        level = pyro.sample("level", dist.Normal(0.0, 1.0))
        pyro.sample("y", dist.StudentT(4.0, level[..., None].expand(*level.shape, 3), 1.0).to_event(1), obs=evidence.y)

    with pytest.raises(InputError, match="'y' is StudentT"):
        bind(heavy, SEEN).check_residuals()
    with pytest.raises(InputError, match="'y' is StudentT"):
        residuals(heavy, {"level": torch.tensor(0.1)}, SEEN)


@pytest.mark.parametrize("detach", [False, True], ids=["by gradient", "by change"])
def test_residuals_refuse_a_scale_that_depends_on_latents(detach: bool) -> None:
    def loose(evidence: Observed) -> None:
        scale = pyro.sample("scale", dist.LogNormal(0.0, 1.0))
        scale = scale.detach() if detach else scale
        pyro.sample("y", dist.Normal(torch.zeros(3), scale[..., None]).to_event(1), obs=evidence.y)

    with pytest.raises(InputError, match="the scale of 'y' does"):
        bind(loose, SEEN).check_residuals()


def test_nan_raises_with_the_name_of_its_site() -> None:
    def root(evidence: Observed) -> None:
        level = pyro.sample("level", dist.Normal(0.0, 1.0))
        pyro.sample("y", dist.Normal(level.sqrt(), 1.0).expand([3]).to_event(1), obs=evidence.y)

    with pytest.raises(FloatingPointError, match="'y' is NaN"):
        log_joint(root, {"level": torch.tensor(-1.0)}, SEEN)


def test_a_value_outside_the_support_has_no_density() -> None:
    latents = bind(zoo, SEEN).latents(torch.zeros(8, dtype=torch.float64))
    with quiet_doubles():
        assert log_joint(zoo, latents | {"low": torch.tensor(4.5)}, SEEN) == -math.inf


def test_simulation_is_local_to_its_seed_and_leaves_global_randomness_alone() -> None:
    torch.manual_seed(7)
    before = torch.get_rng_state()
    first = simulate(SlotRoad(), Markings(torch.arange(5.0), None), num=4, seed=1)
    torch.testing.assert_close(torch.get_rng_state(), before)
    torch.manual_seed(8)
    again = simulate(SlotRoad(), Markings(torch.arange(5.0), None), num=4, seed=1)
    other = simulate(SlotRoad(), Markings(torch.arange(5.0), None), num=4, seed=2)
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["d0"], other["d0"])
    assert torch.get_default_dtype() == torch.float32


def test_threads_run_programs_as_one_thread_would() -> None:
    """Threads switch after every few instructions, so that runs overlap wherever they can."""
    blank = Markings(torch.arange(5.0, dtype=torch.float64), None)

    def height(seed: int) -> Tensor:
        evidence, latents = observe(blank, simulate(SlotRoad(), blank, num=3, seed=seed))
        return log_joint(SlotRoad(), latents, evidence)

    alone = [height(seed) for seed in range(24)]
    state, pause = torch.get_rng_state(), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            together = list(pool.map(height, range(24)))
    finally:
        sys.setswitchinterval(pause)
    assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.get_default_dtype() == torch.float32


def test_simulated_sites_have_the_moments_of_the_program() -> None:
    """Var y_n = scale^2 E + ...; checked on `level`: E = 1.5, Var = 25/12 + E[scale^2], in 4 standard errors."""
    num = 20000
    level = simulate(zoo, Observed(None), num=num, seed=3)["level"].reshape(-1)
    variance = 25 / 12 + math.exp(2 * 0.2 + 2 * 0.25)
    assert abs(float(level.mean()) - 1.5) < 4 * math.sqrt(variance / num)


def test_observing_moves_draws_into_the_evidence() -> None:
    draws = simulate(ConjugateGaussian(), Readings(torch.arange(3.0), None), num=1, seed=0)
    evidence, latents = observe(Readings(torch.arange(3.0), None), draws)
    assert evidence.y is draws["y"]
    assert set(latents) == {"beta"}


def test_observing_fills_only_what_is_missing() -> None:
    """A latent may share the name of a field that is given, such as a covariate."""
    times = torch.arange(3.0)
    evidence, latents = observe(Readings(times, None), {"t": torch.zeros(3), "y": torch.ones(3)})
    assert evidence.t is times
    assert set(latents) == {"t"}


def test_check_catches_a_missing_to_event() -> None:
    """Two readings: as many as the draws of the check, so that Pyro's own shapes agree by accident."""

    def undeclared(evidence: Observed) -> None:
        level = pyro.sample("level", dist.Normal(0.0, 1.0))
        pyro.sample("y", dist.Normal(level[..., None].expand(*level.shape, 2), 1.0), obs=evidence.y)

    with pytest.raises(InputError, match=r"'y' has shape \(2, 2\).*to_event"):
        check(undeclared, Observed(SEEN.y[:2]))


def test_check_catches_an_observation_outside_its_support() -> None:
    def positive(evidence: Observed) -> None:
        rate = pyro.sample("rate", dist.LogNormal(0.0, 1.0))
        pyro.sample("y", dist.Exponential(rate[..., None].expand(*rate.shape, 3)).to_event(1), obs=evidence.y)

    with pytest.raises(InputError, match="observation at site 'y' lies outside"):
        check(positive, SEEN)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_check_catches_an_observation_that_is_not_finite(value: float) -> None:
    readings = Readings(torch.arange(3.0), torch.tensor([0.0, value, 1.0]))
    with pytest.raises(InputError, match="'y' holds a value that is not finite"):
        check(ConjugateGaussian(), readings)
