"""Adaptive importance sampling: a few rounds of draws from a proposal that is learnt on the way (Cornuet et al. 2012).

In numbers u of inference.transform, round t draws N numbers from q_t, a Student's t about m_t with scale S_t; q_1 has
m = 0 and S = I. All rounds so far are weighted by the mixture of their proposals, and teach the next one,

    w_i = p(u_i, y) / (1/t sum_s q_s(u_i)),   m = sum w^a u,   S = sum w^a (u - m) (u - m)^T,   sum w^a = 1

with the largest a <= 1 that leaves enough effective draws for S: far from the posterior a is small, and the proposal
moves there in steps (Koblents and Miguez 2015).

These weights serve the draws, not the evidence: each q was fitted to draws that it then divides, so that their mean
falls short of p(y). The evidence is the mean of p(u, y) / q_t(u) under each round's own q_t, which the round has no
part in, over the later half of the rounds: unbiased, and its standard error is that of independent weights.
"""

from __future__ import annotations

import math
import time
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

from inference import weights
from inference.factors import factored
from inference.posterior import Posterior
from inference.refusal import accept, answers_first
from inference.snapshots import snapshots
from inference.transform import Target, whitening
from models.program import InputError, Model

Array = NDArray[np.float64]
DEGREES = 5.0  # of freedom of the proposals
ENOUGH = 4.0  # effective draws for each dimension of the scale that they are to teach
LEAST = 50.0  # of them in few dimensions
WORST_K = 0.7  # Pareto shape past which means of the weights cannot be trusted


class Proposal(NamedTuple):
    """Student's t with DEGREES of freedom: centre m (D,), tril (D, D) of S = tril tril^T, and its inverse."""

    centre: Array
    tril: Array
    inverse: Array

    def draw(self, num: int, rng: np.random.Generator) -> Array:
        """(num, D)."""
        noise = rng.standard_normal((num, len(self.centre)))
        noise *= np.sqrt(DEGREES / rng.chisquare(DEGREES, (num, 1)))
        return self.centre + noise @ self.tril.T

    def log_density(self, u: Array) -> Array:
        """u (S, D) to log q(u) (S,)."""
        size, gap = len(self.centre), (u - self.centre) @ self.inverse.T
        whole = DEGREES + size
        const = math.lgamma(0.5 * whole) - math.lgamma(0.5 * DEGREES) - 0.5 * size * math.log(DEGREES * math.pi)
        height = const + np.log(self.inverse.diagonal()).sum()
        return np.asarray(height - 0.5 * whole * np.log1p(np.einsum("sd,sd->s", gap, gap) / DEGREES))


class Rounds(NamedTuple):
    """All draws so far.

    u         (n, D)
    height    (n,) log p(u, y)
    mixed     (n,) log sum_s q_s(u) over all rounds
    own       (n,) log q_t(u) of the round that drew it
    """

    u: Array
    height: Array
    mixed: Array
    own: Array


def proposal_of(centre: Array, scale: Array) -> Proposal:
    """The proposal with scale S (D, D)."""
    tril = np.asarray(np.linalg.cholesky(scale), dtype=np.float64)
    return Proposal(centre, tril, dtrtri(tril, lower=1)[0])


def extend(rounds: Rounds, target: Target, proposals: list[Proposal], num: int, rng: np.random.Generator) -> Rounds:
    """One more round, from the last of the proposals."""
    last = proposals[-1]
    u = last.draw(num, rng)
    past = [q.log_density(u) for q in proposals]
    mixed = np.logaddexp(rounds.mixed, last.log_density(rounds.u))
    return Rounds(
        np.concatenate([rounds.u, u]),
        np.concatenate([rounds.height, target.evaluate(u).sum(1)]),
        np.concatenate([mixed, np.logaddexp.reduce(past, axis=0)]),
        np.concatenate([rounds.own, past[-1]]),
    )


def learn(u: Array, log_weights: Array) -> Proposal:
    """The next proposal: moments of the draws u (n, D) under their tempered weights.

    Raises InputError where D draws or fewer have any weight."""
    some, size = int(np.count_nonzero(log_weights != -np.inf)), u.shape[1]
    if some <= size:
        raise InputError(
            f"{some} of {len(u)} draws have any weight, too few to teach a proposal of {size} numbers; "
            "raise num_draws, or begin nearer to the posterior (init)"
        )
    power = weights.temper(log_weights, max(LEAST, ENOUGH * size))
    share = weights.normalise(power * log_weights)
    centre = share @ u
    apart = u - centre
    scale = (apart * share[:, None]).T @ apart
    scale.ravel()[:: len(centre) + 1] *= 1.0 + 1e-9
    return proposal_of(centre, scale)


@answers_first
def run(
    model: Model,
    evidence: Any,
    *,
    seed: int,
    init: dict[str, Any] | None = None,
    transform: Literal["prior", "laplace"] = "laplace",
    num_draws: int = 256,
    num_rounds: int = 4,
) -> Posterior:
    """Weighted draws from p(z | y) and the log evidence.

    init        {site: (*event)} where the Laplace fit, or the first proposal, begins
    transform   "laplace" begins with a fit about the mode, "prior" with the prior, which takes many more rounds
    num_draws   in each round

    Raises InputError by name for latents that cannot be whitened, and for too few draws."""
    began = time.perf_counter()
    factors = factored(model, evidence)
    size = factors.depends.shape[1]
    least = int(max(LEAST, ENOUGH * size))
    for name, value, low in (("num_draws", num_draws, least), ("num_rounds", num_rounds, 2)):
        if value < low:
            raise InputError(f"{name} is {value}; importance sampling of {size} numbers needs {low} or more")
    accept()
    target, start, evaluations, flags = whitening(model, evidence, factors, transform, init)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    proposals = [proposal_of(start, np.eye(size))]
    rounds, times = Rounds(np.empty((0, size)), *np.empty((3, 0))), []
    for number in range(num_rounds):
        if number:
            proposals.append(learn(rounds.u, rounds.height - rounds.mixed))
        rounds = extend(rounds, target, proposals, num_draws, rng)
        times.append(time.perf_counter() - began)
    log_weights = rounds.height - rounds.mixed + math.log(num_rounds)
    later = (rounds.height - rounds.own)[num_draws * (num_rounds // 2) :]
    pareto_k = weights.pareto_k(log_weights)
    seconds, draws = time.perf_counter() - began, target.latents(rounds.u)
    ends = num_draws * np.arange(1, num_rounds + 1)
    best = [int(rounds.height[:end].argmax()) for end in ends]
    return Posterior(
        draws={n: v[None] for n, v in draws.items()},
        log_weights=log_weights[None],
        log_evidence=weights.log_mean(later),
        estimate={n: v[best[-1]] for n, v in draws.items()},
        info={
            "engine": "importance",
            "seconds": seconds,
            "evaluations": evaluations + len(rounds.u),
            "ess": weights.effective_size(log_weights),
            "pareto_k": pareto_k,
            "log_evidence_error": weights.relative_error(later),
            "flags": flags + _flags(pareto_k),
        },
        snapshots=snapshots(model, evidence, ends.tolist(), times, {n: v[best] for n, v in draws.items()}),
    )


def _flags(pareto_k: float) -> list[str]:
    if pareto_k <= WORST_K:
        return []
    return [
        f"the Pareto shape of the weights is {pareto_k:.2f} (above {WORST_K}): few draws bear all weight, so means and "
        "evidence cannot be trusted; raise num_rounds, use transform=laplace, or use smc"
    ]
