"""The No-U-Turn sampler (Hoffman and Gelman 2014), as Pyro has it: the reference for models of continuous latents.

It runs on the numbers u of inference.transform. Its potential is -log p(u, y), whose gradient comes from the model's
factors, compiled or not; Pyro asks for first derivatives only. Chains begin apart, so that R-hat can tell whether they
found the same posterior. A leapfrog path along which the energy is not kept is a divergence: the posterior bends there
more sharply than the step can follow, and draws near it are missing.
"""

from __future__ import annotations

import time
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pyro.infer import MCMC, NUTS
from torch import Tensor

from inference.factors import factored
from inference.posterior import Posterior
from inference.progress import Progress
from inference.refusal import accept, answers_first
from inference.snapshots import snapshots
from inference.transform import Target, whitening
from models.program import InputError, Model, quiet_doubles

Array = NDArray[Any]


class Potential:
    """-log p(u, y) of Pyro's parameters {"u": (D,)}, differentiable once; counts how often it is asked."""

    def __init__(self, target: Target) -> None:
        self.target, self.evaluations = target, 0

    def __call__(self, parameters: dict[str, Tensor]) -> Tensor:
        u = parameters["u"]
        self.evaluations += 1
        with torch.enable_grad():  # a program's own gradient needs it, wherever it is asked for
            height, slope = self.target.gradient(u.detach().numpy()[None])
        change = u - u.detach()  # zero, but with a gradient
        return -(float(height[0]) + torch.from_numpy(slope[0]) @ change)


@answers_first
def run(
    model: Model,
    evidence: Any,
    *,
    seed: int,
    init: dict[str, Any] | None = None,
    transform: Literal["prior", "laplace"] = "laplace",
    num_chains: int = 4,
    num_draws: int = 500,
    warmup: int = 300,
    spread: float = 1.0,
    target_acceptance: float = 0.8,
    max_tree_depth: int = 10,
    progress: bool = False,
) -> Posterior:
    """Sample p(z | y); the first `warmup` draws of every chain learn its step and scales, and are discarded. The
    estimate is the best of all draws and of the fit.

    init               {site: (*event)} where the Laplace fit, or the chains, begin
    spread             chains begin at u = u_0 + spread e, e ~ N(0, I); u_0 is the fit, or init, or the prior's median
    target_acceptance  nearer to one makes shorter steps and fewer divergences
    max_tree_depth     at most 2^depth leapfrog steps a draw

    Raises InputError by name for latents that cannot be whitened, such as discrete ones."""
    began = time.perf_counter()
    _check(num_chains, num_draws, warmup, spread, target_acceptance, max_tree_depth)
    factors = factored(model, evidence)
    accept()
    target, start, evaluations, flags = whitening(model, evidence, factors, transform, init)
    potential, chains, times = Potential(target), [], [time.perf_counter() - began]
    divergent, lengths = 0, []
    with Progress("No-U-Turn sampler", num_chains * (warmup + num_draws), progress) as bar:
        for child in np.random.SeedSequence(seed).spawn(num_chains):
            kernel = NUTS(potential_fn=potential, target_accept_prob=target_acceptance, max_tree_depth=max_tree_depth)
            first = start + spread * np.random.default_rng(child).standard_normal(len(start))
            u, told = _chain(kernel, first, int(child.generate_state(1)[0]), num_draws, warmup, bar)
            chains.append(u)
            times.append(time.perf_counter() - began)
            divergent += len(told["divergences"])
            lengths.append(float(told["step"]))
    u = np.stack(chains)  # (C, n, D)
    path = np.concatenate([start[None], u.reshape(-1, len(start))])
    heights, ends = target.evaluate(path).sum(1), num_draws * np.arange(num_chains + 1)
    states = target.latents(path[[int(heights[: end + 1].argmax()) for end in ends]])
    return Posterior(
        draws=target.latents(u),
        estimate={n: v[-1] for n, v in states.items()},
        info={
            "engine": "nuts",
            "seconds": times[-1],
            "evaluations": evaluations + potential.evaluations,
            "steps": lengths,
            "divergences": divergent,
            "flags": flags + _flags(divergent, num_chains * num_draws),
        },
        snapshots=snapshots(model, evidence, ends.tolist(), times, states),
    )


def _check(
    num_chains: int, num_draws: int, warmup: int, spread: float, target_acceptance: float, max_tree_depth: int
) -> None:
    counts = {"num_chains": num_chains, "num_draws": num_draws, "warmup": warmup, "max_tree_depth": max_tree_depth}
    for name, value in counts.items():
        if value < 1:
            raise InputError(f"{name} is {value}; nuts needs 1 or more")
    if not 0.0 < target_acceptance < 1.0:
        raise InputError(f"target_acceptance is {target_acceptance}; choose a share between 0 and 1")
    if not (np.isfinite(spread) and spread >= 0.0):
        raise InputError(f"spread is {spread}; choose 0 or more")


def _chain(
    kernel: Any, first: Array, seed: int, num_draws: int, warmup: int, bar: Progress
) -> tuple[Array, dict[str, Any]]:
    """One chain from u = first (D,): draws (n, D), and Pyro's divergences and last step."""
    told: dict[str, Any] = {}

    def note(kernel: Any, parameters: Any, stage: str, number: int) -> None:
        if not stage.startswith("Warmup"):
            told.update(kernel.diagnostics(), step=kernel.step_size)  # the end of the run wipes them
        bar.advance(1)

    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        start = {"u": torch.from_numpy(first)}
        options: dict[str, Any] = {"warmup_steps": warmup, "initial_params": start, "disable_progbar": True}
        mcmc = MCMC(kernel, num_samples=num_draws, hook_fn=note, **options)
        mcmc.run()
        return mcmc.get_samples()["u"].numpy(), told


def _flags(divergent: int, num: int) -> list[str]:
    if not divergent:
        return []
    return [
        f"{divergent} of {num} draws diverged: the posterior bends more sharply than the step; raise target_acceptance "
        "or use another transform"
    ]
