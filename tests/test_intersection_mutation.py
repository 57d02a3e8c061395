"""Every term of the acceptance ratio, taken away on purpose, makes a named check of the intersection fail.

Without data the posterior is the prior (tests/test_intersection_prior.py); a lost likelihood shows in the joint test.
The paper's rules are such mutations of the compiled chain: `paper` has no Jacobian, `printed` inverts the proposal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from inference import calibration, rjmcmc
from inference.compiled_chain import CompiledChains
from models.program import Latents
from tests.small_junction import FULL, NOTHING, SETTINGS, blank_evidence, states
from tests.test_intersection_prior import Alone, batched_scores, functionals, z_scores

Rule = Callable[..., Tensor]
EXACT: Rule = rjmcmc.log_acceptance
TERMS = ("prior", "likelihood", "forward", "backward", "jacobian")


def without(**factors: float) -> Rule:
    """The exact rule with some of its terms multiplied by a factor: 0 drops, -1 reverses."""

    def rule(kind: int, temperature: float, *parts: Tensor) -> Tensor:
        return EXACT(kind, temperature, *(factors.get(n, 1.0) * part for n, part in zip(TERMS, parts, strict=True)))

    return rule


MUTATIONS: dict[str, tuple[Rule, str, str]] = {  # the rule, the move that shows it, the functional that shows it
    "prior ratio dropped": (without(prior=0.0), "shift", "shift^2"),
    "log_forward dropped": (without(forward=0.0), "bend", "bend^2"),
    "log_backward dropped": (without(backward=0.0), "lanes", "exits"),
    "proposal ratio inverted": (without(forward=-1.0, backward=-1.0), "lanes", "entries"),
    "log_jacobian dropped": (without(jacobian=0.0), "width", "width"),
    "log_jacobian reversed": (without(jacobian=-1.0), "width", "width"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_prior_notices(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rule, kind, witness = MUTATIONS[name]
    monkeypatch.setattr(rjmcmc, "log_acceptance", rule)
    scores = batched_scores(Alone(kind=kind, **SETTINGS), num_steps=120)
    assert abs(scores[witness]) > 6.0, scores


@pytest.mark.parametrize(
    ("acceptance", "kind", "witness"), [("paper", "width", "log width"), ("printed", "lanes", "entries")]
)
@pytest.mark.parametrize("exact", [True, False], ids=["exact", "mutant"])
def test_compiled_chain_of_one_move_notices(acceptance: str, kind: str, witness: str, exact: bool) -> None:
    """200 chains of 3000 steps of one kind of move, from prior draws."""
    kernel = FULL.kernel(NOTHING)
    kernel = kernel._replace(probabilities=np.array([float(name == kind) for name in kernel.move_names]))
    z = kernel.pack({n: v.numpy() for n, v in states(FULL, 200, seed=5).items()})
    rule = rjmcmc.RULES["exact" if exact else acceptance]
    chains = CompiledChains(kernel, z, rule, 3000, 0, np.random.SeedSequence(6).spawn(200), 1)
    chains.advance(0, np.ones(3000))
    scores = z_scores(FULL, functionals(kernel.unpack(chains.z)))
    if exact:
        assert max(map(abs, scores.values())) < 4.0, scores
    else:
        assert abs(scores[witness]) > 4.0, scores


BLANK = blank_evidence(2, 2, num_points=5)


def transition(latents: Latents, evidence: Any, seed: int) -> Latents:
    """Ten random moves on the batched path."""
    model, rng = FULL, np.random.default_rng(seed)
    moves = model.moves()
    state = rjmcmc.init(model, latents, evidence)
    size = len(state.log_prior)
    for kind in rng.choice(len(moves), 10, p=[move.probability for move in moves]):
        u = torch.from_numpy(rng.random((size, moves[kind].num_uniforms)))
        log_u = torch.from_numpy(np.log(rng.random(size)))
        state, _, _ = rjmcmc.step(model, moves[kind], state, evidence, u, log_u, rjmcmc.RULES["exact"], 1.0)
    return state.latents


@pytest.mark.parametrize(("factor", "low", "high"), [(1.0, 0.0, 4.0), (0.0, 6.0, 1e9)], ids=["kept", "dropped"])
def test_joint_test_notices_the_likelihood_ratio(
    factor: float, low: float, high: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A chain that ignores the data leaves them where the state no longer is."""
    monkeypatch.setattr(rjmcmc, "log_acceptance", without(likelihood=factor))
    scores = calibration.geweke(
        FULL, BLANK, transition, {"num_arms": lambda z: z["num_arms"]}, num=200, num_steps=4, seed=1
    )
    assert low <= abs(scores["log_joint"]) < high, scores
