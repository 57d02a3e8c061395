"""Tempered sequential Monte Carlo: a population that is led from the prior to the posterior (Del Moral et al. 2006).

Stage t raises the exponent b of what is tempered, h, as far as the weights of N particles bear (Jasra et al. 2011),

    w_n = e^((b_t - b_(t-1)) h_n),   (sum w)^2 / sum w^2 = ess N,   log p(y) ~ sum_t log mean_n w_n

resamples, and moves every particle by steps that leave p(z) e^(b_t h) as it is. h is the log likelihood: of whitened
numbers that walk (a continuous model), or of states that make the model's reversible-jump moves (an unknown
dimension: a population over structures). Whitened by a Laplace fit q, the path leads from q instead, h = log p / q.

How far one run can be trusted is read from its families, the shares s_i of the final population that descend from
each first particle: log p(y) has the standard error sqrt(sum s_i^2 - 1 / N), after Lee and Whiteley (2018), for
resampling that is systematic.
"""

from __future__ import annotations

import math
import time
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from inference import weights
from inference.factors import factored
from inference.population import Movers, Population, Walkers
from inference.posterior import Posterior
from inference.progress import Progress, announce
from inference.refusal import accept, answers_first
from inference.snapshots import snapshots
from inference.transform import whitening
from models.program import InputError

Array = NDArray[Any]
FEW = 20.0  # families below which a population has forgotten its beginnings


@answers_first
def run(
    model: Any,
    evidence: Any,
    *,
    seed: int,
    init: dict[str, Any] | None = None,
    transform: Literal["prior", "laplace"] = "prior",
    moves: Literal["auto", "walk", "model"] = "auto",
    num_particles: int = 1000,
    num_moves: int | None = None,
    ess: float = 0.5,
    progress: bool = False,
) -> Posterior:
    """A population from p(z | y), all draws of equal weight, and the log evidence.

    init           {site: (*event)} where the Laplace fit begins
    transform      of the numbers that walk: the path leads from the "prior", or from a "laplace" fit, which is shorter
                   but may miss what the fit does not reach
    moves          "walk" in whitened numbers, or the "model"'s own; "auto" takes its own where its dimension is unknown
    num_moves      steps of every particle in a stage; None makes 10 walks, or 200 steps of reversible jump
    ess            share of the particles that the weights of a stage are worth

    Raises InputError by name for latents that cannot be whitened, for a model without moves where its own are asked
    for, and for an init that no Laplace fit begins at."""
    began = time.perf_counter()
    jumps = _jumps(model, moves)
    num_moves = (200 if jumps else 10) if num_moves is None else num_moves
    _check(num_particles, num_moves, ess)
    if init is not None and transform == "prior":
        raise InputError("smc begins at the prior, not at init; leave init out or use transform=laplace")
    first, shared = np.random.SeedSequence(seed).spawn(2)
    rng = np.random.default_rng(shared)
    population: Population
    if jumps:
        if transform != "prior":
            raise InputError(f"transform={transform} is for numbers that walk; use transform=prior or moves=walk")
        accept()
        with announce(f"compiling the sampler for {type(model).__name__}"):
            population, evaluations, flags = Movers(model, evidence, num_particles, num_moves, first), 0, list[str]()
    else:
        population, evaluations, flags = _walkers(model, evidence, init, transform, num_particles, num_moves, first)
    exponents, log_evidence, families = [0.0], 0.0, np.arange(num_particles)
    times, states = [time.perf_counter() - began], [population.best()]
    with Progress("tempering", 100, progress) as bar:
        while exponents[-1] < 1.0:
            heat, left = population.heat, 1.0 - exponents[-1]
            rise = weights.temper(heat, ess * num_particles, left)
            exponents.append(1.0 if rise == left else exponents[-1] + rise)
            log_evidence += weights.log_mean(rise * heat)
            index = weights.systematic(rise * heat, num_particles, rng.random())
            population.choose(index)
            families = families[index]
            population.move(exponents[-1])
            times.append(time.perf_counter() - began)
            states.append(population.best())
            bar.advance(round(100 * _share_done(exponents)) - bar.done)
    shares = np.bincount(families) / num_particles
    draws, dimension = population.draws(), getattr(model, "dimension", None)
    num_families = float(1.0 / np.square(shares).sum())
    return Posterior(
        draws={n: v[None] for n, v in draws.items()},
        log_evidence=log_evidence,
        model_index=draws[dimension][None] if dimension else None,
        estimate=states[-1],
        info={
            "engine": "smc",
            "seconds": times[-1],
            "evaluations": evaluations + population.evaluations,
            "acceptance": population.acceptance,
            "exponents": exponents,
            "families": num_families,
            "log_evidence_error": math.sqrt(max(1.0 / num_families - 1.0 / num_particles, 0.0)),
            "flags": flags + _flags(num_families, num_particles),
        },
        snapshots=snapshots(model, evidence, range(len(states)), times, _stack(states)),
    )


def _check(num_particles: int, num_moves: int, ess: float) -> None:
    for name, value, least in (("num_particles", num_particles, 2), ("num_moves", num_moves, 1)):
        if value < least:
            raise InputError(f"{name} is {value}; smc needs {least} or more")
    if not 0.0 < ess < 1.0:
        raise InputError(f"ess is {ess}; choose a share between 0 and 1")


def _jumps(model: Any, moves: str) -> bool:
    """Whether the particles make the model's own moves."""
    if moves not in ("auto", "walk", "model"):
        raise InputError(f"moves must be one of auto, walk, model, but is '{moves}'")
    if moves == "model" and not hasattr(model, "moves"):
        raise InputError(f"moves=model needs a model with moves(), but {type(model).__name__} has none; use moves=walk")
    return moves == "model" or (moves == "auto" and hasattr(model, "moves") and hasattr(model, "dimension"))


def _walkers(
    model: Any, evidence: Any, init: Any, transform: Any, num_particles: int, num_moves: int, seed: Any
) -> tuple[Population, int, list[str]]:
    """Particles that walk under log p(u, y) - log N(u; 0, I), evaluations for their coordinates, flags."""
    factors = factored(model, evidence)
    size = factors.depends.shape[1]
    if num_particles < 2 * size:
        raise InputError(f"num_particles is {num_particles}; a cloud of {size} numbers needs {2 * size} or more")
    accept()
    target, _, evaluations, flags = whitening(model, evidence, factors, transform, init)

    def density(u: Array) -> Array:
        return np.asarray(target.evaluate(u).sum(1) + 0.5 * (np.square(u).sum(1) + size * math.log(2.0 * math.pi)))

    shape, rng = (num_particles, size), np.random.default_rng(seed)
    return Walkers(density, target.latents, shape, num_moves, rng), evaluations, flags


def _share_done(exponents: list[float]) -> float:
    """Exponents grow about geometrically."""
    return 1.0 if exponents[-1] == 1.0 else 1.0 - math.log(exponents[-1]) / math.log(exponents[1])


def _flags(num_families: float, num_particles: int) -> list[str]:
    if num_families >= min(FEW, 0.5 * num_particles):
        return []
    return [
        f"the population descends from {num_families:.1f} of its {num_particles} first particles in effect: modes and "
        "structures may be lost; raise num_particles or num_moves"
    ]


def _stack(states: list[dict[str, Array]]) -> dict[str, Array]:
    return {n: np.stack([state[n] for state in states]) for n in states[0]}
