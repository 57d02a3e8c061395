"""Without data, reversible jump on the intersection returns its prior; and the hard core of the angles is a density.

Chains start from prior draws, so that their states are prior draws at every step if and only if the moves leave the
prior invariant; means over independent chains against the prior give z-scores that need no autocorrelation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from inference import rjmcmc
from models.capability import Move, Proposal
from models.intersection.angles import MIN_SEPARATION, HardCoreAngles
from models.intersection.packing import MAX_ARMS, MIN_ARMS
from models.intersection.state import Junction
from models.program import Latents, quiet_doubles
from tests.small_junction import FULL, NO_BENDS, NOTHING, SETTINGS, states

Array = NDArray[Any]
MODELS = {
    "extended": FULL,
    "m20": Junction(**NO_BENDS, steps="m20"),
    "m20, two-way": replace(Junction(**NO_BENDS, steps="m20"), one_way=False),
}


def functionals(z: dict[str, Any]) -> dict[str, Array]:
    """{name: (...)} of latents {site: (..., *event)}: means over the active arms, and counts."""
    values = {n: np.asarray(v, dtype=np.float64) for n, v in z.items()}
    count = values["num_arms"]
    active = np.arange(MAX_ARMS) < count[..., None]
    mean = lambda x: (x * active).sum(-1) / count  # noqa: E731
    found = {f"P(K = {k})": count == k for k in range(MIN_ARMS, MAX_ARMS + 1)}
    found |= {"entries": mean(values["entries"]), "exits": mean(values["exits"])}
    found |= {"no entries": mean(values["entries"] == 0), "no exits": mean(values["exits"] == 0)}
    found |= {"six entries": mean(values["entries"] == 6), "lanes^2": mean((values["entries"] + values["exits"]) ** 2)}
    found |= {"gap": mean(values["gap"]), "gap^2": mean(values["gap"] ** 2), "gap of slot 1": values["gap"][..., 0]}
    found |= {"centre": np.square(values["centre"] - NOTHING.origin).sum(-1)}
    around = np.sort(np.where(active, values["angle"], np.inf), -1)
    first = around[..., :1] + 2 * math.pi
    following = np.where(np.arange(MAX_ARMS) == count[..., None] - 1, first, np.roll(around, -1, -1))
    between = np.where(active, following - np.where(active, around, 0.0), np.inf)
    found |= {"narrowest": between.min(-1), "cos of slot 1": np.cos(values["angle"][..., 0])}
    found |= {"widest": np.where(active, between, 0.0).max(-1)}
    if "width" in values:
        found |= {"log width": mean(np.log(values["width"])), "width": mean(values["width"])}
    for name in ("bend", "shift"):
        found |= {f"{name}^2": mean(values[name] ** 2), name: mean(values[name])} if name in values else {}
    return {n: np.asarray(v, dtype=np.float64) for n, v in found.items()}


@cache
def prior_values(model: Junction) -> dict[str, Array]:
    """Functionals of 1e5 prior draws."""
    return functionals(states(model, 100_000, seed=99))


def z_scores(model: Junction, chains: dict[str, Array]) -> dict[str, float]:
    """{functional: z} of independent means (C,) against 1e5 draws of the prior; K against its uniform prior."""
    same = {field.name: getattr(model, field.name) for field in fields(Junction)}  # of a subclass, without its moves
    reference = prior_values(Junction(**same))
    scores = {}
    for name, means in chains.items():
        exact = name.startswith("P(K")
        expected = 1.0 / 6.0 if exact else reference[name].mean()
        error2 = means.var(ddof=1) / len(means) + (0.0 if exact else reference[name].var() / len(reference[name]))
        gap = means.mean() - expected
        scores[name] = float(gap / math.sqrt(error2)) if error2 > 0 else (0.0 if abs(gap) < 1e-12 else math.inf)
    return scores


@pytest.mark.parametrize("name", MODELS)
def test_compiled_chains_return_the_prior(name: str) -> None:
    """Twenty-odd z-scores below 4: false once in 700 seeds."""
    posterior = rjmcmc.run(
        MODELS[name], NOTHING, seed=1, num_chains=100, num_steps=10_000, warmup=0, thin=20, path="compiled"
    )
    scores = z_scores(MODELS[name], {n: v.mean(1) for n, v in functionals(posterior.draws).items()})
    assert max(map(abs, scores.values())) < 4.0, scores


def test_compiled_chains_find_the_prior_from_afar() -> None:
    """All chains start with two arms of one lane each way; the first third of their steps is left out."""
    model = MODELS["extended"]
    first = {n: v[0] for n, v in states(model, 1, seed=0).items()}
    first |= {"num_arms": torch.tensor(2), "entries": torch.ones(7).long(), "exits": torch.ones(7).long()}
    first["angle"][:2] = torch.tensor([0.0, 0.5])
    posterior = rjmcmc.run(model, NOTHING, seed=2, init=first, num_chains=100, num_steps=15_000, warmup=5000, thin=20)
    scores = z_scores(model, {n: v.mean(1) for n, v in functionals(posterior.draws).items()})
    assert max(map(abs, scores.values())) < 4.0, scores


def batched_scores(model: Junction, num_steps: int = 40, num_chains: int = 1500) -> dict[str, float]:
    """z-scores of the last states of many short chains on the batched path."""
    posterior = rjmcmc.run(
        model, NOTHING, seed=3, num_chains=num_chains, num_steps=num_steps, warmup=num_steps, path="batched"
    )
    return z_scores(model, {n: v[:, -1] for n, v in functionals(posterior.draws).items()})


Change = Callable[[Latents, Proposal], Proposal]


@dataclass(frozen=True)
class Alone(Junction):
    """The intersection with one kind of move only, perhaps changed."""

    kind: str = ""
    change: Change = lambda _, proposal: proposal

    def moves(self) -> tuple[Move, ...]:
        (move,) = (move for move in super().moves() if move.name == self.kind)

        def propose(z: Latents, u: Tensor) -> Proposal:
            return self.change(z, move.propose(z, u))

        return (move._replace(probability=1.0, propose=propose),)


@pytest.mark.parametrize("kind", [move.name for move in FULL.moves()])
def test_each_move_alone_leaves_the_prior_as_it_is(kind: str) -> None:
    scores = batched_scores(Alone(kind=kind, **SETTINGS))
    assert max(map(abs, scores.values())) < 4.0, scores


def test_batched_chains_return_the_prior() -> None:
    scores = batched_scores(FULL, num_steps=100)
    assert max(map(abs, scores.values())) < 4.0, scores


def log_free(z: Latents) -> Tensor:
    """log share of the circle on which one more arm finds room, (B,)."""
    angle = torch.where(torch.arange(MAX_ARMS) < z["num_arms"][:, None], z["angle"], torch.inf).sort(1).values
    angle = torch.cat([angle, torch.full_like(angle[:, :1], torch.inf)], 1)
    angle.scatter_(1, z["num_arms"][:, None], angle[:, :1] + 2 * math.pi)
    room = (angle[:, 1:] - angle[:, :-1] - 2 * MIN_SEPARATION).nan_to_num(0.0, 0.0, 0.0).clamp(min=0.0)
    return torch.log(room.sum(1) / (2 * math.pi))


def forget_free_angles(z: Latents, proposal: Proposal) -> Proposal:
    """As if a new arm were uniform on the whole circle."""
    birth = proposal.latents["num_arms"] > z["num_arms"]
    return proposal._replace(
        log_forward=proposal.log_forward + torch.where(birth, log_free(z), 0.0),
        log_backward=proposal.log_backward + torch.where(birth, 0.0, log_free(proposal.latents)),
    )


def forget(*names: str) -> Change:
    return lambda z, proposal: proposal._replace(**{n: torch.zeros_like(proposal.log_forward) for n in names})


def forget_slot(of_births: bool) -> Change:
    """Births, or deaths, report the choice of the slot only: not the density of the numbers that they draw."""

    def change(z: Latents, proposal: Proposal) -> Proposal:
        birth = proposal.latents["num_arms"] > z["num_arms"]
        choice = -torch.log(2.0 * torch.maximum(proposal.latents["num_arms"], z["num_arms"]))
        forward = torch.where(birth == of_births, choice, proposal.log_forward)
        backward = torch.where(birth == of_births, proposal.log_backward, choice)
        return proposal._replace(log_forward=forward, log_backward=backward)

    return change


MUTATIONS: dict[str, tuple[str, Change, str]] = {  # the move, what is forgotten, the functional that must show it
    "measure of the free angles": ("arms", forget_free_angles, "P(K = 7)"),
    "choice of the lane": ("lanes", forget("log_forward", "log_backward"), "entries"),
    "choice of the removed lane": ("lanes", forget("log_backward"), "entries"),
    "Jacobian of the width": ("width", forget("log_jacobian"), "log width"),
    "density of the new arm": ("arms", forget_slot(of_births=True), "P(K = 7)"),
    "density of the idle slot": ("arms", forget_slot(of_births=False), "P(K = 7)"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_prior_notices_a_forgotten(name: str) -> None:
    kind, change, witness = MUTATIONS[name]
    arms = NO_BENDS if kind == "arms" else SETTINGS  # with bends log p of a slot is near zero by chance
    scores = batched_scores(Alone(kind=kind, change=change, **arms), num_steps=120)
    assert abs(scores[witness]) > 6.0, scores


def test_prior_notices_a_forgotten_normaliser_of_the_hard_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Z_K: without it few arms are preferred."""
    whole = HardCoreAngles.log_prob

    def bare(self: HardCoreAngles, value: Tensor) -> Tensor:
        count = self.num_arms.double()
        return whole(self, value) + (count - 1) * torch.log1p(-count * MIN_SEPARATION / (2 * math.pi))

    monkeypatch.setattr(HardCoreAngles, "log_prob", bare)
    scores = batched_scores(Alone(kind="arms", **SETTINGS))
    assert scores["P(K = 2)"] > 6.0 and scores["P(K = 7)"] < -6.0, scores


# The hard core of the angles


def hard_core(num_arms: int, num: int, seed: int) -> Tensor:
    """(num, MAX_ARMS) draws."""
    with torch.random.fork_rng(), quiet_doubles():
        torch.manual_seed(seed)
        return HardCoreAngles(torch.tensor(num_arms), MAX_ARMS).sample(torch.Size([num]))


def gaps(angle: Tensor) -> Tensor:
    """(num, K) gaps between neighbours around the circle."""
    around = angle.sort(1).values
    return torch.diff(torch.cat([around, around[:, :1] + 2 * math.pi], 1))


@pytest.mark.parametrize("num_arms", range(MIN_ARMS, MAX_ARMS + 1))
def test_hard_core_is_normalised(num_arms: int) -> None:
    """The share of uniform points that keep apart is Z_K = 1 / (density (2 pi)^S), within 4 standard errors."""
    generator = torch.Generator().manual_seed(num_arms)
    uniform = 2 * math.pi * torch.rand(200_000, MAX_ARMS, generator=generator, dtype=torch.float64) - math.pi
    apart = (gaps(uniform[:, :num_arms]) >= MIN_SEPARATION).all(1)
    log_prob = HardCoreAngles(torch.tensor(num_arms), MAX_ARMS).log_prob(uniform)
    assert torch.equal(torch.isfinite(log_prob), apart)
    mass = (log_prob.exp() * (2 * math.pi) ** MAX_ARMS).numpy()
    assert abs(mass.mean() - 1.0) < 4 * mass.std() / math.sqrt(len(mass))


@pytest.mark.parametrize("num_arms", [2, 4, 7])
def test_hard_core_draws_are_those_of_its_density(num_arms: int) -> None:
    """Against rejection: Kolmogorov-Smirnov of the narrowest gap, of an angle and of a gap of given slots."""
    draws = hard_core(num_arms, 4000, seed=1)
    assert bool(torch.isfinite(HardCoreAngles(torch.tensor(num_arms), MAX_ARMS).log_prob(draws)).all())
    uniform = 2 * math.pi * torch.from_numpy(np.random.default_rng(2).random((150_000, num_arms))) - math.pi
    kept = uniform[(gaps(uniform) >= MIN_SEPARATION).all(1)]
    mine = draws[:, :num_arms]
    assert stats.ks_2samp(gaps(mine).amin(1), gaps(kept).amin(1)).pvalue > 1e-3
    for slot in range(num_arms):
        assert stats.kstest((draws[:, slot] / (2 * math.pi) + 0.5).numpy(), "uniform").pvalue > 1e-3
        turn = lambda x, k=slot: torch.remainder(x[:, (k + 1) % num_arms] - x[:, k], 2 * math.pi)  # noqa: E731
        assert stats.ks_2samp(turn(mine), turn(kept)).pvalue > 1e-3


def test_hard_core_leaves_idle_slots_uniform_and_active_ones_alike() -> None:
    draws = hard_core(3, 6000, seed=3)
    for slot in range(3, MAX_ARMS):
        assert stats.kstest((draws[:, slot] / (2 * math.pi) + 0.5).numpy(), "uniform").pvalue > 1e-3
    order = draws[:, :3].argsort(1)
    counts = torch.bincount(order[:, 0] * 9 + order[:, 1] * 3 + order[:, 2], minlength=27)
    assert stats.chisquare(counts[counts > 0].numpy()).pvalue > 1e-3 and int((counts > 0).sum()) == 6
    density = HardCoreAngles(torch.tensor(3), MAX_ARMS)
    swapped = draws[:, [2, 0, 1, 3, 4, 5, 6]]
    torch.testing.assert_close(density.log_prob(draws), density.log_prob(swapped))
