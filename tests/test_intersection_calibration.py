"""Do the compiled chain and the `exact` likelihood of the intersection agree with its simulator?

Scenes are small, ten half tracks of about ten points, so that structures compete and chains get about."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from inference import calibration, rjmcmc
from inference.compiled_chain import CompiledChains
from inference.posterior import Posterior
from models.intersection.packing import MAX_ARMS
from models.intersection.state import Junction
from models.program import Latents
from tests.small_junction import NO_BENDS, SETTINGS, blank_evidence

CHANGES = {"position_std": 1.5, "max_lanes": 3, "gap_max": 6.0, "centre_std": 3.0}
MODEL = Junction(**SETTINGS | CHANGES)
PAPER = Junction(**NO_BENDS | CHANGES, steps="m20")
BLANK = blank_evidence(5, 5)


def active(z: Latents) -> torch.Tensor:
    return torch.arange(MAX_ARMS) < torch.as_tensor(z["num_arms"])[:, None]


FUNCTIONALS: dict[str, calibration.Functional] = {
    "num_arms": lambda z: z["num_arms"],
    "entries": lambda z: (z["entries"] * active(z)).sum(1),
    "exits": lambda z: (z["exits"] * active(z)).sum(1),
    "centre x": lambda z: z["centre"][:, 0],
    "centre^2": lambda z: ((z["centre"] - torch.from_numpy(BLANK.origin)) ** 2).sum(1),
    "mean gap": lambda z: (z["gap"] * active(z)).sum(1) / z["num_arms"],
}
WIDTHS: dict[str, calibration.Functional] = {
    "sum of widths": lambda z: (z["width"] * active(z)).sum(1),
    "bend^2": lambda z: (z["bend"] ** 2 * active(z)).sum(1),
    "shift^2": lambda z: (z["shift"] ** 2 * active(z)).sum(1),
}


def transition(model: Junction, num_moves: int) -> calibration.Transition:
    """`num_moves` steps of the compiled chain for every scene of a batch."""

    def go(latents: Latents, evidence: Any, seed: int) -> Latents:
        seeds = np.random.SeedSequence(seed).spawn(len(evidence.points))
        ends = []
        for row, (points, one_seed) in enumerate(zip(evidence.points, seeds, strict=True)):
            kernel = model.kernel(evidence._replace(points=points))
            z = kernel.pack({n: v[row : row + 1].numpy() for n, v in latents.items()})
            chain = CompiledChains(kernel, z, rjmcmc.RULES["exact"], 1, num_moves, [one_seed], 1)
            chain.advance(0, np.ones(num_moves))
            ends.append(kernel.unpack(chain.z[0]))
        return {n: torch.as_tensor(np.array([end[n] for end in ends])) for n in latents}

    return go


def joint_test(model: Junction, num: int, num_steps: int, seed: int = 1) -> dict[str, float]:
    functionals = FUNCTIONALS | (WIDTHS if model.width_spread > 0 else {})
    return calibration.geweke(
        model, BLANK, transition(model, 300), functionals, num=num, num_steps=num_steps, seed=seed
    )


LONG = pytest.mark.slow


@pytest.mark.parametrize("model", [MODEL, PAPER], ids=["extended", "m20"])
@pytest.mark.parametrize(("num", "num_steps"), [(200, 5), pytest.param(1500, 20, marks=LONG)], ids=["short", "long"])
def test_joint_test_passes(model: Junction, num: int, num_steps: int) -> None:
    """Up to ten standard normal z-scores: one in two thousand such sets exceeds 4 (the seed is fixed)."""
    scores = joint_test(model, num, num_steps)
    assert max(map(abs, scores.values())) < 4.0, scores


def engine(num_steps: int) -> calibration.Engine:
    """One annealed compiled chain from the prior, thinned to a few hundred draws."""

    def run(model: Any, evidence: Any, seed: int) -> Posterior:
        return rjmcmc.run(
            model,
            evidence,
            seed=seed,
            num_chains=2,
            num_steps=num_steps,
            warmup=num_steps // 2,
            start_temperature=20.0,
            thin=num_steps // 100,
        )

    return run


@pytest.mark.parametrize(
    ("num", "num_steps"), [(50, 20_000), pytest.param(400, 60_000, marks=LONG)], ids=["short", "long"]
)
def test_ranks_of_the_truth_are_uniform(num: int, num_steps: int) -> None:
    """Simulation-based calibration; p below 1e-4 in one of ten functionals has odds of 1 in 1000."""
    functionals = FUNCTIONALS | WIDTHS
    found = calibration.ranks(MODEL, BLANK, engine(num_steps), functionals, num=num, num_draws=19, seed=2)
    assert min(found.p_values().values()) > 1e-4, found.p_values()
