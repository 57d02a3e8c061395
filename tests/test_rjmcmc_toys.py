"""Reversible jump on the slot road: prior recovery, exact model probabilities, calibration, and
mutations: every term of the acceptance ratio that is taken away makes a named check fail."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from inference import calibration, diagnostics, rjmcmc
from inference.posterior import Posterior
from models.capability import Move, Proposal
from models.program import InputError, Latents, fix, quiet_doubles, simulate
from models.toys.slot_road import Markings, SlotRoad, offset

# Noise of the size of the offsets leaves every move a fair chance, so that errors show within seconds.
ROAD = SlotRoad(max_knots=2, length=20.0, noise_std=1.0)
BLANK = Markings(torch.linspace(0.0, 20.0, 8, dtype=torch.float64), None)
FUNCTIONALS: dict[str, calibration.Functional] = {
    "num_knots": lambda z: z["num_knots"],
    "d0^2": lambda z: z["d0"] ** 2,
    "knot": lambda z: z["knot"][:, 0],
    "log|rate|": lambda z: (z["rate"] ** 2).log().sum(-1),
    "active": lambda z: ((z["rate"] / ROAD.rate_std) ** 2 * (torch.arange(2) < z["num_knots"][:, None])).sum(-1),
}


def transition(model: Any, num_moves: int = 5) -> calibration.Transition:
    """Random moves of the model at temperature one, the same kinds for all chains."""
    moves = model.moves()

    def go(latents: Latents, evidence: Markings, seed: int) -> Latents:
        rng = np.random.default_rng(seed)
        state = rjmcmc.init(model, latents, evidence)
        size = len(state.log_prior)
        for kind in rng.choice(len(moves), num_moves, p=[move.probability for move in moves]):
            u = torch.from_numpy(rng.random((size, moves[kind].num_uniforms)))
            log_u = torch.from_numpy(np.log(rng.random(size)))
            state, _, _ = rjmcmc.step(model, moves[kind], state, evidence, u, log_u, rjmcmc.RULES["exact"], 1.0)
        return state.latents

    return go


def joint_test(model: Any = ROAD) -> dict[str, float]:
    return calibration.geweke(model, BLANK, transition(model), FUNCTIONALS, num=2000, num_steps=60, seed=1)


def test_joint_test_passes() -> None:
    """Six standard normal z-scores: one in two thousand such sets exceeds 4 (the seed is fixed)."""
    scores = joint_test()
    assert max(map(abs, scores.values())) < 4.0, scores


Rule = Callable[..., Tensor]
EXACT: Rule = rjmcmc.log_acceptance


def without(**factors: float) -> Rule:
    """The exact rule with some of its terms multiplied by a factor: 0 drops, -1 reverses."""
    names = ("prior", "likelihood", "forward", "backward", "jacobian")

    def rule(kind: int, temperature: float, *parts: Tensor) -> Tensor:
        return EXACT(kind, temperature, *(factors.get(n, 1.0) * part for n, part in zip(names, parts, strict=True)))

    return rule


MUTATIONS: dict[str, tuple[Rule, str]] = {  # what is changed, and the functional that must show it
    "log_forward dropped": (without(forward=0.0), "num_knots"),
    "log_backward dropped": (without(backward=0.0), "active"),
    "log_jacobian dropped": (without(jacobian=0.0), "log|rate|"),
    "log_jacobian reversed": (without(jacobian=-1.0), "log|rate|"),
    "prior ratio dropped": (without(prior=0.0), "num_knots"),
    "likelihood ratio dropped": (without(likelihood=0.0), "log_joint"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_joint_test_notices(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rule, witness = MUTATIONS[name]
    monkeypatch.setattr(rjmcmc, "log_acceptance", rule)
    scores = joint_test()
    assert abs(scores[witness]) > 5.0, scores


@dataclass(frozen=True)
class Classical(SlotRoad):
    """Inactive slots forgotten: terms as if births and deaths had no pseudo-prior to swap with."""

    def _birth_death(self, z: Latents, u: Tensor) -> Proposal:
        proposal = super()._birth_death(z, u)
        birth = proposal.latents["num_knots"] > z["num_knots"]
        return proposal._replace(
            log_forward=torch.where(birth, proposal.log_forward, 0.0),
            log_backward=torch.where(birth, 0.0, proposal.log_backward),
        )


@dataclass(frozen=True)
class Unequal(SlotRoad):
    """Births four times as often as deaths, but reported as equally often."""

    def moves(self) -> tuple[Move, ...]:
        *others, birth_death = super().moves()

        def skew(z: Latents, u: Tensor) -> Proposal:
            first = torch.where(u[:, 0] < 0.8, u[:, 0] / 1.6, 0.5 + (u[:, 0] - 0.8) / 0.4)
            return birth_death.propose(z, torch.cat([first[:, None], u[:, 1:]], 1))

        return (*others, birth_death._replace(propose=skew))


@pytest.mark.parametrize("mutant", [Classical, Unequal], ids=["pseudo-prior swap dropped", "unequal births"])
def test_joint_test_notices_moves_that_misreport(mutant: type[SlotRoad]) -> None:
    scores = joint_test(mutant(max_knots=2, length=20.0, noise_std=1.0))
    assert abs(scores["num_knots"]) > 5.0, scores


def test_number_of_knots_follows_its_prior_when_data_say_nothing() -> None:
    """Chains are independent given the kinds of moves: the spread of their means gives the standard
    error. All start without knots, so the prior is found, not kept. Four standard errors."""
    model = SlotRoad(noise_std=1e6)
    evidence = Markings(BLANK.s, torch.zeros(8, dtype=torch.float64))
    first = {n: v[0] for n, v in simulate(fix(model, num_knots=0), evidence, num=1, seed=0).items()}
    first["num_knots"] = torch.tensor(0)
    posterior = rjmcmc.run(model, evidence, seed=2, init=first, num_chains=400, num_steps=800, warmup=200)
    with quiet_doubles():
        exact = torch.softmax(dist.Poisson(model.knots_mean).log_prob(torch.arange(5.0)), 0).tolist()
    for count, probability in enumerate(exact):
        share = (posterior.model_index == count).mean(1)
        assert abs(share.mean() - probability) < 4 * share.std(ddof=1) / math.sqrt(400), (count, share.mean())


def exact_probabilities(model: SlotRoad, evidence: Markings, num_nodes: int) -> np.ndarray:
    """p(num_knots | d) for two slots: Gaussian evidence given the knots, Gauss-Legendre over their positions."""
    nodes, shares = np.polynomial.legendre.leggauss(num_nodes)
    place = torch.from_numpy(0.5 * model.length * (nodes + 1.0))
    share = torch.from_numpy(0.5 * shares).log()
    base = torch.tensor([model.offset_std, model.angle_std, model.curvature_std], dtype=torch.float64)

    def log_evidence(knots: Tensor) -> Tensor:
        """log p(d | knots), knots (B, k): the rates and the base are integrated out."""
        size = knots.shape[1]
        std = torch.cat([base, torch.full((size,), model.rate_std, dtype=torch.float64)])
        unit = torch.eye(3 + size, dtype=torch.float64)
        columns = [
            offset(evidence.s, *(row[i].expand(len(knots)) for i in range(3)), knots, row[3:].expand(len(knots), size))
            for row in unit
        ]
        design = torch.stack(columns, -1) * std  # (B, N, 3 + k)
        spread = design @ design.mT + model.noise_std**2 * torch.eye(len(evidence.s), dtype=torch.float64)
        zero = torch.zeros(len(evidence.s), dtype=torch.float64)
        return dist.MultivariateNormal(zero, spread).log_prob(evidence.d)

    none = log_evidence(place.new_zeros(1, 0))[0]
    one = (log_evidence(place[:, None]) + share).logsumexp(0)
    both = torch.cartesian_prod(place, place)
    two = (log_evidence(both) + (share[:, None] + share).reshape(-1)).logsumexp(0)
    with quiet_doubles():
        prior = dist.Poisson(model.knots_mean).log_prob(torch.arange(3.0))
    return torch.softmax(torch.stack([none, one, two]) + prior, 0).numpy()


def enumerable() -> tuple[SlotRoad, Markings]:
    """A road on which no number of knots is certain, nor as probable as before."""
    model = SlotRoad(max_knots=2, length=30.0, rate_std=2e-3, noise_std=1.5)
    blank = Markings(torch.linspace(0.0, 30.0, 10, dtype=torch.float64), None)
    truth = fix(model, num_knots=1, knot=torch.full((2,), 10.0, dtype=torch.float64))
    return model, blank._replace(d=simulate(truth, blank, num=1, seed=1)["d"][0])


def test_model_probabilities_match_quadrature() -> None:
    """Within 3 standard errors, from the spread between independent chains; the prior is more than ten of them away."""
    model, evidence = enumerable()
    exact = exact_probabilities(model, evidence, 40)
    np.testing.assert_allclose(exact, exact_probabilities(model, evidence, 60), atol=1e-5)
    posterior = rjmcmc.run(
        model, evidence, seed=3, num_chains=200, num_steps=4000, warmup=2500, start_temperature=100.0, thin=5
    )
    for count in range(3):
        share = (posterior.model_index == count).mean(1)
        error = share.std(ddof=1) / math.sqrt(len(share))
        assert error < 0.01
        assert abs(share.mean() - exact[count]) < 3 * error, (count, share.mean(), exact[count], error)


def batched_engine(num_steps: int, warmup: int, thin: int) -> calibration.Engine:
    """One chain for each scene of a batch."""

    def engine(model: Any, evidence: Markings, seed: int) -> Posterior:
        return rjmcmc.run(
            model, evidence, seed=seed, num_chains=len(evidence.d), num_steps=num_steps, warmup=warmup, thin=thin
        )

    return engine


@pytest.mark.parametrize(
    ("num", "num_steps"), [(300, 2000), pytest.param(2000, 10000, marks=pytest.mark.slow)], ids=["short", "long"]
)
def test_ranks_of_the_truth_are_uniform(num: int, num_steps: int) -> None:
    """Simulation-based calibration; p below 1e-4 in one of six functionals has odds of 1 in 1700."""
    engine = batched_engine(num_steps, warmup=num_steps // 3, thin=10)
    found = calibration.ranks(ROAD, BLANK, engine, FUNCTIONALS, num=num, num_draws=19, seed=4, batched=True)
    assert min(found.p_values().values()) > 1e-4, found.p_values()


@pytest.mark.parametrize(
    ("name", "witness"), [("log_backward dropped", "log|rate|"), ("likelihood ratio dropped", "log_joint")]
)
def test_ranks_notice(name: str, witness: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ranks are a blunter tool than the joint test: a dropped Jacobian stays below their noise here."""
    monkeypatch.setattr(rjmcmc, "log_acceptance", MUTATIONS[name][0])
    engine = batched_engine(1500, warmup=500, thin=10)
    found = calibration.ranks(ROAD, BLANK, engine, FUNCTIONALS, num=200, num_draws=19, seed=4, batched=True)
    assert found.p_values()[witness] < 1e-6, found.p_values()


def test_same_seed_same_bits() -> None:
    model, evidence = enumerable()
    first, again, other = (
        rjmcmc.run(model, evidence, seed=seed, num_chains=3, num_steps=60, warmup=10) for seed in (1, 1, 2)
    )
    for site in first.draws:
        np.testing.assert_array_equal(first.draws[site], again.draws[site])
    assert not np.array_equal(first.draws["d0"], other.draws["d0"])


def test_draws_are_laid_out_as_the_posterior_says() -> None:
    model, evidence = enumerable()
    posterior = rjmcmc.run(model, evidence, seed=1, num_chains=3, num_steps=60, warmup=10, thin=5)
    assert posterior.draws["knot"].shape == (3, 10, 2)
    assert posterior.draws["d0"].dtype == np.float64
    np.testing.assert_array_equal(posterior.model_index, posterior.draws["num_knots"])
    assert set(posterior.info["acceptance"]) <= {move.name for move in model.moves()}
    assert set(diagnostics.summary(posterior)) == {"num_knots", "d0", "psi0", "kappa0"}


BAD_KNOBS: dict[str, tuple[dict[str, Any], str]] = {
    "no chain": ({"num_chains": 0}, "^num_chains is 0; rjmcmc needs 1 or more$"),
    "cold start": ({"start_temperature": 0.5}, "^start_temperature is 0.5; rjmcmc needs 1 or more$"),
    "long warm-up": ({"warmup": 60}, "^warmup is 60; choose 0 to the 50 of num_steps$"),
    "no start": ({"start": "data"}, r"use start=prior \(engine.start=prior on the command line\)$"),
}


@pytest.mark.parametrize("case", BAD_KNOBS)
def test_a_bad_knob_is_named_alone_with_its_value(case: str) -> None:
    knobs, message = BAD_KNOBS[case]
    with pytest.raises(InputError, match=message):
        rjmcmc.run(ROAD, BLANK, seed=0, **{"num_steps": 50, "warmup": 10} | knobs)
