"""Reversible-jump Markov chain Monte Carlo over models with slots, a mask and moves (Green 1995).

A move maps (z, u), u uniform on the unit cube, to (z', u') and back. With q the density of the step and J
the Jacobian of its map, both in natural units, and T the temperature, a step is accepted with log ratio

    exact    log p(z')/p(z) + log p(y|z')/p(y|z) / T + log q(z'->z)/q(z->z') + log |J|     Green (1995), eq. 7
    paper    (log p(z')/p(z) + log p(y|z')/p(y|z)) / T + log q(z'->z)/q(z->z')             [M20] without its slip
    printed  log p(z')/p(z) + log p(y|z')/p(y|z) + log q(z->z') / T - log q(z'->z)         [M20] eq. 2

[M20] is Meyer, Walter, Lauer (2020), who drop the Jacobian (footnote 2). The probability of choosing the
move is part of q. Two paths run the same moves: models with a kernel run whole chains in machine code, any
other program runs all chains in a batch. Chains may be resampled between themselves while they anneal, with
weights p(y|z)^(1/T' - 1/T) (annealed importance resampling): chains in poor modes die out.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from inference import weights
from inference.polish import polish as polish_state
from inference.posterior import Posterior, Snapshots
from inference.progress import Progress, announce
from models.capability import HasMoves, Kernel, Move, kernel_types
from models.program import InputError, Latents, quiet_doubles, simulate, terms, total

Array = NDArray[Any]
RULES = {"exact": 0, "paper": 1, "printed": 2}
TRIED, EVALUATED, ACCEPTED = range(3)
BLOCK = 500  # steps between snapshots, resampling and progress


def log_acceptance(rule, temperature, prior, likelihood, forward, backward, jacobian):  # type: ignore[no-untyped-def]
    """Log acceptance ratio; prior and likelihood are log ratios new / old. The one home of the rules:
    the compiled chain compiles it, the batched path calls it."""
    if rule == 2:
        return prior + likelihood + forward / temperature - backward
    if rule == 1:
        return (prior + likelihood) / temperature + backward - forward
    return prior + likelihood / temperature + backward - forward + jacobian


class Chains(NamedTuple):
    """What a path hands to `run`: the states of all chains and the means to go on.

    advance(step, temperatures) runs a block for all chains; draws lists what it kept, {site: (C, n, *event)}
    choose(index) replaces chain c by chain index[c]"""

    advance: Callable[[int, Array], list[dict[str, Array]]]
    log_terms: Callable[[], tuple[Array, Array]]  # (C,) log prior, (C,) log likelihood
    choose: Callable[[Array], None]
    best: Callable[[], tuple[dict[str, Array], float]]
    polish: Callable[[], None]  # climb from the best state
    counts: Callable[[], Array]  # (M, 3)
    names: tuple[str, ...]


# One step at a time: the batched path


class State(NamedTuple):
    """States of all chains: latents {site: (B, ...)}, log prior (B,), log likelihood (B,)."""

    latents: Latents
    log_prior: Tensor
    log_likelihood: Tensor


def init(model: HasMoves, latents: Latents, evidence: Any) -> State:
    """A state from latents {site: (B, ...)}."""
    parts = terms(model, latents, evidence)
    batch = next(iter(latents.values())).shape[:1]
    return State(latents, total(parts.prior).expand(batch), total(parts.likelihood).expand(batch))


def step(
    model: HasMoves, move: Move, state: State, evidence: Any, u: Tensor, log_u: Tensor, rule: int, temperature: float
) -> tuple[State, Tensor, Tensor]:
    """One Metropolis-Hastings-Green step of all chains: (state, accepted (B,), valid (B,)).

    u (B, U) drives the move, log_u (B,) the acceptance."""
    with quiet_doubles():
        proposal = move.propose(state.latents, u)
    stay = ~proposal.valid
    latents = {n: _choose(stay, state.latents[n], proposal.latents[n]) for n in state.latents}
    new = init(model, latents, evidence)
    chance = float(np.log(move.probability))
    log_ratio = log_acceptance(
        rule,
        temperature,
        new.log_prior - state.log_prior,
        new.log_likelihood - state.log_likelihood,
        proposal.log_forward + chance,
        proposal.log_backward + chance,
        proposal.log_jacobian,
    )
    accepted = proposal.valid & (log_u < log_ratio)
    latents = {n: _choose(accepted, latents[n], state.latents[n]) for n in latents}
    keep = lambda a, b: torch.where(accepted, a, b)  # noqa: E731
    log_prior = keep(new.log_prior, state.log_prior)
    return State(latents, log_prior, keep(new.log_likelihood, state.log_likelihood)), accepted, proposal.valid


def _choose(where: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(where.reshape(-1, *[1] * (old.dim() - 1)), new, old)


def _batched(model: HasMoves, evidence: Any, latents: Latents, rule: int, thin: int, warmup: int, seed: Any) -> Chains:
    moves = model.moves()
    rng = np.random.default_rng(seed)
    shares = np.array([move.probability for move in moves])
    counts = np.zeros((len(moves), 3))
    state = init(model, latents, evidence)
    num_chains = len(state.log_prior)
    top: list[Any] = [None, -np.inf]

    def remember() -> None:
        joint = (state.log_prior + state.log_likelihood).numpy()
        if joint.max() > top[1]:
            chain = int(joint.argmax())
            top[:] = {n: v[chain].numpy().copy() for n, v in state.latents.items()}, float(joint[chain])

    def advance(first: int, temperatures: Array) -> list[dict[str, Array]]:
        nonlocal state
        kept = []
        for i, temperature in enumerate(temperatures):
            kind = int(rng.choice(len(moves), p=shares / shares.sum()))
            u = torch.from_numpy(rng.random((num_chains, moves[kind].num_uniforms)))
            log_u = torch.from_numpy(np.log(rng.random(num_chains)))
            state, accepted, valid = step(model, moves[kind], state, evidence, u, log_u, rule, float(temperature))
            counts[kind] += num_chains, int(valid.sum()), int(accepted.sum())
            remember()
            if first + i >= warmup and (first + i - warmup) % thin == thin - 1:
                kept.append({n: v.numpy().copy() for n, v in state.latents.items()})
        return [{n: np.stack([k[n] for k in kept], 1) for n in state.latents}] if kept else []

    def choose(index: Array) -> None:
        nonlocal state
        chosen = {n: v[index] for n, v in state.latents.items()}
        state = State(chosen, state.log_prior[index], state.log_likelihood[index])

    remember()
    log_terms = lambda: (state.log_prior.numpy(), state.log_likelihood.numpy())  # noqa: E731
    names = tuple(move.name for move in moves)

    def refuse() -> None:
        raise InputError(f"polish=true needs a model with a kernel, but {type(model).__name__} has none")

    return Chains(advance, log_terms, choose, lambda: (top[0], top[1]), refuse, lambda: counts, names)


# Whole chains in machine code


def _chain(
    propose, evaluate, commit, z, log_terms, best, uniforms, temperatures, setup, floats, ints, cache, draws, counts
):  # type: ignore[no-untyped-def]  # noqa: E501
    """Run one chain for len(temperatures) steps, in place.

    z (D,) state; log_terms (2,) its log prior and log likelihood; best (D + 1,) best state and its log joint
    uniforms  (n, 2 + U): move, acceptance, the move's own
    setup     (3 + 2 M,) rule, first draw, thin, cumulative and log probability of the moves
    draws     (., D) states at steps first draw, first draw + thin, ...; counts (M, 3)"""
    num_moves = len(counts)
    cumulative, log_chance = setup[3 : 3 + num_moves], setup[3 + num_moves :]
    z_new, u_new, log_q, out = z.copy(), uniforms[0, 2:].copy(), np.zeros(3), np.zeros(2)
    rule, due, row = int(setup[0]), int(setup[1]), 0
    for i in range(len(temperatures)):
        kind = 0
        while kind < num_moves - 1 and uniforms[i, 0] >= cumulative[kind]:
            kind += 1
        counts[kind, 0] += 1
        if propose(kind, z, uniforms[i, 2:], floats, ints, z_new, u_new, log_q):
            counts[kind, 1] += 1
            evaluate(z_new, floats, ints, cache, out)
            log_ratio = _rule(
                rule,
                temperatures[i],
                out[0] - log_terms[0],
                out[1] - log_terms[1],
                log_q[0] + log_chance[kind],
                log_q[1] + log_chance[kind],
                log_q[2],
            )
            if np.log(uniforms[i, 1]) < log_ratio:
                counts[kind, 2] += 1
                commit(cache)
                z[:], log_terms[:] = z_new, out
                if out[0] + out[1] > best[-1]:
                    best[:-1], best[-1] = z, out[0] + out[1]
        if i == due:
            draws[row] = z
            due, row = due + int(setup[2]), row + 1


@lru_cache(maxsize=1)
def _compiled_chain() -> Any:
    """The chain for any kernel: explicit function types keep it in the disk cache."""
    import numba as nb

    types = kernel_types()
    vector, index, function = types["vector"], types["index"], types["function"]
    globals()["_rule"] = nb.njit(log_acceptance)
    rows = nb.float64[:, ::1]
    signature = nb.void(
        *(function(types[name]) for name in ("propose", "evaluate", "commit")),
        *(vector, vector, vector, rows, vector, vector, vector, index, vector, rows, rows),
    )
    return nb.njit(signature, cache=True, nogil=True)(_chain)


def _start_compiled(
    kernel: Kernel, z: Array, rule: int, thin: int, warmup: int, seeds: list[Any], num_workers: int
) -> Chains:
    chain, num_chains = _compiled_chain(), len(z)
    rngs = [np.random.default_rng(seed) for seed in seeds]
    caches = [np.full(kernel.cache_size, 0.0) for _ in range(num_chains)]
    log_terms = np.empty((num_chains, 2))
    for c in range(num_chains):
        kernel.evaluate(z[c], kernel.floats, kernel.ints, caches[c], log_terms[c])
        kernel.commit(caches[c])
    best = np.concatenate([z, log_terms.sum(1, keepdims=True)], 1)
    counts = np.zeros((num_chains, len(kernel.probabilities), 3))
    cumulative = np.cumsum(kernel.probabilities)
    with np.errstate(divide="ignore"):
        log_chance = np.log(kernel.probabilities)

    def advance(first: int, temperatures: Array) -> list[dict[str, Array]]:
        steps = np.arange(first, first + len(temperatures))
        due = np.flatnonzero((steps >= warmup) & ((steps - warmup) % thin == thin - 1))
        setup = np.concatenate([[rule, due[0] if len(due) else -1, thin], cumulative, log_chance])
        draws = np.empty((num_chains, max(len(due), 1), kernel.size))

        def one(c: int) -> None:
            uniforms = rngs[c].random((len(temperatures), 2 + kernel.num_uniforms))
            data = (setup, kernel.floats, kernel.ints, caches[c], draws[c], counts[c])
            functions = (kernel.propose, kernel.evaluate, kernel.commit)
            chain(*functions, z[c], log_terms[c], best[c], uniforms, temperatures, *data)

        if num_workers > 1:
            with ThreadPoolExecutor(num_workers) as pool:
                list(pool.map(one, range(num_chains)))
        else:
            for c in range(num_chains):
                one(c)
        return [kernel.unpack(draws)] if len(due) else []

    def choose(index: Array) -> None:
        z[:], log_terms[:] = z[index], log_terms[index]

    def top() -> tuple[dict[str, Array], float]:
        row = best[best[:, -1].argmax()]
        return kernel.unpack(row[:-1]), float(row[-1])

    def climb() -> None:
        if kernel.refit is None:
            raise InputError("polish=true needs a kernel with edits and a refit, and this model's has none")
        row = int(best[:, -1].argmax())
        best[row, :-1], best[row, -1] = polish_state(kernel, best[row, :-1])

    terms_now = lambda: (log_terms[:, 0], log_terms[:, 1])  # noqa: E731
    return Chains(advance, terms_now, choose, top, climb, lambda: counts.sum(0), kernel.move_names)


# The engine


def temperatures_of(num_steps: int, warmup: int, start_temperature: float) -> Array:
    """(num_steps,) geometric from start_temperature to 1 along the warm-up, then 1."""
    ladder = np.ones(num_steps)
    if warmup > 0:
        ladder[:warmup] = start_temperature ** (1.0 - np.arange(1, warmup + 1) / warmup)
    return ladder


def first_states(model: Any, evidence: Any, init: Latents | None, num_chains: int, seed: int) -> Latents:
    """(num_chains, *event) of every site: `init` repeated, else draws from the prior."""
    if init is None:
        return simulate(model, evidence, num=num_chains, seed=seed)
    tensors = {n: torch.as_tensor(np.asarray(v)) for n, v in init.items()}
    return {n: v.expand((num_chains, *v.shape)).clone() for n, v in tensors.items()}


def run(
    model: HasMoves,
    evidence: Any,
    *,
    seed: int,
    init: Latents | None = None,
    start: Literal["prior", "data"] = "prior",
    num_chains: int = 4,
    num_steps: int = 5000,
    warmup: int = 1000,
    thin: int = 1,
    acceptance: Literal["exact", "paper", "printed"] = "exact",
    start_temperature: float = 1.0,
    resample: bool = False,
    polish: bool = False,
    path: Literal["auto", "compiled", "batched"] = "auto",
    num_workers: int = 1,
    progress: bool = False,
) -> Posterior:
    """Sample p(z | y); the first `warmup` steps are annealed from start_temperature to 1 and discarded.

    init         {site: value} first state of all chains; without it `start`: draws from the prior, or
                 the model's data-driven start
    thin         keep every thin-th state after the warm-up; warmup = num_steps keeps the last state
    resample     resample chains between themselves while they anneal
    polish       climb greedily from the best state over edits of the structure (the estimate, not the draws)
    num_workers  threads of the compiled path; the draws do not depend on it

    Raises InputError where the model lacks moves, a start or a kernel that is asked for."""
    began = time.perf_counter()
    if not hasattr(model, "moves"):
        raise InputError(f"rjmcmc needs a model with moves(), but {type(model).__name__} has none")
    if start == "data" and init is None and not hasattr(model, "start"):
        raise InputError(f"start=data needs a model with start(), but {type(model).__name__} has none; use start=prior")
    if path == "compiled" and not hasattr(model, "kernel"):
        raise InputError(f"path=compiled needs a model with kernel(), but {type(model).__name__} has none")
    if not 0 <= warmup <= num_steps or num_chains < 1 or thin < 1 or start_temperature < 1:
        raise InputError(
            f"rjmcmc needs 0 <= warmup <= num_steps, num_chains >= 1, thin >= 1 and start_temperature >= 1, but got "
            f"{warmup}, {num_steps}, {num_chains}, {thin}, {start_temperature}"
        )
    init = model.start(evidence) if start == "data" and init is None else init  # type: ignore[attr-defined]
    entropy, *seeds = np.random.SeedSequence(seed).spawn(num_chains + 2)
    latents = first_states(model, evidence, init, num_chains, int(entropy.generate_state(1)[0]))
    kept_from = warmup if warmup < num_steps else num_steps - 1
    thin = min(thin, num_steps - kept_from)
    if path != "batched" and hasattr(model, "kernel"):
        with announce("compiling the sampler"):
            kernel = model.kernel(evidence)
            z = kernel.pack({n: v.numpy() for n, v in latents.items()})
            chains = _start_compiled(kernel, z, RULES[acceptance], thin, kept_from, seeds[1:], num_workers)
    else:
        chains = _batched(model, evidence, latents, RULES[acceptance], thin, kept_from, seeds[0])
    _check_start(chains)
    rng = np.random.default_rng(seeds[0].spawn(1)[0])
    ladder = temperatures_of(num_steps, warmup, start_temperature)
    draws, shots = [], [_snapshot(chains, 0, began)]
    with Progress("reversible jump", num_steps, progress) as bar:
        for first in range(0, num_steps, BLOCK):
            part = ladder[first : first + BLOCK]
            draws += chains.advance(first, part)
            last = first + len(part)
            if resample and last < warmup:
                heat = 1.0 / ladder[min(last + BLOCK, num_steps) - 1] - 1.0 / part[-1]
                chains.choose(weights.systematic(heat * chains.log_terms()[1], num_chains, rng.random()))
            shots.append(_snapshot(chains, last, began))
            bar.advance(len(part))
    if polish:
        chains.polish()
        shots.append(_snapshot(chains, num_steps, began))
    return _posterior(model, chains, draws, shots, time.perf_counter() - began)


def _check_start(chains: Chains) -> None:
    log_prior, log_likelihood = chains.log_terms()
    joint = np.asarray(log_prior) + np.asarray(log_likelihood)
    if not np.isfinite(joint).all():
        raise InputError(
            f"chain {int(np.flatnonzero(~np.isfinite(joint))[0])} starts where the density is zero "
            f"(log prior {log_prior}, log likelihood {log_likelihood}); give another init"
        )


def _snapshot(chains: Chains, step: int, began: float) -> tuple[int, float, float, dict[str, Array]]:
    state, joint = chains.best()
    return step, time.perf_counter() - began, joint, state


def _posterior(model: Any, chains: Chains, draws: list[Any], shots: list[Any], seconds: float) -> Posterior:
    joined = {n: np.concatenate([d[n] for d in draws], 1) for n in draws[0]}
    counts = chains.counts()
    used = counts[:, TRIED] > 0
    acceptance = {
        name: float(c[ACCEPTED] / max(c[TRIED], 1)) for name, c, u in zip(chains.names, counts, used, strict=True) if u
    }
    states = {n: np.stack([shot[3][n] for shot in shots]) for n in shots[0][3]}
    columns = (np.array([shot[k] for shot in shots]) for k in range(3))
    dimension = getattr(model, "dimension", None)
    return Posterior(
        draws=joined,
        model_index=joined[dimension] if dimension else None,
        estimate=chains.best()[0],
        info={
            "engine": "rjmcmc",
            "seconds": seconds,
            "evaluations": int(counts[:, EVALUATED].sum()),
            "invalid_share": float(1 - counts[:, EVALUATED].sum() / counts[:, TRIED].sum()),
            "acceptance": acceptance,
            "log_joint": chains.best()[1],
        },
        snapshots=Snapshots(*columns, states),
    )
