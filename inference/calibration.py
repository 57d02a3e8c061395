"""Do an engine and a model agree? Two tests in which the simulator is the model itself.

Simulation-based calibration (Talts et al. 2018): with z, y ~ p(z, y) and z_1..z_L ~ p(z | y),

    rank of f(z) among f(z_1)..f(z_L) ~ uniform on 0..L     for every functional f

Joint test (Geweke 2004): a transition that leaves p(z | y) invariant, followed by fresh data
y ~ p(y | z), leaves the joint density p(z, y) invariant. Many short chains start from exact draws of
the joint density and move on together (Gandy & Scott 2020), so that their differences from the
start are independent and the z-scores need no estimate of autocorrelation. Functionals are measured
between the transition and the fresh data: a transition that ignores the data shows only there.

A functional maps latents {site: (B, *event)} to (B,), as arrays or tensors. The functional
`log_joint` is always added: it sees the data, and is the most telling one (Modrák et al. 2023).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pyro import poutine
from scipy import stats

from inference.posterior import Posterior
from models.program import Latents, Model, log_joint, observe, quiet_doubles, simulate

Array = NDArray[Any]
Functional = Callable[[Any], Any]
Engine = Callable[[Model, Any, int], Posterior]  # (model, evidence, seed)
Transition = Callable[[Latents, Any, int], Latents]  # (latents, batched evidence, seed)


class Ranks(NamedTuple):
    """Ranks of the truth among posterior draws.

    ranks      {functional: (num,)} in 0..num_draws
    num_draws  L
    """

    ranks: dict[str, NDArray[np.int64]]
    num_draws: int

    def p_values(self) -> dict[str, float]:
        """Chi-square test of uniformity, with at least five ranks expected in each bin."""
        return {name: uniformity(ranks, self.num_draws) for name, ranks in self.ranks.items()}


def uniformity(ranks: NDArray[np.int64], num_draws: int) -> float:
    """p-value of the chi-square test that ranks are uniform on 0..num_draws."""
    num_bins = int(np.clip(len(ranks) // 5, 2, min(20, num_draws + 1)))
    bins = np.arange(num_draws + 1) * num_bins // (num_draws + 1)  # bin of each rank
    expected = np.bincount(bins, minlength=num_bins) / (num_draws + 1) * len(ranks)
    return float(stats.chisquare(np.bincount(bins[ranks], minlength=num_bins), expected).pvalue)


def ranks(
    model: Model,
    blank: Any,
    engine: Engine,
    functionals: dict[str, Functional],
    *,
    num: int,
    num_draws: int,
    seed: int,
    batched: bool = False,
) -> Ranks:
    """Ranks of `num` simulated truths, each among `num_draws` evenly spaced draws of the engine.

    blank    evidence whose observed fields are None
    batched  one call for all scenes, evidence (num, *event), and chain i of the posterior is scene i

    Ties, as discrete functionals have, are broken at random. Chains must be thinned or long enough
    for the draws to be nearly independent."""
    scene_seed, *seeds = _seeds(seed, 1 + 2 * num)
    scenes = simulate(model, blank, num=num, seed=scene_seed)
    together = _split(engine(model, observe(blank, scenes)[0], seeds[0])) if batched else None
    found: dict[str, list[int]] = {name: [] for name in (*functionals, "log_joint")}
    for scene in range(num):
        evidence, truth = observe(blank, {name: value[scene] for name, value in scenes.items()})
        engine_seed, tie_seed = seeds[2 * scene : 2 * scene + 2]
        posterior = together[scene] if together else engine(model, evidence, engine_seed)
        draws = posterior.resample(num_draws, tie_seed)
        ties = np.random.default_rng(tie_seed)
        # the truth joins its draws as number 0, so that both are treated alike
        joined = {n: torch.cat([v[None], torch.from_numpy(draws[n]).to(v.dtype)]) for n, v in truth.items()}
        for name, values in _evaluate(functionals, model, joined, evidence).items():
            below, equal = int((values[1:] < values[0]).sum()), int((values[1:] == values[0]).sum())
            found[name].append(below + int(ties.integers(0, equal + 1)))
    return Ranks({name: np.array(values) for name, values in found.items()}, num_draws)


def _split(posterior: Posterior) -> list[Posterior]:
    """Each chain as a posterior of its own."""
    num_chains = posterior.shape[0]
    return [Posterior({n: v[c : c + 1] for n, v in posterior.draws.items()}) for c in range(num_chains)]


def geweke(
    model: Model,
    blank: Any,
    transition: Transition,
    functionals: dict[str, Functional],
    *,
    num: int,
    num_steps: int,
    seed: int,
) -> dict[str, float]:
    """z-scores {functional: z}, standard normal where transition and model agree.

    z = mean over chains of (mean along the chain - start), over its standard error. `num` chains run
    as one batch: the model must take evidence with a batch of observations (B, *event)."""
    start_seed, *seeds = _seeds(seed, 1 + 2 * num_steps)
    evidence, latents = observe(blank, simulate(model, blank, num=num, seed=start_seed))
    start = _evaluate(functionals, model, latents, evidence)
    sums = {name: np.zeros(num) for name in start}
    for move_seed, data_seed in zip(seeds[::2], seeds[1::2], strict=True):
        latents = transition(latents, evidence, move_seed)
        for name, values in _evaluate(functionals, model, latents, evidence).items():
            sums[name] += values
        evidence = predict(model, latents, blank, seed=data_seed)
    return {name: z_score(sums[name] / num_steps - start[name]) for name in start}


def z_score(gaps: NDArray[np.float64]) -> float:
    """Mean of independent differences over its standard error; zero where all are zero."""
    error = gaps.std(ddof=1) / np.sqrt(len(gaps))
    return float(gaps.mean() / error) if error > 0 else 0.0


def predict(model: Model, latents: Latents, blank: Any, *, seed: int) -> Any:
    """Evidence with fresh observations given latents {site: (B, *event)}; randomness is local."""
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        trace = poutine.trace(poutine.condition(model, data=latents)).get_trace(blank)
    sites = ((n, s) for n, s in trace.nodes.items() if s["type"] == "sample" and not s["is_observed"])
    fresh: dict[str, Any] = {name: site["value"] for name, site in sites}
    return observe(blank, fresh)[0]


def _evaluate(functionals: dict[str, Functional], model: Model, latents: Latents, evidence: Any) -> dict[str, Array]:
    """{functional: (B,)}, with log_joint."""
    values = {name: np.asarray(f(latents), dtype=np.float64) for name, f in functionals.items()}
    return values | {"log_joint": log_joint(model, latents, evidence).numpy()}


def _seeds(seed: int, num: int) -> list[int]:
    return [int(child.generate_state(1)[0]) for child in np.random.SeedSequence(seed).spawn(num)]
