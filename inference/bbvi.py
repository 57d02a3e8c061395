"""Black-box variational inference: a Gaussian q that comes as close to the posterior as it can.

    maximise ELBO = E_q[log p(u, y) - log q(u)] = log p(y) - KL(q || p)

over the mean and the standard deviations of q (mean field) or its whole Cholesky factor (full rank), in coordinates
u of inference.transform, by the gradients of inference.gradients and Adam (Kingma and Ba 2015) with a step that falls
as a cosine. With `fixed_scale` only the mean is free: Trusheim, Condurache, Mertins, eq. 6, and MAP = mean (there the
scale is 1 in natural units, here in u).

The noise may be annealed: the likelihood counts 1 / inflation^2, and the inflation falls to one along the first steps.

Draws come from q. Their weights w = p(u, y) / q(u) tell what q misses: log p(y) ~ log mean w, ELBO = mean log w, and
draws weighted by them are the posterior's own as far as their Pareto shape k is below 0.7.

Adam's own convergence says little, for its step falls anyway. What a natural-gradient step at the end would still gain,
with g the gradient by mean / sd and by log sd, measured on the final draws, is told instead:

    sum_d g_mean^2 / (2 c) + g_log_sd^2 / 4,   c = 1 - g_log_sd, the curvature of E_q[log p] in units of q

less what the noise of g adds.
"""

from __future__ import annotations

import math
import time
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference import weights
from inference.factors import factored
from inference.gradients import (
    Block,
    Gaussian,
    Reading,
    blocks,
    overdispersed,
    reading,
    reparameterised,
    score,
    signal,
    terms,
)
from inference.posterior import Posterior, Snapshots
from inference.progress import Progress
from inference.refusal import accept, answers_first
from inference.snapshots import snapshots
from inference.transform import Target, whitening
from models.program import InputError, Model

Array = NDArray[np.float64]
ESTIMATORS = ("score", "overdispersed", "reparameterised")
DECAY, SQUARE_DECAY = 0.9, 0.99  # of Adam's two means
LAST_STEP = 0.02  # of the first one
TAU_RATE, TAU_MAX = 0.1, 5.0
MIN_SAMPLES = 4  # for each gradient: a control variate leaves one out
GAIN = 0.1  # [nats] that a converged q may leave: 0.4 standard deviations of one number
MAX_K = 0.7  # of the Pareto tail (Vehtari et al. 2024)


class State(NamedTuple):
    """Parameters of q one after the other (P,): mean, log sd, and the strictly lower triangle by rows for full rank;
    Adam's mean gradient and mean squared gradient (P,); tau (B,) of each block; steps done."""

    numbers: Array
    drift: Array
    power: Array
    tau: Array
    done: int = 0


class Plan(NamedTuple):
    """What every step needs to know: see `run`."""

    target: Target
    estimator: str
    reads: Reading
    control_variates: bool
    blocks: list[Block]
    adapt_tau: bool
    fixed: bool
    full_rank: bool
    num_steps: int
    learning_rate: float
    inflation: float
    annealed: float


def first_state(plan: Plan, mean: Array, scale: float, tau: float) -> State:
    """q = N(mean, scale^2 I)."""
    size = len(mean)
    lower = size * (size - 1) // 2 if plan.full_rank else 0
    numbers = np.concatenate([mean, np.full(size, math.log(scale)), np.zeros(lower)])
    return State(numbers, np.zeros_like(numbers), np.zeros_like(numbers), np.full(len(plan.blocks), tau))


def q_of(plan: Plan, numbers: Array) -> Gaussian:
    """q from its parameters (P,)."""
    size = plan.target.size
    lower = None
    if plan.full_rank:
        lower = np.zeros((size, size))
        lower[np.tril_indices(size, -1)] = numbers[2 * size :]
    return Gaussian(numbers[:size], numbers[size : 2 * size], lower)


def share_of(plan: Plan, done: int) -> float:
    """What the likelihood counts: 1 / inflation^2, the inflation falling to one by equal ratios."""
    left = 1.0 - done / (plan.annealed * plan.num_steps) if plan.annealed > 0 else 0.0
    return plan.inflation ** (-2.0 * max(left, 0.0))


def step(plan: Plan, state: State, noise: Array) -> State:
    """One step of Adam along an estimated gradient; noise (S, D) standard normal.

    Raises FloatingPointError where the gradient is not finite."""
    q, share, tau = q_of(plan, state.numbers), share_of(plan, state.done), state.tau
    if plan.estimator == "reparameterised":
        gradient = reparameterised(plan.target, q, noise, share)
    elif plan.estimator == "score":
        gradient = score(plan.target, q, noise, share, plan.reads, plan.control_variates)
    else:
        options = (plan.reads, plan.control_variates, plan.blocks, tau)
        gradient, slopes = overdispersed(plan.target, q, noise, share, *options)
        if plan.adapt_tau:
            tau = np.clip(tau * np.exp(-TAU_RATE * slopes), 1.0, TAU_MAX)
    if not math.isfinite(gradient.sum()):
        raise FloatingPointError(_blame(plan, q, noise, state.done))
    if plan.fixed:
        gradient[plan.target.size :] = 0.0
    done = state.done + 1
    drift = DECAY * state.drift + (1.0 - DECAY) * gradient
    power = SQUARE_DECAY * state.power + (1.0 - SQUARE_DECAY) * gradient * gradient
    wave = 0.5 * (1.0 + math.cos(math.pi * done / plan.num_steps))
    rate = plan.learning_rate * (LAST_STEP + (1.0 - LAST_STEP) * wave) / (1.0 - DECAY**done)
    move = rate * drift / (np.sqrt(power / (1.0 - SQUARE_DECAY**done)) + 1e-8)
    return State(state.numbers + move, drift, power, tau, done)


def _blame(plan: Plan, q: Gaussian, noise: Array, done: int) -> str:
    u = q.draw(noise)
    bad = np.flatnonzero(~np.isfinite(plan.target.evaluate(u).sum(1)))
    where = plan.target.latents(u[bad[0]]) if len(bad) else plan.target.latents(q.mean)
    return f"the gradient of the ELBO is not finite at step {done}, with a draw of q at {where}"


@answers_first
def run(
    model: Model,
    evidence: Any,
    *,
    seed: int,
    init: dict[str, Any] | None = None,
    transform: Literal["prior", "laplace"] = "laplace",
    estimator: Literal["score", "overdispersed", "reparameterised"] = "score",
    full_rank: bool = False,
    fixed_scale: float | None = None,
    num_steps: int = 200,
    num_samples: int = 64,
    learning_rate: float = 0.1,
    start_scale: float = 1.0,
    inflation: float = 1.0,
    annealed: float = 0.5,
    tau: float = 1.5,
    adapt_tau: bool = True,
    rao_blackwell: bool = True,
    control_variates: bool = True,
    num_draws: int = 1000,
    weighted: bool = False,
    num_snapshots: int = 20,
    progress: bool = False,
) -> Posterior:
    """Fit q, then draw from it: one chain of independent draws. The estimate is the mean of q.

    init           {site: (*event)} where the search begins
    transform      coordinates of q: the prior's numbers, or those about the mode (inference.transform.whitening)
    estimator      of the gradient (inference.gradients); only score and overdispersed do without that of the model
    full_rank      q with correlations; needs estimator=reparameterised
    fixed_scale    standard deviation of q in u, held; None learns one for each number
    start_scale    the first standard deviation of q in u
    inflation      of the noise at first, falling to 1 along the first share `annealed` of the steps
    tau            variance of the overdispersed proposal at first; adapt_tau lets it follow its slope
    weighted       attach the weights p / q to the draws
    num_snapshots  means of q kept along the steps beside the first; their densities are not in info's seconds

    Raises InputError by name for latents that cannot be whitened and for knobs that contradict each other."""
    began = time.perf_counter()
    _check_words(estimator, full_rank, fixed_scale)
    _check_numbers(
        {
            "num_steps": num_steps,
            "num_draws": num_draws,
            "inflation": inflation,
            "tau": tau,
            "num_samples": num_samples,
        },
        {"learning_rate": learning_rate, "start_scale": start_scale},
        annealed,
    )
    factors = factored(model, evidence)
    accept()
    found = whitening(model, evidence, factors, transform, init)
    reads = reading(found.target, rao_blackwell)
    parts = blocks(factors.sites, reads, num_samples) if estimator == "overdispersed" else []
    least = 1 if estimator == "reparameterised" else MIN_SAMPLES * max(len(parts), 1)
    if num_samples < least:
        raise InputError(f"num_samples is {num_samples}; estimator={estimator} needs {least} or more on this model")
    options = (control_variates, parts, adapt_tau, fixed_scale is not None, full_rank)
    plan = Plan(found.target, estimator, reads, *options, num_steps, learning_rate, inflation, annealed)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    state = first_state(plan, found.start, fixed_scale or start_scale, tau)
    marks = set(np.linspace(0, num_steps, num_snapshots + 1).round().astype(int).tolist()) if num_snapshots else set()
    shots = [(0, time.perf_counter() - began, state.numbers)] if marks else []
    with np.errstate(invalid="ignore"), Progress("variational inference", num_steps, progress) as bar:
        while state.done < num_steps:
            state = step(plan, state, rng.standard_normal((num_samples, plan.target.size)))
            if state.done in marks:
                shots.append((state.done, time.perf_counter() - began, state.numbers))
            bar.advance(1)
    spent = found.evaluations + num_steps * num_samples
    return _posterior(plan, state, rng, num_draws, weighted, found.flags, spent, began, (model, evidence, shots))


def _check_words(estimator: str, full_rank: bool, fixed_scale: float | None) -> None:
    if estimator not in ESTIMATORS:
        raise InputError(f"estimator must be one of {', '.join(ESTIMATORS)}, but is '{estimator}'")
    if full_rank and estimator != "reparameterised":
        raise InputError(f"full_rank=true needs estimator=reparameterised, but it is {estimator}")
    if full_rank and fixed_scale is not None:
        raise InputError(f"full_rank=true learns the scale, but fixed_scale is {fixed_scale}; leave one of them out")
    if fixed_scale is not None and not fixed_scale > 0:
        raise InputError(f"fixed_scale is {fixed_scale}; it must be positive, or null to learn the scale")


def _check_numbers(from_one: dict[str, float], positive: dict[str, float], annealed: float) -> None:
    for name, value in from_one.items():
        if not 1 <= value < math.inf:
            raise InputError(f"{name} is {value}; bbvi needs 1 or more")
    for name, value in positive.items():
        if not 0 < value < math.inf:
            raise InputError(f"{name} is {value}; it must be positive")
    if not 0 <= annealed <= 1:
        raise InputError(f"annealed is the share of the steps with inflated noise, 0 to 1, but is {annealed}")


def gain_left(plan: Plan, q: Gaussian, noise: Array, values: Array) -> tuple[float, float]:
    """What a natural-gradient step would gain [nats], and its standard error, from draws (N, D) of q and the factors
    there (N, K + D). Of full rank only the means and scales along the columns of q's own factor are looked at."""
    if plan.full_rank:
        strength = np.repeat((values.sum(1) - q.log_density(noise))[:, None], plan.target.size, 1)
    else:
        strength = signal(values, noise, q.log_sd, plan.reads)
    y = terms(strength, noise, None, True)
    slope, variance = y.mean(0), y.var(0) / len(y)  # (2, D)
    curvature = np.maximum(1.0 - slope[1], 0.1)
    worth = np.stack([0.5 / curvature, np.full_like(curvature, 0.0 if plan.fixed else 0.25)])
    gain = worth * (slope**2 - variance)
    error = np.sqrt(np.sum(worth**2 * (4.0 * slope**2 * variance + 2.0 * variance**2)))
    return max(float(gain.sum()), 0.0), float(error)


def _posterior(
    plan: Plan,
    state: State,
    rng: np.random.Generator,
    num_draws: int,
    weighted: bool,
    flags: list[str],
    spent: int,
    began: float,
    trace: tuple[Model, Any, list[tuple[int, float, Array]]],
) -> Posterior:
    q, noise = q_of(plan, state.numbers), rng.standard_normal((num_draws, plan.target.size))
    u = q.draw(noise)
    values = plan.target.evaluate(u)
    log_weights = values.sum(1) - q.log_density(noise)
    gain, error = gain_left(plan, q, noise, values)
    shape = weights.pareto_k(log_weights)
    if not gain - 2.0 * error <= GAIN:
        flags.append(
            f"not converged: about {gain:.2g} nats are still to be gained after {plan.num_steps} steps; "
            "raise num_steps, or start closer (init, transform=laplace)"
        )
    if shape > MAX_K:
        flags.append(
            f"the weights p / q have a Pareto tail of k = {shape:.2f} (above {MAX_K}): q misses part of the posterior, "
            "and neither log_evidence nor weighted draws can be trusted; try full_rank=true"
        )
    if plan.fixed and not weighted:
        flags.append("the scale of q is fixed: its draws say where the posterior is, not how wide it is")
    draws = plan.target.latents(u)
    info = {
        "engine": "bbvi",
        "evaluations": spent + num_draws,
        "elbo": float(log_weights.mean()),
        "elbo_error": float(log_weights.std() / math.sqrt(num_draws)),
        "gain_left": gain,
        "pareto_k": shape,
        "ess": weights.effective_size(log_weights),
        "tau": state.tau.tolist(),
        "flags": flags,
        "seconds": time.perf_counter() - began,
    }
    return Posterior(
        draws={name: value[None] for name, value in draws.items()},
        log_weights=log_weights[None] if weighted else None,
        log_evidence=weights.log_mean(log_weights),
        estimate=plan.target.latents(q.mean),
        info=info,
        snapshots=_snapshots(plan, *trace) if trace[2] else None,
    )


def _snapshots(plan: Plan, model: Model, evidence: Any, shots: list[tuple[int, float, Array]]) -> Snapshots:
    steps, seconds, numbers = zip(*shots, strict=True)
    return snapshots(model, evidence, steps, seconds, plan.target.latents(np.stack(numbers)[:, : plan.target.size]))
